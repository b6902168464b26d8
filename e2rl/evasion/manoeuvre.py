"""Manoeuvres: knots of acceleration and lateral shift along a route, executed by the unicycle within its limits."""

import torch
from torch import Tensor

from e2rl.ego.path import RoutePath
from e2rl.scene.recording import DT
from e2rl.scene.route import interpolate
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings

KNOT_STEPS = 5  # steps between knots (0.5 s): a shift of 2 m within one of them takes all the grip of the tyres
CREEP = 2.0  # m/s below which a vehicle shifts less than its knots ask: one that stands cannot move sideways


def knot_count(steps: int) -> int:
    """Number of knots for `steps` steps; the last one lies at their end or after it."""
    return -(-steps // KNOT_STEPS) + 1


def accelerations(knots: Tensor, steps: int) -> Tensor:
    """Accelerations [..., T] at the middle of each step, linear between knots [..., K]."""
    at = (torch.arange(steps, device=knots.device, dtype=knots.dtype) + 0.5) / KNOT_STEPS
    index = at.long()
    return torch.lerp(knots[..., index], knots[..., index + 1], at - index)


def knots_of(accel: Tensor) -> Tensor:
    """Knots [..., K] that approximate accelerations [..., T]: their means around each knot."""
    steps = accel.shape[-1]
    at = torch.arange(knot_count(steps), device=accel.device) * KNOT_STEPS
    near = (torch.arange(steps, device=accel.device) + 0.5 - at[:, None]).abs() < KNOT_STEPS
    weight = near.to(accel.dtype)
    return accel @ (weight / weight.sum(-1, keepdim=True)).T


def shifts(knots: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Lateral shift [m] and its rate [m/s], each [..., T+1] at steps 0..T: a uniform cubic B-spline of knots [..., K].

    The first two knots do not count: a shift begins with zero rate and curvature.
    """
    count = knots.shape[-1]
    at = torch.arange(steps + 1, device=knots.device, dtype=knots.dtype) / KNOT_STEPS
    since = at[:, None] - torch.arange(count + 2, device=knots.device)  # two more: the last knot is held
    gap = since.abs()
    near, far = gap < 1, gap < 2
    basis = torch.where(near, 2 / 3 - gap**2 + gap**3 / 2, (2 - gap) ** 3 / 6) * far
    slope = torch.where(near, -2 * gap + 1.5 * gap**2, -((2 - gap) ** 2) / 2) * far * since.sign()
    held = knots[..., -1:].expand(*knots.shape[:-1], 2)
    held = torch.cat([torch.zeros_like(knots[..., :2]), knots[..., 2:], held], -1)
    return held @ basis.T, held @ slope.T / (KNOT_STEPS * DT)


def execute(
    start: Tensor, route: Tensor, accel: Tensor, shift: Tensor, steps: int, sim: SimSettings
) -> tuple[Tensor, Tensor]:
    """(actions [..., T, 2], states [..., T, 4] at steps 1..T) of manoeuvres from start [..., 4].

    accel [..., K] m/s^2 and shift [..., K] m beside route [..., P, 2] are knots. The path leaves the start's pose and
    returns onto the shifted route (`RoutePath`); its headings become yaw rates. Acceleration, braking and yaw rate
    keep the simulator's bounds, and braking and turning share the tyres' grip. Where a bound binds, the vehicle leaves
    the path; the result is what it really does.
    """
    bounded = accelerations(accel, steps).clamp(-sim.max_braking, sim.max_acceleration)
    v0 = start[..., 3:4]
    speed = torch.cat([v0, dynamics.bounded_speed(v0, bounded * DT)], -1)
    mean, change = (speed[..., 1:] + speed[..., :-1]) / 2, speed.diff(dim=-1) / DT
    driven = torch.nn.functional.pad((mean * DT).cumsum(-1), (1, 0))
    path = RoutePath(start, route)
    offset, slope = path.offset(driven)
    lateral, rate = shifts(shift, steps)
    offset, curvature = offset + lateral, interpolate(route, path.s[..., None] + driven)[2]
    inner = (1 - curvature * offset).clamp(min=0.2)
    slope = slope + inner * rate * speed / speed.clamp(min=CREEP) ** 2
    stretch = torch.hypot(inner, slope)
    along = driven.diff(dim=-1) * 2 / (stretch[..., 1:] + stretch[..., :-1])
    s = path.s[..., None] + torch.nn.functional.pad(along.cumsum(-1), (1, 0))
    heading = interpolate(route, s)[1] + torch.atan2(slope, inner)
    heading = torch.cat([start[..., 2:3], heading[..., 1:]], -1)
    grip = (dynamics.MAX_LATERAL**2 - change**2).clamp(min=0).sqrt() / mean.clamp(min=1e-3)
    bound = torch.minimum(grip, dynamics.yaw_rate_bound(mean)).clamp(max=sim.max_yaw_rate)
    yaw_rate = dynamics.wrap(heading.diff(dim=-1)) / DT
    actions = torch.stack([bounded, torch.maximum(torch.minimum(yaw_rate, bound), -bound)], -1)
    return actions, dynamics.rollout(start, actions)


def peak_acceleration(start: Tensor, states: Tensor) -> Tensor:
    """Largest length [...] [m/s^2] of the longitudinal and lateral acceleration from start [..., 4] along states
    [..., T, 4]."""
    whole = torch.cat([start[..., None, :], states], -2)
    actions = dynamics.inverse(whole)
    speed = (whole[..., 1:, 3] + whole[..., :-1, 3]) / 2
    return torch.hypot(actions[..., 0], actions[..., 1] * speed).amax(-1)
