"""The static part of B running scenes, as tables in which a simulation step needs one
look-up per quantity."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scenes.recording import OTHER, VEHICLE
from e2rl.scenes.route import (
    SPACING,
    WINDOW,
    first_least,
    onto_nearer,
    segment,
    tangents,
)
from e2rl.sim.mission import Mission, lights_of


class FrenetPose(NamedTuple):
    """Frenet poses on the missions: arc length s [B] m, offset d [B] m (left positive),
    route heading [B] rad."""

    s: Tensor
    d: Tensor
    heading: Tensor


class StaticScene(NamedTuple):
    """Static tensors of B scenes.

    mission; segments [B, P - 1, 12]: table of the mission's segments (`segment_table`);
    row [B, 1]: 0 .. B - 1; lights [B, T + 1, 2]: states of the mission's lights; field
    [B, G, G], origin [B, 2]: the drivable field; size [B, 2]: length and width of the
    ego; half_size [B, 2, M]: half lengths and widths of the others; vehicle, plain [B,
    M] bool: they are vehicles, or objects such as cones; top_speed [B]: the recorded
    ego's highest speed [m/s].
    """

    mission: Mission
    segments: Tensor
    row: Tensor
    lights: Tensor
    field: Tensor
    origin: Tensor
    size: Tensor
    half_size: Tensor
    vehicle: Tensor
    plain: Tensor
    top_speed: Tensor


OF_MISSION = ("B P 2!", "B P!", "B", "B 2:int64!", "B 2!")
STATIC = (
    *OF_MISSION,
    *(
        "B S 12!",
        "B 1:int64!",
        "B T 2:int64!",
        "B G G:float16",
        "B 2!",
        "B 2!",
        "B 2 M",
        "B M:bool",
        "B M:bool",
        "B",
    ),
)
"""Shapes of a StaticScene's tensors in fused functions."""


def static_scene(scene: TensorDictBase, mission: Mission) -> StaticScene:
    """The StaticScene of scenes [B] with these missions; field and sizes are views of
    the scenes' storage."""
    half_size = (scene["size"][:, 1:].transpose(1, 2) / 2).contiguous()
    row = torch.arange(len(half_size), device=half_size.device)[:, None]
    return StaticScene(
        mission,
        segment_table(mission.points, mission.limit),
        row=row,
        lights=lights_of(scene["light_state"], mission.light),
        field=scene["field"],
        origin=scene["field_origin"],
        size=scene["size"][:, 0],
        half_size=half_size,
        vehicle=scene["agent_type"][:, 1:] == VEHICLE,
        plain=scene["agent_type"][:, 1:] == OTHER,
        top_speed=(scene["logged"][:, :, 0, 3] * scene["logged_valid"][:, :, 0]).amax(
            1
        ),
    )


def write_rows(static: StaticScene, rows: Tensor, new: StaticScene) -> None:
    """Overwrite rows [b] of a StaticScene, in place; views of the scenes' storage need
    no copy."""
    for old, fresh in zip(static.mission, new.mission, strict=True):
        old.index_copy_(0, rows, fresh)
    for name in ("segments", "lights", "half_size", "vehicle", "plain", "top_speed"):
        getattr(static, name).index_copy_(0, rows, getattr(new, name))


def segment_table(points: Tensor, limit: Tensor) -> Tensor:
    """Segments [B, P - 1, 12] of routes points [B, P, 2] with limits [B, P] m/s.

    Columns: first vertex (2), difference to the next vertex (2), direction (2), length,
    heading, tangent angle at the first vertex, turn of the tangent to the next vertex
    (as `scene.route.interpolate` takes them), limits at both ends (2).
    """
    a = points[:, :-1]
    b = points[:, 1:]
    along, length, unit = segment(a, b)
    heading = torch.atan2(unit[..., 1], unit[..., 0])
    tangent, turn = tangents(points)
    rest = torch.stack(
        [length, heading, tangent, turn, limit[:, :-1], limit[:, 1:]], -1
    )
    return torch.cat([a, along, unit, rest], -1)


def rows_at(table: Tensor, row: Tensor, index: Tensor) -> Tensor:
    """table [B, P, F] at index [B, ...] -> [B, ..., F]; row [B, 1]."""
    flat = (row * table.shape[1] + index.flatten(1)).view(-1)
    return table.flatten(0, 1).index_select(0, flat).view(*index.shape, table.shape[2])


def follow(static: StaticScene, xy: Tensor, hint: Tensor) -> FrenetPose:
    """Frenet pose of positions xy [B, 2] on the mission near arc length hint [B];
    equals `scene.route.project`."""
    points = static.mission.points
    count = points.shape[1]
    width = int(2 * WINDOW / SPACING) + 1
    last = count - 2
    near = hint.clamp(
        0, SPACING * (count - 1)
    )  # beyond an end of the route, the end is nearest
    first = (
        ((near - WINDOW) / SPACING).ceil().clamp(max=count - width).clamp(min=0).long()
    )
    index = (first[:, None] + torch.arange(width, device=first.device)).clamp(
        max=count - 1
    )
    gap = rows_at(points, static.row, index=index) - xy[:, None]
    outside = (SPACING * index - near[:, None]).abs() > WINDOW
    vertex = first + first_least(gap.square().sum(-1).masked_fill(outside, torch.inf))
    start = torch.stack([vertex - 1, vertex], 1).clamp(0, last)
    table = rows_at(static.segments, static.row, index=start).transpose(0, 1)
    a, along, unit, length, heading, _ = table.split((2, 2, 2, 1, 1, 4), -1)
    s, d, second = onto_nearer(
        xy, start.T, last=last, a=a, along=along, length=length[..., 0], unit=unit
    )
    return FrenetPose(
        s, d, heading=torch.where(second, heading[1, :, 0], heading[0, :, 0])
    )


def look_along(
    static: StaticScene, s: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The mission at arc lengths s [B, K]: x, y, headings, curvatures (as
    `scene.route.interpolate`) and speed limits of the nearest vertices; each [B, K]."""
    u = s / SPACING
    index = u.floor().clamp(0, static.segments.shape[1] - 1)
    table = rows_at(static.segments, static.row, index=index.long())
    x, y, ahead_x, ahead_y, _, _, _, _, tangent, turn, before, after = table.unbind(-1)
    t = u - index
    within = t.clamp(0, 1)
    heading = tangent + within * turn
    curvature = torch.where(within == t, turn / SPACING, 0.0)
    limit = torch.where(u.round() > index, after, before)
    return x + t * ahead_x, y + t * ahead_y, heading, curvature, limit


def seen_from(
    ego: Tensor, rotation: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor]:
    """Places x, y [B, K] in the frame of ego states [B, 4], in which `rotation` [B, 2,
    2] turns vectors."""
    x = x - ego[:, :1]
    y = y - ego[:, 1:2]
    if torch.compiler.is_compiling():
        cos, sin = rotation[:, 0].split(1, 1)
        return cos * x + sin * y, cos * y - sin * x
    ahead, left = torch.stack([x, y], -1).bmm(rotation.transpose(1, 2)).unbind(-1)
    return ahead, left
