"""Feasibility bounds: how hard each vehicle may accelerate in the part of a plan that is executed.

They are part of the simulated traffic for every method alike, and stand in each table's caption. What they allow is a
cap on acceleration; they never push a vehicle forward.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.features import curve_speed
from e2rl.prior.lane_relative import LaneState
from e2rl.prior.leaders import FREE, Ahead, idm_acceleration
from e2rl.prior.routed import RoutedScene


@dataclass(frozen=True)
class BoundSettings:
    """Headway [s], jam gap [m], acceleration and comfortable braking [m/s^2] of the leader bound and its floor; lateral
    acceleration and braking of the curve bound; time gap [s] and braking of the crossing bound; each can be off.
    onset [m/s^2]: what a bound may take off the current acceleration at once, the rest follows over half a second."""

    leader: bool = True
    headway: float = 0.5
    jam: float = 1.2
    accel: float = 3.0
    brake: float = 3.5
    floor: float = -7.0
    curve: bool = True
    curve_lateral: float = 4.2
    curve_brake: float = 1.2
    curve_floor: float = -3.0
    crossing: bool = True
    crossing_time: float = 2.0
    crossing_brake: float = 5.0
    onset: float = 2.0


def acceleration_caps(
    settings: BoundSettings, routed: RoutedScene, state: LaneState, agents: Tensor, present: Tensor, exempt: Tensor
) -> Tensor:
    """Highest acceleration [B, V] each vehicle may take now.

    agents [B, N, 4], present [B, N]: everybody now; exempt [B, V]: vehicles whose bounds ignore the ego (adversaries).
    """
    size = routed.size
    vehicles = state.s.shape[1]
    width, length = size[:, :vehicles, 1], size[:, :vehicles, 0]
    cap = torch.full_like(state.v, 20.0)
    if settings.leader:
        free = torch.full_like(state.v, 60.0)
        ahead = Ahead(state.s, width, length, routed.points, agents, size, present, state.d.abs())
        gap, speed, _ = ahead.nearest(state.d, blind=exempt)
        bound = idm_acceleration(state.v, free, gap, speed.clamp(min=0), settings.headway, settings.jam,
                                 settings.accel, settings.brake).clamp(min=settings.floor)
        cap = torch.where(gap < FREE, torch.minimum(cap, bound), cap)
    if settings.curve:
        allowed = curve_speed(state, routed.points, settings.curve_lateral, settings.curve_brake)
        cap = torch.minimum(cap, ((allowed - state.v) / 0.5).clamp(min=settings.curve_floor))
    if settings.crossing:
        cap = torch.minimum(cap, _crossing(settings, routed, state, present[:, :vehicles], exempt, length))
    return cap


def _crossing(
    settings: BoundSettings, routed: RoutedScene, state: LaneState, present: Tensor, exempt: Tensor, length: Tensor
) -> Tensor:
    """Of two vehicles whose routes cross, the later by less than `crossing_time` stops before the place if it can."""
    mine = routed.conflict_s - state.s[..., None]
    theirs = mine.transpose(1, 2)
    v = state.v.clamp(min=0.5)
    arrive, other = mine / v[..., None], theirs / v[:, None, :]
    crossing = routed.crossing.abs().clamp(max=torch.pi) > 0.35
    moving = (present & (state.v > 0.5))[:, None, :]
    active = (routed.conflict & crossing & (mine > 0) & (theirs > 0) & moving & (arrive < 8.0)
              & (arrive >= other) & (arrive - other < settings.crossing_time))
    active[..., 0] &= ~exempt
    room = (mine - length[..., None] / 2 - 3.0).clamp(min=0.1)
    need = state.v[..., None] ** 2 / (2 * room)
    stops = active & (need <= settings.crossing_brake) & (need > 0.8)
    return torch.where(stops, -need, 20.0).amin(-1)
