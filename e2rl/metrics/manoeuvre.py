"""Manoeuvres: knots of acceleration and lateral shift along a route, executed by the
unicycle within its limits."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.path import RoutePath
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate
from e2rl.sim import dynamics
from e2rl.sim.dynamics import midpoints
from e2rl.sim.settings import SimSettings

# Steps between knots (0.5 s): a shift of 2 m within one of them takes all the grip of
# the tyres.
KNOT_STEPS = 5
CREEP = 2.0  # m/s below which a vehicle shifts less than its knots ask
LEAST_INNER = 0.2  # of the length of a path beside its route, inside a bend


def knot_count(steps: int) -> int:
    """Number of knots for `steps` steps; the last one lies at their end or after it."""
    return -(-steps // KNOT_STEPS) + 1


def accelerations(knots: Tensor, steps: int) -> Tensor:
    """Accelerations [..., T] at the middle of each step, linear between knots [..., K]."""
    at = (torch.arange(steps, dtype=knots.dtype) + 0.5) / KNOT_STEPS
    index = at.long()
    return torch.lerp(knots[..., index], knots[..., index + 1], at - index)


def knots_of(accel: Tensor) -> Tensor:
    """Knots [..., K] that approximate accelerations [..., T]: their means around each
    knot."""
    steps = accel.shape[-1]
    at = torch.arange(knot_count(steps)) * KNOT_STEPS
    near = (torch.arange(steps) + 0.5 - at[:, None]).abs() < KNOT_STEPS
    weight = near.to(accel.dtype)
    return accel @ (weight / weight.sum(-1, keepdim=True)).T


def shifts(knots: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Lateral shift [m] and its rate [m/s], each [..., T+1] at steps 0..T: a uniform
    cubic B-spline of knots [..., K].

    The first two knots do not count: a shift begins with zero rate and curvature.
    """
    knots = torch.cat(  # the last knot is held
        [
            torch.zeros_like(knots[..., :2]),
            knots[..., 2:],
            knots[..., -1:].expand(*knots.shape[:-1], 2),
        ],
        -1,
    )
    at = torch.arange(steps + 1, dtype=knots.dtype) / KNOT_STEPS
    offset = at[:, None] - torch.arange(knots.shape[-1])
    gap = offset.abs()
    is_near = gap < 1
    is_far = gap < 2
    basis = torch.where(is_near, 2 / 3 - gap**2 + gap**3 / 2, (2 - gap) ** 3 / 6)
    slope = torch.where(is_near, -2 * gap + 1.5 * gap**2, -((2 - gap) ** 2) / 2)
    shift = knots @ (basis * is_far).T
    return shift, knots @ (slope * is_far * offset.sign()).T / (KNOT_STEPS * DT)


def execute(
    start: Tensor,
    route: Tensor,
    *,
    accel: Tensor,
    shift: Tensor,
    steps: int,
    sim: SimSettings,
) -> tuple[Tensor, Tensor]:
    """Actions [..., T, 2] and states [..., T, 4] at steps 1..T of manoeuvres.

    The path leaves the start's pose and returns onto the shifted route (`RoutePath`);
    its headings become yaw rates. The simulator's bounds hold, and braking and turning
    share the tyres' grip; where a bound binds, the vehicle leaves the path.

    Args:
        start: [..., 4].
        route: [..., P, 2].
        accel: [..., K] m/s^2, knots.
        shift: [..., K] m beside the route, knots.
        steps: T.
        sim: the ego's limits.
    """
    bounded = accelerations(accel, steps).clamp(-sim.max_braking, sim.max_acceleration)
    start_speed = start[..., 3:4]
    speed = torch.cat(
        [start_speed, dynamics.bounded_speed(start_speed, bounded * DT)], -1
    )
    mean_speed = midpoints(speed)
    driven = pad((mean_speed * DT).cumsum(-1), (1, 0))
    path = RoutePath(start, route)
    offset, slope = path.offset(driven)
    lateral, rate = shifts(shift, steps)
    offset = offset + lateral
    curvature = interpolate(route, path.s[..., None] + driven)[2]
    inner = (1 - curvature * offset).clamp(min=LEAST_INNER)
    slope = slope + inner * rate * speed / speed.clamp(min=CREEP) ** 2
    stretch = torch.hypot(inner, slope)
    along = driven.diff(dim=-1) * 2 / (stretch[..., 1:] + stretch[..., :-1])
    s = path.s[..., None] + pad(along.cumsum(-1), (1, 0))
    heading = interpolate(route, s)[1] + torch.atan2(slope, inner)
    heading = torch.cat([start[..., 2:3], heading[..., 1:]], -1)
    change = speed.diff(dim=-1) / DT
    grip = (dynamics.MAX_LATERAL**2 - change**2).clamp(min=0).sqrt()
    bound = torch.minimum(
        grip / mean_speed.clamp(min=1e-3), dynamics.yaw_rate_bound(mean_speed)
    ).clamp(max=sim.max_yaw_rate)
    yaw_rate = dynamics.wrap(heading.diff(dim=-1)) / DT
    yaw_rate = torch.maximum(torch.minimum(yaw_rate, bound), -bound)
    actions = torch.stack([bounded, yaw_rate], -1)
    return actions, dynamics.rollout(start, actions)


def peak_acceleration(start: Tensor, states: Tensor) -> Tensor:
    """Largest length [...] [m/s^2] of the longitudinal and lateral acceleration from
    start [..., 4] along states [..., T, 4]."""
    whole = torch.cat([start[..., None, :], states], -2)
    accel, yaw_rate = dynamics.inverse(whole).unbind(-1)
    speed = (whole[..., 1:, 3] + whole[..., :-1, 3]) / 2
    return torch.hypot(accel, yaw_rate * speed).amax(-1)
