"""The Intelligent Driver Model (IDM): Treiber, Hennecke and Helbing, Physical Review E 62 (2000), eqs. (3) and (4)."""

from typing import NamedTuple

import torch
from torch import Tensor


class IDMParameters(NamedTuple):
    """Headway T [s], standstill gap s0 [m], maximum acceleration a and comfortable braking b [m/s^2], exponent n."""

    headway: float
    standstill_gap: float
    acceleration: float
    braking: float
    exponent: float = 4.0


def desired_gap(speed: Tensor, leader_speed: Tensor, driver: IDMParameters) -> Tensor:
    """s* [...] m behind a leader: s0 + max(0, v T + v (v - v_leader) / (2 sqrt(a b)))."""
    closing = speed * (speed - leader_speed) / (2 * (driver.acceleration * driver.braking) ** 0.5)
    return driver.standstill_gap + (speed * driver.headway + closing).clamp(min=0)


def idm_acceleration(
    speed: Tensor, desired_speed: Tensor, gap: Tensor, leader_speed: Tensor, driver: IDMParameters, improved: bool
) -> Tensor:
    """IDM acceleration [...] m/s^2: the free-road term less a (s* / s)^2. Speeds in m/s; gap s [...] m, inf: no leader.

    The free-road term is a (1 - (v / v0)^n). `improved`: above the desired speed v0 it is -b (1 - (v0 / v)^(a n / b)),
    which brakes by b at most (Treiber and Kesting, Traffic Flow Dynamics, 2013, eq. 11.23).
    """
    a, b, n = driver.acceleration, driver.braking, driver.exponent
    interaction = (desired_gap(speed, leader_speed, driver) / gap.clamp(min=0.1)) ** 2
    if not improved:
        return a * (1 - (speed / desired_speed) ** n - interaction)
    below = a * (1 - (speed / desired_speed).clamp(max=1) ** n)
    above = -b * (1 - (desired_speed / speed.clamp(min=1e-3)).clamp(max=1) ** (a * n / b))
    return torch.where(speed > desired_speed, above, below) - a * interaction
