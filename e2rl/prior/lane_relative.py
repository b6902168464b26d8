"""Lane-relative representation: a plan is accelerations along a route and offsets from it.

x [..., 12] of a vehicle: 10 acceleration knots at 0.5, 1.0, ..., 5.0 s (the knot at 0 is the current acceleration) and
two lateral knots, the offset half way and at the end of the lateral horizon. The decoder is closed form and
differentiable; a vehicle cannot leave its route but by its offset, and one that stands cannot move sideways.
"""

from dataclasses import dataclass, fields
from functools import cache

import torch
from torch import Tensor

from e2rl.scene.recording import DT
from e2rl.scene.route import interpolate, project
from e2rl.sim.dynamics import wrap

HORIZON = 50  # steps of DT
KNOTS, LATERAL = 10, 2
SIZE = KNOTS + LATERAL
KNOT_STEPS = HORIZON // KNOTS
ACCEL_SCALE = 1.0  # m/s^2 a unit of x
OFFSET_SCALE, BEND_SCALE = 0.5, 0.15  # m a unit: end offset; half-way offset against the mean of now and the end
LEAK = 0.05  # gradient that passes where the speed is held at 0


@dataclass
class LaneState:
    """Where vehicles are along their routes and in the plane, each [B, V].

    s, d [m]: arc length and offset (left positive); d1, d2: first and second derivative of d over travelled distance;
    v [m/s], a [m/s^2]; x, y, heading: pose; kappa [1/m]: curvature of the path being driven.
    """

    s: Tensor
    d: Tensor
    d1: Tensor
    d2: Tensor
    v: Tensor
    a: Tensor
    x: Tensor
    y: Tensor
    heading: Tensor
    kappa: Tensor

    def map(self, function) -> "LaneState":
        """The same fields after a function of a tensor."""
        return LaneState(*(function(getattr(self, field.name)) for field in fields(self)))

    def states(self) -> Tensor:
        """[B, V, 4] x, y, heading, speed."""
        return torch.stack([self.x, self.y, self.heading, self.v], -1)


def locate(states: Tensor, accel: Tensor, yaw_rate: Tensor, points: Tensor, hint: Tensor | None = None) -> LaneState:
    """LaneState of vehicles states [B, V, 4] on their routes points [B, V, P, 2]; hint [B, V]: expected arc length."""
    s, d, _ = (
        value[..., 0] for value in project(states[..., None, :2], points, None if hint is None else hint[..., None])
    )
    _, heading, curvature = (
        value[..., 0, :] if value.ndim == 4 else value[..., 0] for value in interpolate(points, s[..., None])
    )
    turn = wrap(states[..., 2] - heading)
    v = states[..., 3]
    kappa = (yaw_rate / v.clamp(min=1.0)).clamp(-0.25, 0.25)
    d1 = torch.tan(turn.clamp(-1.0, 1.0)) * (1 - curvature * d).clamp(min=0.3)
    d2 = (kappa - curvature).clamp(-0.1, 0.1)
    return LaneState(s, d, d1, d2, v, accel, states[..., 0], states[..., 1], states[..., 2], kappa)


@cache
def _speed_basis(device: torch.device) -> Tensor:
    """[HORIZON, KNOTS + 1]: speed gained by each step per unit of each acceleration knot (trapezoid, exact)."""
    time = torch.arange(HORIZON + 1, dtype=torch.float64) / KNOT_STEPS
    hat = (1 - (time[:, None] - torch.arange(KNOTS + 1)).abs()).clamp(min=0)
    return ((hat[1:] + hat[:-1]) / 2 * DT).cumsum(0).float().to(device)


def way_weights(device=None) -> Tensor:
    """[KNOTS]: mean way driven over the horizon that a unit of each acceleration knot adds, m."""
    basis = _speed_basis(torch.device(device or "cpu"))
    return ((torch.cat([torch.zeros_like(basis[:1]), basis[:-1]]) + basis) / 2 * DT).cumsum(0).mean(0)[1:]


@cache
def _offset_basis(device: torch.device) -> Tensor:
    """[4, 4]: polynomial coefficients of u^3..u^6 from (d(1/2), d(1), d'(1), d''(1)) less the given lower terms."""
    power = torch.arange(3, 7, dtype=torch.float64)
    rows = [0.5**power, torch.ones(4, dtype=torch.float64), power, power * (power - 1)]
    return torch.linalg.inv(torch.stack(rows)).float().to(device)


def lateral_horizon(v: Tensor) -> Tensor:
    """Distance over which the offset settles, m."""
    return (4.0 * v).clamp(10.0, 80.0)


def offset_coefficients(state: LaneState, half: Tensor, end: Tensor) -> Tensor:
    """Coefficients [..., 7] of d(u), u = travelled / lateral_horizon: starts as the state does, passes `half` at 1/2
    and `end` at 1, where it is flat."""
    reach = lateral_horizon(state.v)
    low = torch.stack([state.d, state.d1 * reach, 0.5 * state.d2 * reach**2], -1)
    at_half = low[..., 0] + 0.5 * low[..., 1] + 0.25 * low[..., 2]
    slope, bend = low[..., 1] + 2 * low[..., 2], 2 * low[..., 2]
    target = torch.stack([half - at_half, end - low.sum(-1), -slope, -bend], -1)
    return torch.cat([low, target @ _offset_basis(low.device).T], -1)


def speeds(state: LaneState, knots: Tensor) -> tuple[Tensor, Tensor]:
    """Speed and travelled distance [..., HORIZON] at each step for acceleration knots [..., KNOTS], m/s^2.

    Speeds are held at 0 from below; a small gradient still passes there.
    """
    free = state.v[..., None] + torch.cat([state.a[..., None], knots], -1) @ _speed_basis(knots.device).T
    below = free.clamp(max=0)
    v = free.clamp(min=0) + LEAK * (below - below.detach())
    before = torch.cat([state.v[..., None], v[..., :-1]], -1)
    return v, ((v + before) / 2 * DT).cumsum(-1)


def split(x: Tensor, state: LaneState) -> tuple[Tensor, Tensor, Tensor]:
    """Acceleration knots [..., KNOTS] m/s^2 and lateral offsets half way and at the end, m, of x [..., SIZE]."""
    end = OFFSET_SCALE * x[..., KNOTS + 1]
    half = 0.5 * (state.d + end) + BEND_SCALE * x[..., KNOTS]
    return ACCEL_SCALE * x[..., :KNOTS], half, end


def decode(x: Tensor, state: LaneState, points: Tensor, steps: slice = slice(None)) -> LaneState:
    """Plans [..., V, HORIZON] (every field with a trailing time axis) of x [..., V, SIZE] on routes [..., V, P, 2], or
    those `steps` of them."""
    knots, half, end = split(x, state)
    v, travelled = speeds(state, knots)
    accel = torch.diff(v, dim=-1, prepend=state.v[..., None])[..., steps] / DT
    v, travelled = v[..., steps], travelled[..., steps]
    reach = lateral_horizon(state.v)[..., None]
    u = (travelled / reach).clamp(max=1.0)
    c = offset_coefficients(state, half, end)
    d, d1, d2 = polynomial(c, u)
    d1, d2 = d1 / reach, d2 / reach**2
    s = state.s[..., None] + travelled
    xy, heading, curvature = interpolate(points, s)
    normal = torch.stack([-torch.sin(heading), torch.cos(heading)], -1)
    xy = xy + d[..., None] * normal
    heading = heading + torch.atan(d1 / (1 - curvature * d).clamp(min=0.3))
    return LaneState(s, d, d1, d2, v, accel, xy[..., 0], xy[..., 1], heading, curvature + d2)


class _Polynomial(torch.autograd.Function):
    """Horner's rule with its derivative in closed form: what autograd would record are a hundred small operations."""

    @staticmethod
    def forward(ctx, c: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        value, first, second, third = horner(c, u)
        ctx.save_for_backward(c, u, first, second, third)
        return value, first, second

    @staticmethod
    def backward(ctx, *grads: Tensor) -> tuple[Tensor, Tensor]:
        c, u, first, second, third = ctx.saved_tensors
        powers = [torch.ones_like(u), u]
        for _ in range(5):
            powers.append(powers[-1] * u)
        table = torch.stack(powers, -2)  # [..., 7, H]
        of_value, of_first, of_second = (
            (table[..., : 7 - shift, :] * grad[..., None, :]).sum(-1) for shift, grad in enumerate(grads)
        )
        power, pad = torch.arange(7, device=c.device, dtype=c.dtype), torch.nn.functional.pad
        of_c = of_value + power * pad(of_first, (1, 0)) + power * (power - 1) * pad(of_second, (2, 0))
        return of_c.sum_to_size(c.shape), grads[0] * first + grads[1] * second + grads[2] * third


def polynomial(c: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Value, first and second derivative (in u) of the polynomial c [..., 7] at u [..., H]."""
    return _Polynomial.apply(c, u)


def horner(c: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value and three derivatives of the polynomial c [..., 7] at u [..., H], by Horner's rule."""
    value, first = c[..., 6, None] * u + c[..., 5, None], c[..., 6, None]
    second = third = torch.zeros_like(first)
    for k in range(4, -1, -1):
        third = third * u + 3 * second
        second = second * u + (first + first)
        first = first * u + value
        value = value * u + c[..., k, None]
    return value, first, second, third


def fit(track: LaneState, known: Tensor, state: LaneState) -> tuple[Tensor, Tensor]:
    """x [..., V, SIZE] that reproduces recorded motion, and its mean error [..., V] in m.

    track: fields s, d, v [..., V, HORIZON] of the steps ahead; known: mask; state: at the start. Ridge least squares on
    speed and distance for the knots (second differences damped), on offset for the lateral knots.
    """
    knots = _fit_knots(track, known, state)
    v, travelled = speeds(state, knots)
    reach = lateral_horizon(state.v)[..., None]
    u = (travelled / reach).clamp(max=1.0)
    zero = torch.zeros_like(state.d)
    base = polynomial(offset_coefficients(state, zero, zero), u)[0]
    still = LaneState(*(zero for _ in fields(LaneState)))
    still.v = state.v
    parts = [polynomial(offset_coefficients(still, *pair), u)[0] for pair in ((zero + 1, zero), (zero, zero + 1))]
    basis = torch.stack(parts, -1) * known[..., None]
    # In units of x: half = (d + end) / 2 + BEND x_0, end = OFFSET x_1.
    unit = torch.stack([BEND_SCALE * basis[..., 0], OFFSET_SCALE * (basis[..., 1] + 0.5 * basis[..., 0])], -1)
    rest = (track.d - base - 0.5 * state.d[..., None] * parts[0]) * known
    gram = unit.transpose(-1, -2) @ unit + torch.diag(unit.new_tensor([0.05, 0.02]))
    lateral = torch.linalg.solve(gram, (unit * rest[..., None]).sum(-2)[..., None])[..., 0]
    left = (rest - (unit * lateral[..., None, :]).sum(-1)).abs() + (track.s - state.s[..., None] - travelled).abs()
    error = (left * known).sum(-1) / known.sum(-1).clamp(min=1)
    return torch.cat([knots / ACCEL_SCALE, lateral], -1), error


def _fit_knots(track: LaneState, known: Tensor, state: LaneState) -> Tensor:
    basis = _speed_basis(known.device)
    distance = (torch.cat([torch.zeros_like(basis[:1]), basis[:-1]]) + basis) / 2 * DT
    distance = distance.cumsum(0)
    time = DT * torch.arange(1, HORIZON + 1, device=known.device)
    weight = known.to(basis.dtype)[..., None]
    rows = torch.cat([weight * basis[:, 1:], 0.5 * weight * distance[:, 1:]], -2)
    speed = track.v - state.v[..., None] - state.a[..., None] * basis[:, 0]
    way = track.s - state.s[..., None] - state.v[..., None] * time - state.a[..., None] * distance[:, 0]
    target = torch.cat([weight[..., 0] * speed, 0.5 * weight[..., 0] * way], -1)
    second = torch.diff(torch.eye(KNOTS + 1, device=known.device), n=2, dim=0)
    damp = 0.02 * second[:, 1:].T @ second[:, 1:] + 1e-3 * torch.eye(KNOTS, device=known.device)
    pull = -0.02 * second[:, 1:].T @ second[:, 0] * state.a[..., None]
    gram = rows.transpose(-1, -2) @ rows + damp
    right = (rows.transpose(-1, -2) @ target[..., None])[..., 0] + pull
    return torch.linalg.solve(gram, right[..., None])[..., 0].clamp(-8.0, 5.0)
