"""What stays the same while B scenes run, laid out so that a step asks each question with one look-up."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.recording import VEHICLE
from e2rl.scene.route import SPACING, onto_nearer, segment
from e2rl.sim.mission import Mission

WINDOW = 20.0  # m of the mission on either side of where the ego is expected


class Place(NamedTuple):
    """Where on its mission the ego is: arc length s, offset d (left positive), heading of the route; each [B]."""

    s: Tensor
    d: Tensor
    heading: Tensor


class Setting(NamedTuple):
    """Of B scenes. points [B, P, 2]: the mission's vertices; legs [B, P - 1, 12]: its segments (`legs_of`); row [B, 1]:
    0 .. B - 1; end [B]: arc length at which the map ends; light [B, 2], light_s [B, 2]: the mission's lights; colours
    [B, T + 1, S]; field [B, G, G], origin [B, 2]: the drivable field; size [B, 2]: the ego's; half [B, 2, M]: half
    lengths and widths of the others; vehicle [B, M]: which of them are."""

    points: Tensor
    legs: Tensor
    row: Tensor
    end: Tensor
    light: Tensor
    light_s: Tensor
    colours: Tensor
    field: Tensor
    origin: Tensor
    size: Tensor
    half: Tensor
    vehicle: Tensor


class Legs(NamedTuple):
    """Columns of `Setting.legs` at some segments [...]: `scene.route.segment` of each and the vertex it begins at, the
    tangent there and how far it turns to the next vertex, and the limits [m/s] at both ends."""

    a: Tensor
    along: Tensor
    unit: Tensor
    length: Tensor
    heading: Tensor
    tangent: Tensor
    turn: Tensor
    limits: Tensor


def setting_of(scene: TensorDictBase, mission: Mission) -> Setting:
    """The Setting of scenes [B] whose egos have these missions; field, lights and sizes are the scenes' own storage."""
    half = scene["size"][:, 1:].transpose(1, 2) / 2
    row = torch.arange(len(half), device=half.device)[:, None]
    return Setting(
        mission.points,
        legs_of(mission.points, mission.limit),
        row,
        mission.end,
        mission.light,
        mission.light_s,
        scene["light_state"],
        scene["field"],
        scene["field_origin"],
        scene["size"][:, 0],
        half.contiguous(),
        scene["agent_type"][:, 1:] == VEHICLE,
    )


def write_rows(setting: Setting, rows: Tensor, new: Setting) -> None:
    """Overwrite what scenes rows [b] of a Setting do not share with their scene by that of another, in place."""
    for name in ("points", "legs", "end", "light", "light_s", "half", "vehicle"):
        getattr(setting, name)[rows] = getattr(new, name)


def legs_of(points: Tensor, limit: Tensor) -> Tensor:
    """[B, P - 1, 12] of vertices [B, P, 2] with limits [B, P]: the columns of Legs, vertex tangents as `interpolate`
    takes them."""
    a, b = points[:, :-1], points[:, 1:]
    along, length, unit, heading = segment(a, b)
    first = b - torch.cat([points[:, :1], points[:, :-2]], 1)
    second = torch.cat([points[:, 2:], points[:, -1:]], 1) - a
    tangent = torch.atan2(first[..., 1], first[..., 0])
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    turn = torch.atan2(cross, (first * second).sum(-1))
    rest = torch.stack([length, heading, tangent, turn, limit[:, :-1], limit[:, 1:]], -1)
    return torch.cat([a, along, unit, rest], -1)


def rows_at(table: Tensor, row: Tensor, index: Tensor) -> Tensor:
    """table [B, P, F] at index [B, ...] -> [B, ..., F]; row [B, 1]."""
    flat = (row * table.shape[1] + index.flatten(1)).view(-1)
    return table.flatten(0, 1).index_select(0, flat).view(*index.shape, table.shape[2])


def legs_at(setting: Setting, index: Tensor) -> Legs:
    """The segments index [B, ...]."""
    a, along, unit, rest, limits = rows_at(setting.legs, setting.row, index).split((2, 2, 2, 4, 2), -1)
    return Legs(a, along, unit, *rest.unbind(-1), limits)


def follow(setting: Setting, xy: Tensor, hint: Tensor) -> Place:
    """`scene.route.project` of xy [B, 2] on the mission, near arc length hint [B]."""
    count = setting.points.shape[1]
    width, last = min(int(2 * WINDOW / SPACING) + 1, count), count - 2
    near = hint.clamp(0, SPACING * (count - 1))  # beyond the ends, the end is what is near
    first = ((near - WINDOW) / SPACING).ceil().clamp(0, count - width).long()
    index = first[:, None] + torch.arange(width, device=first.device)
    gap = rows_at(setting.points, setting.row, index) - xy[:, None]
    outside = (SPACING * index - near[:, None]).abs() > WINDOW
    vertex = first + gap.square().sum(-1).masked_fill(outside, torch.inf).argmin(-1)
    start = torch.stack([vertex - 1, vertex], 1).clamp(0, last)
    leg = legs_at(setting, start)
    a, along, unit = (value.transpose(0, 1) for value in (leg.a, leg.along, leg.unit))
    return Place(*onto_nearer(xy, start.T, last, a, along, leg.length.T, unit, leg.heading.T))


def look_along(setting: Setting, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the mission at arc lengths s [B, K]: point [B, K, 2], heading, curvature (as `scene.route.interpolate`) and
    speed limit (of the nearest vertex); each [B, K]."""
    u = s / SPACING
    index = u.floor().clamp(0, setting.legs.shape[1] - 1)
    leg = legs_at(setting, index.long())
    t = u - index
    within = t.clamp(0, 1)
    heading = leg.tangent + within * leg.turn
    curvature = torch.where(within == t, leg.turn / SPACING, 0.0)
    limit = torch.where(u.round() > index, leg.limits[..., 1], leg.limits[..., 0])
    return leg.a + t[..., None] * leg.along, heading, curvature, limit
