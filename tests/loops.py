"""A route that crosses itself: along +x, round a loop of 270 degrees to the left, and
across its own beginning."""

import math

import torch
from torch import Tensor

from e2rl.scenes.route import SPACING, interpolate
from e2rl.scenes.scene import SceneSet
from tests.synthetic import BACK, make_scenes

RADIUS, STRAIGHT = 25.0, 80.0  # m
CROSSING = (
    STRAIGHT - RADIUS,
    STRAIGHT + 1.5 * math.pi * RADIUS + RADIUS,
)  # m: arc lengths of the crossing


def loop(vertices: int = 150) -> Tensor:
    """The route [vertices, 2] from (-BACK, 0) on; CROSSING counts from there."""
    s = SPACING * torch.arange(vertices, dtype=torch.float32)
    turn = ((s - STRAIGHT) / RADIUS).clamp(0, 1.5 * math.pi)
    x = s.clamp(max=STRAIGHT) + RADIUS * turn.sin()
    y = RADIUS * (1 - turn.cos()) - (s - STRAIGHT - 1.5 * math.pi * RADIUS).clamp(min=0)
    return torch.stack([x - BACK, y], -1)


def track(route: Tensor, begin: float, speed: float, steps: int = 80) -> Tensor:
    """States [steps + 1, 4] of a vehicle that drives along a route [P, 2] from arc
    length `begin` at constant speed."""
    s = begin + 0.1 * speed * torch.arange(steps + 1)
    xy, heading, _ = interpolate(route, s)
    return torch.cat([xy, heading[:, None], torch.full_like(xy[:, :1], speed)], -1)


def loop_scenes(speed: float) -> SceneSet:
    """One scene in which the ego drives alone along the loop, as recorded, at constant
    speed."""
    scenes = make_scenes(1, num_vehicles=1, num_vrus=0, speed=speed)
    scenes.scenes["route_points"][0, 0] = loop()
    scenes.scenes["route_open"][:] = False
    scenes.scenes["logged"][0, :, 0] = track(loop(), BACK, speed=speed)
    return scenes
