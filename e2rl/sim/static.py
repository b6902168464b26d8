"""The static part of B running scenes, as tables in which a simulation step needs one look-up per quantity."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scenes.recording import VEHICLE
from e2rl.scenes.route import SPACING, WINDOW, onto_nearer, segment, tangents
from e2rl.sim.mission import Mission


class FrenetPose(NamedTuple):
    """Frenet poses on the missions: arc length s [B] m, offset d [B] m (left positive), route heading [B] rad."""

    s: Tensor
    d: Tensor
    heading: Tensor


class StaticScene(NamedTuple):
    """Static tensors of B scenes.

    mission; segments [B, P - 1, 12]: table of the mission's segments (`segment_table`); row [B, 1]: 0 .. B - 1;
    light_state [B, T + 1, S]; field [B, G, G], origin [B, 2]: the drivable field; size [B, 2]: length and width of the
    ego; half_size [B, 2, M]: half lengths and widths of the others; vehicle [B, M] bool; top_speed [B]: the recorded
    ego's highest speed [m/s].
    """

    mission: Mission
    segments: Tensor
    row: Tensor
    light_state: Tensor
    field: Tensor
    origin: Tensor
    size: Tensor
    half_size: Tensor
    vehicle: Tensor
    top_speed: Tensor


def static_scene(scene: TensorDictBase, mission: Mission) -> StaticScene:
    """The StaticScene of scenes [B] with these missions; field, lights and sizes are views of the scenes' storage."""
    half_size = (scene["size"][:, 1:].transpose(1, 2) / 2).contiguous()
    row = torch.arange(len(half_size), device=half_size.device)[:, None]
    return StaticScene(
        mission,
        segment_table(mission.points, mission.limit),
        row,
        scene["light_state"],
        scene["field"],
        scene["field_origin"],
        scene["size"][:, 0],
        half_size,
        scene["agent_type"][:, 1:] == VEHICLE,
        (scene["logged"][:, :, 0, 3] * scene["logged_valid"][:, :, 0]).amax(1),
    )


def write_rows(static: StaticScene, rows: Tensor, new: StaticScene) -> None:
    """Overwrite rows [b] of a StaticScene, in place; views of the scenes' storage need no copy."""
    for old, fresh in zip(static.mission, new.mission, strict=True):
        old[rows] = fresh
    for name in ("segments", "half_size", "vehicle", "top_speed"):
        getattr(static, name)[rows] = getattr(new, name)


def segment_table(points: Tensor, limit: Tensor) -> Tensor:
    """Segments [B, P - 1, 12] of routes points [B, P, 2] with limits [B, P] m/s.

    Columns: first vertex (2), difference to the next vertex (2), direction (2), length, heading, tangent angle at the
    first vertex, turn of the tangent to the next vertex (as `scene.route.interpolate` takes them), limits at both
    ends (2).
    """
    a, b = points[:, :-1], points[:, 1:]
    along, length, unit = segment(a, b)
    heading = torch.atan2(unit[..., 1], unit[..., 0])
    tangent, turn = tangents(points)
    rest = torch.stack([length, heading, tangent, turn, limit[:, :-1], limit[:, 1:]], -1)
    return torch.cat([a, along, unit, rest], -1)


def rows_at(table: Tensor, row: Tensor, index: Tensor) -> Tensor:
    """table [B, P, F] at index [B, ...] -> [B, ..., F]; row [B, 1]."""
    flat = (row * table.shape[1] + index.flatten(1)).view(-1)
    return table.flatten(0, 1).index_select(0, flat).view(*index.shape, table.shape[2])


def follow(static: StaticScene, xy: Tensor, hint: Tensor) -> FrenetPose:
    """Frenet pose of positions xy [B, 2] on the mission near arc length hint [B]; equals `scene.route.project`."""
    points = static.mission.points
    count = points.shape[1]
    width, last = min(int(2 * WINDOW / SPACING) + 1, count), count - 2
    near = hint.clamp(0, SPACING * (count - 1))  # beyond an end of the route, the end is nearest
    first = ((near - WINDOW) / SPACING).ceil().clamp(0, count - width).long()
    index = first[:, None] + torch.arange(width, device=first.device)
    gap = rows_at(points, static.row, index) - xy[:, None]
    outside = (SPACING * index - near[:, None]).abs() > WINDOW
    vertex = first + gap.square().sum(-1).masked_fill(outside, torch.inf).argmin(-1)
    start = torch.stack([vertex - 1, vertex], 1).clamp(0, last)
    table = rows_at(static.segments, static.row, start).transpose(0, 1)
    a, along, unit, length, heading, _ = table.split((2, 2, 2, 1, 1, 4), -1)
    s, d, second = onto_nearer(xy, start.T, last, a, along, length[..., 0], unit)
    return FrenetPose(s, d, torch.where(second, heading[1, :, 0], heading[0, :, 0]))


def look_along(static: StaticScene, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The mission at arc lengths s [B, K]: points [B, K, 2], headings, curvatures (as `scene.route.interpolate`) and
    speed limits of the nearest vertices; each [B, K]."""
    u = s / SPACING
    index = u.floor().clamp(0, static.segments.shape[1] - 1)
    table = rows_at(static.segments, static.row, index.long())
    a, along, _, rest, limits = table.split((2, 2, 2, 4, 2), -1)
    tangent, turn = rest[..., 2], rest[..., 3]
    t = u - index
    within = t.clamp(0, 1)
    heading = tangent + within * turn
    curvature = torch.where(within == t, turn / SPACING, 0.0)
    limit = torch.where(u.round() > index, limits[..., 1], limits[..., 0])
    return a + t[..., None] * along, heading, curvature, limit
