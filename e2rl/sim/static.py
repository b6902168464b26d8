"""The static part of B running scenes, as tables in which a simulation step needs one
look-up per quantity."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scenes.recording import OTHER, VEHICLE
from e2rl.scenes.route import SPACING, project, tangents
from e2rl.sim.mission import Mission, lights_of


class FrenetPose(NamedTuple):
    """Frenet poses on the missions: arc length s [B] m, offset d [B] m (left positive),
    route heading [B] rad."""

    s: Tensor
    d: Tensor
    heading: Tensor


class Ahead(NamedTuple):
    """A mission at some arc lengths: x, y m, heading rad, curvature 1/m (as
    `scene.route.interpolate`) and the speed limit m/s of the nearest vertex; each [B,
    K]."""

    x: Tensor
    y: Tensor
    heading: Tensor
    curvature: Tensor
    limit: Tensor


class StaticScene(NamedTuple):
    """Static tensors of B scenes.

    mission; segments [B, P - 1, 8]: table of the mission's segments (`segment_table`);
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


STATIC = (
    *("B P 2!", "B P!", "B", "B 2:int64!", "B 2!"),  # the mission
    *("B S 8!", "B 1:int64!", "B T 2:int64!"),
    *("B G G:float16", "B 2!", "B 2!", "B 2 M", "B M:bool", "B M:bool", "B"),
)
"""Shapes of a StaticScene's tensors in fused functions."""


def static_scene(scene: TensorDictBase, mission: Mission) -> StaticScene:
    """The StaticScene of scenes [B] with these missions; field and sizes are views of
    the scenes' storage."""
    half_size = (scene["size"][:, 1:].transpose(1, 2) / 2).contiguous()
    speed = scene["logged"][:, :, 0, 3] * scene["logged_valid"][:, :, 0]
    return StaticScene(
        mission,
        segments=segment_table(mission.points, mission.limit),
        row=torch.arange(len(half_size), device=half_size.device)[:, None],
        lights=lights_of(scene["light_state"], mission.light),
        field=scene["field"],
        origin=scene["field_origin"],
        size=scene["size"][:, 0],
        half_size=half_size,
        vehicle=scene["agent_type"][:, 1:] == VEHICLE,
        plain=scene["agent_type"][:, 1:] == OTHER,
        top_speed=speed.amax(1),
    )


def write_rows(static: StaticScene, rows: Tensor, new: StaticScene) -> None:
    """Overwrite rows [b] of a StaticScene, in place; views of the scenes' storage need
    no copy."""
    for old, fresh in zip(static.mission, new.mission, strict=True):
        old.index_copy_(0, rows, fresh)
    for name in ("segments", "lights", "half_size", "vehicle", "plain", "top_speed"):
        getattr(static, name).index_copy_(0, rows, getattr(new, name))


def segment_table(points: Tensor, limit: Tensor) -> Tensor:
    """Segments [B, P - 1, 8] of routes points [B, P, 2] with limits [B, P] m/s.

    Columns: first vertex (2), difference to the next vertex (2), tangent angle at the
    first vertex, turn of the tangent to the next vertex (as `scene.route.interpolate`
    takes them), limits at both ends (2).
    """
    begin = points[:, :-1]
    angles = torch.stack([*tangents(points), limit[:, :-1], limit[:, 1:]], -1)
    return torch.cat([begin, points[:, 1:] - begin, angles], -1)


def follow(static: StaticScene, xy: Tensor, hint: Tensor) -> FrenetPose:
    """Frenet pose of positions xy [B, 2] on the mission near arc length hint [B]."""
    place = project(xy[:, None], static.mission.points, hint=hint[:, None])
    return FrenetPose(*(value[:, 0] for value in place))


def look_along(static: StaticScene, s: Tensor) -> Ahead:
    """The mission at arc lengths s [B, K] m."""
    u = s / SPACING
    last = static.segments.shape[1] - 1
    index = u.floor().clamp(0, last)
    rows = static.row * (last + 1) + index.long()
    table = static.segments.flatten(0, 1).index_select(0, rows.flatten())
    x, y, ahead_x, ahead_y, tangent, turn, before, after = table.view(
        *s.shape, -1
    ).unbind(-1)
    t = u - index
    within = t.clamp(0, 1)
    return Ahead(
        x=x + t * ahead_x,
        y=y + t * ahead_y,
        heading=tangent + within * turn,
        curvature=torch.where(within == t, turn / SPACING, 0.0),
        limit=torch.where(u.round() > index, after, before),
    )


def seen_from(
    ego: Tensor,
    rotation: Tensor,
    *,
    x: Tensor,
    y: Tensor,
) -> tuple[Tensor, Tensor]:
    """Places in the frame of egos, each [B, K] m.

    Args:
        ego: [B, 4] states.
        rotation: [B, 2, 2], turns vectors into their frames.
        x, y: [B, K] m.
    """
    x = x - ego[:, :1]
    y = y - ego[:, 1:2]
    if torch.compiler.is_compiling():
        cos, sin = rotation[:, 0].split(1, 1)
        return cos * x + sin * y, cos * y - sin * x
    ahead, left = torch.stack([x, y], -1).bmm(rotation.transpose(1, 2)).unbind(-1)
    return ahead, left
