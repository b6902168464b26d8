"""Hand-made collisions of an ego and its partner."""

import math

import torch

from e2rl.metrics.collisions import Collisions
from e2rl.metrics.contact import FRONT

LENGTH = 4.5  # m
WIDTH = 2.0
NO_LANES = torch.zeros(1, 2, 2, dtype=torch.float64), torch.full((1, 2), -1)


def straight(x, y, heading, speed, steps=80, at=0):
    """States [T+1, 4] of a vehicle that is at (x, y) at the step `at`."""
    time = 0.1 * (torch.arange(steps + 1, dtype=torch.float64) - at)
    return torch.stack(
        [
            x + speed * math.cos(heading) * time,
            y + speed * math.sin(heading) * time,
            torch.full_like(time, heading),
            torch.full_like(time, speed),
        ],
        -1,
    )


def pair(ego, partner, stop, kind=FRONT, red=(-1, -1), lanes=NO_LANES):
    """The Collisions of one ego [T+1, 4] and its partner [T+1, 4], which touch at the
    step `stop`."""
    states = torch.stack([ego, partner], 1)[None].double()
    return Collisions(
        hit=torch.tensor([True]),
        states=states,
        valid=torch.ones(states.shape[:3], dtype=torch.bool),
        size=torch.tensor([LENGTH, WIDTH], dtype=torch.float64).expand(1, 2, 2),
        stop=torch.tensor([stop]),
        before=torch.tensor([stop - 1]),
        kind=torch.tensor([kind]),
        red=torch.tensor([red]),
        lane_points=lanes[0],
        lane_index=lanes[1],
    )


def lane(*points):
    """One lane through points [n, 2]."""
    points = torch.tensor([points], dtype=torch.float64)
    return points, torch.zeros(points.shape[:2], dtype=torch.int64)
