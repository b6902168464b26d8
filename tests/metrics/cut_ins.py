"""Concrete cut-ins on a straight road, all of a batch at once: does a driver survive
them (docs/reference/verdicts.md)."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.drivers import Driver, Observation, no_conflict
from e2rl.scenes.recording import DT

LENGTH, WIDTH = 4.3, 1.9  # m, of both vehicles
LATERAL_GAP = 1.6  # m between vehicles in the middle of neighbouring lanes of 3.5 m
LATERAL_ACCELERATION = 1.5  # m/s^2
DURATION = 40.0  # s after the lateral speed has been reached


class CutIn(NamedTuple):
    """Concrete cut-ins, each field [B]; gap and the lateral gap of 1.6 m hold when the
    lateral speed is reached."""

    speed: Tensor  # m/s, the ego's
    other_speed: Tensor  # m/s
    gap: Tensor  # m, bumper to bumper
    lateral_speed: Tensor  # m/s


def lateral_motion(cut_in: CutIn) -> tuple[Tensor, Tensor, int]:
    """(lateral speed, gap between the sides) of the other, each [T, B], and the step at
    which the gap is 1.6 m.

    Explicit Euler steps: the speed grows by 1.5 m/s^2, then is constant until the other
    is centred before the ego.
    """
    target = cut_in.lateral_speed
    start = -int((target.max() / (LATERAL_ACCELERATION * DT)).ceil())
    time = (
        torch.arange(
            start, round(DURATION / DT), dtype=target.dtype, device=target.device
        )[:, None]
        * DT
    )
    speed = torch.minimum((target + LATERAL_ACCELERATION * time).clamp(min=0), target)
    way = (speed * DT).cumsum(0) - speed * DT
    gap = LATERAL_GAP + way[-start] - way
    centred = gap <= -WIDTH
    return speed.masked_fill(centred, 0), gap.clamp(min=-WIDTH), -start


def simulate_cut_ins(driver: Driver, cut_in: CutIn) -> Tensor:
    """Whether [B] it crashes with the driver in the ego. Both speeds are constant but
    for it.

    Semi-implicit Euler steps of DT along the road: v' = max(v + a DT, 0), x' = x + v'
    DT.
    """
    lateral_speed, lateral_gap, start = lateral_motion(cut_in)
    speed = cut_in.speed
    other = cut_in.other_speed
    gap = cut_in.gap + (speed - other) * start * DT
    crash = torch.zeros_like(speed, dtype=torch.bool)
    length = torch.full_like(speed, LENGTH)
    state = no_conflict(speed)
    acceleration = torch.zeros_like(speed)
    for lateral, side in zip(lateral_speed, lateral_gap, strict=True):
        overlaps = side <= 0
        crash |= overlaps & (gap <= 0) & (gap >= -2 * LENGTH)
        observed = Observation(
            speed,
            acceleration,
            gap=gap,
            other_speed=other,
            lateral_gap=side,
            lateral_speed=lateral,
            length=length,
            other_length=length,
        )
        state, wanted = driver.step(state, observed)
        after = (speed + wanted * DT).clamp(min=0)
        acceleration = (after - speed) / DT
        speed = after
        gap = gap + (other - after) * DT
    return crash
