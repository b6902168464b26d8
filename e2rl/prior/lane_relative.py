"""Lane-relative plans: accelerations along a route and lateral offsets from it.

x [..., 12] of a vehicle holds 10 acceleration knots at 0.5, 1.0, ..., 5.0 s (the knot
at 0 is the current acceleration) and two lateral knots: the offset half way along and
at the end of the lateral horizon. The decoder is closed form and differentiable. A
vehicle leaves its route by its offset only, and one that stands cannot move sideways.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate, project, tangents
from e2rl.sim.dynamics import at_least, wrap

HORIZON = 50  # steps of DT
KNOTS = 10
SIZE = KNOTS + 2
KNOT_STEPS = HORIZON // KNOTS
ACCEL_SCALE = 1.0  # m/s^2 a unit of x
OFFSET_SCALE = 0.5  # m a unit of x: end offset
# m a unit of x: half-way offset from the mean of the present and the end offset.
BEND_SCALE = 0.15
# m of a vehicle's line per m of its route, at least: deep inside a bend.
LEAST_STRETCH = 0.3
LEAK = 0.05  # gradient that passes where the speed is held at 0
# Weight of the squared second differences of fitted accelerations: what changes faster
# is noise of the recording.
ROUGHNESS = 0.3
KNOT_DAMPING = 1e-3  # ridge on fitted accelerations
LATERAL_DAMPING = (0.05, 0.02)  # ridge on fitted lateral knots
HARDEST = (-8.0, 5.0)  # m/s^2, range of fitted accelerations


@dataclass
class LaneState:
    """Frenet and Cartesian states of vehicles, each [B, V]; of planned motion each [B,
    V, HORIZON].

    s, d [m]: arc length and offset (left positive); d1, d2: first and second derivative
    of d over travelled distance; v [m/s], a [m/s^2]; x, y [m], heading [rad]; kappa
    [1/m]: curvature of the driven path.
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

    @classmethod
    def from_states(
        cls,
        states: Tensor,
        s: Tensor,
        d: Tensor,
    ) -> "LaneState":
        """States [..., 4] with arc length s and offset d [...]; the rest is 0."""
        x, y, heading, v = states.unbind(-1)
        zero = torch.zeros_like(v)
        return cls(s, d, zero, zero, v, zero, x, y, heading, zero)

    def map(self, function: Callable[..., Tensor], *others: "LaneState") -> "LaneState":
        """A LaneState with `function` applied to every field, and to those of others
        beside it."""
        states = (vars(state).values() for state in (self, *others))
        return LaneState(*map(function, *states))

    def put(self, rows: tuple[Tensor, ...], other: "LaneState") -> "LaneState":
        """A LaneState with `rows` of every field replaced by `other`."""
        return self.map(lambda old, new: old.index_put(rows, new), other)

    def states(self) -> Tensor:
        """[..., 4]: x, y, heading, speed."""
        return torch.stack([self.x, self.y, self.heading, self.v], -1)


def select(rows: Tensor, chosen: LaneState, other: LaneState) -> LaneState:
    """The fields of `chosen` for vehicles rows [B, V], of `other` elsewhere; fields
    [B, V] or [B, V, HORIZON]."""
    rows = rows.view(*rows.shape, *[1] * (chosen.v.ndim - rows.ndim))
    return chosen.map(lambda one, two: torch.where(rows, one, two), other)


def locate(
    states: Tensor,
    accel: Tensor,
    *,
    yaw_rate: Tensor,
    points: Tensor,
    hint: Tensor | None = None,
) -> LaneState:
    """LaneState of vehicles on their routes.

    Args:
        states: [B, V, 4].
        accel: [B, V] m/s^2.
        yaw_rate: [B, V] rad/s.
        points: [B, V, P, 2] m, the routes.
        hint: [B, V] m, expected arc length; None: anywhere.
    """
    if hint is None:
        return locate_anywhere(states, accel, yaw_rate, points)
    return locate_near(states, accel, yaw_rate, points, hint)


@fused("B V 4", "B V", "B V", "B V P 2!")
def locate_anywhere(
    states: Tensor,
    accel: Tensor,
    yaw_rate: Tensor,
    points: Tensor,
) -> LaneState:
    """`locate` without a hint.

    Args:
        states, accel, yaw_rate, points: of `locate`.
    """
    return _locate(
        states,
        accel,
        yaw_rate=yaw_rate,
        points=points,
        hint=None,
    )


@fused("B V 4", "B V", "B V", "B V P 2!", "B V")
def locate_near(
    states: Tensor,
    accel: Tensor,
    yaw_rate: Tensor,
    points: Tensor,
    hint: Tensor,
) -> LaneState:
    """`locate` with a hint.

    Args:
        states, accel, yaw_rate, points, hint: of `locate`.
    """
    hint = hint[..., None]
    return _locate(
        states,
        accel,
        yaw_rate=yaw_rate,
        points=points,
        hint=hint,
    )


def _locate(
    states: Tensor,
    accel: Tensor,
    *,
    yaw_rate: Tensor,
    points: Tensor,
    hint: Tensor | None,
) -> LaneState:
    x, y, heading, v = states.unbind(-1)
    place = project(states[..., None, :2], points, hint=hint)
    s, d, _ = (value[..., 0] for value in place)
    _, route_heading, curvature = interpolate(points, s[..., None])
    curvature = curvature[..., 0]
    turn = wrap(heading - route_heading[..., 0])
    kappa = (yaw_rate / at_least(v, 1.0)).clamp(-0.25, 0.25)
    stretch = (1 - curvature * d).clamp(min=LEAST_STRETCH)
    d1 = torch.tan(turn.clamp(-1.0, 1.0)) * stretch
    d2 = (kappa - curvature).clamp(-0.1, 0.1)
    return LaneState(s, d, d1, d2, v, accel, x, y, heading, kappa)


@cache
def _speed_basis(device: torch.device) -> Tensor:
    """[HORIZON, KNOTS + 1]: speed gained up to each step per unit of each acceleration
    knot (trapezoids, exact)."""
    time = torch.arange(HORIZON + 1, dtype=torch.float64) / KNOT_STEPS
    hat = (1 - (time[:, None] - torch.arange(KNOTS + 1)).abs()).clamp(min=0)
    return ((hat[1:] + hat[:-1]) / 2 * DT).cumsum(0).float().to(device)


@cache
def _distance_basis(device: torch.device) -> Tensor:
    """[HORIZON, KNOTS + 1]: distance gained up to each step per unit of each
    acceleration knot."""
    speed = _speed_basis(device)
    before = torch.cat([torch.zeros_like(speed[:1]), speed[:-1]])
    return ((before + speed) / 2 * DT).cumsum(0)


@cache
def _offset_basis(device: torch.device) -> Tensor:
    """[4, 4]: polynomial coefficients of u^3..u^6 from (d(1/2), d(1), d'(1), d''(1))
    less what the lower terms give."""
    power = torch.arange(3, 7, dtype=torch.float64)
    rows = [0.5**power, torch.ones(4, dtype=torch.float64), power, power * (power - 1)]
    return torch.linalg.inv(torch.stack(rows)).float().to(device)


def lateral_horizon(v: Tensor) -> Tensor:
    """Distance over which the offset settles, m."""
    return (4.0 * v).clamp(10.0, 80.0)


def offset_coefficients(state: LaneState, half: Tensor, end: Tensor) -> Tensor:
    """Coefficients [..., 7] of d(u), u = travelled distance / lateral_horizon.

    The polynomial starts as the state does, passes `half` [m] at u = 1/2 and `end` at u
    = 1, where it is flat.
    """
    reach = lateral_horizon(state.v)
    low = torch.stack([state.d, state.d1 * reach, 0.5 * state.d2 * reach**2], -1)
    d, slope, bend = low.unbind(-1)
    at_half = d + 0.5 * slope + 0.25 * bend
    target = [half - at_half, end - low.sum(-1), -(slope + 2 * bend), -(2 * bend)]
    return torch.cat([low, torch.stack(target, -1) @ _offset_basis(low.device).T], -1)


def speeds(state: LaneState, knots: Tensor) -> tuple[Tensor, Tensor]:
    """Speed and travelled distance [..., HORIZON] at each step for acceleration knots
    [..., KNOTS], m/s^2.

    Speeds are held at 0 from below; a small gradient still passes there.
    """
    accel = torch.cat([state.a[..., None], knots], -1)
    free = state.v[..., None] + accel @ _speed_basis(knots.device).T
    below = free.clamp(max=0)
    v = free.clamp(min=0) + LEAK * (below - below.detach())
    before = torch.cat([state.v[..., None], v[..., :-1]], -1)
    return v, ((v + before) / 2 * DT).cumsum(-1)


def split(x: Tensor, state: LaneState) -> tuple[Tensor, Tensor, Tensor]:
    """Acceleration knots [..., KNOTS] m/s^2 and lateral offsets half way and at the end
    [...], m, of x [..., SIZE]."""
    end = OFFSET_SCALE * x[..., KNOTS + 1]
    half = 0.5 * (state.d + end) + BEND_SCALE * x[..., KNOTS]
    return ACCEL_SCALE * x[..., :KNOTS], half, end


def decode(
    x: Tensor,
    state: LaneState,
    points: Tensor,
    *,
    steps: slice = slice(None),
    along: tuple[Tensor, Tensor] | None = None,
) -> LaneState:
    """Planned motion, fields [..., V, HORIZON] or those `steps` of them.

    Args:
        x: [..., V, SIZE].
        state: fields [..., V], where the motion begins.
        points: [..., V, P, 2] m, routes.
        steps: of the motion, all by default.
        along: the routes' tangents, see `interpolate`.
    """
    knots, half, end = split(x, state)
    v, travelled = speeds(state, knots)
    accel = (
        torch.diff(
            v,
            dim=-1,
            prepend=state.v[..., None],
        )[..., steps]
        / DT
    )
    v = v[..., steps]
    travelled = travelled[..., steps]
    reach = lateral_horizon(state.v)[..., None]
    coefficients = offset_coefficients(state, half, end)
    d, d1, d2 = polynomial(coefficients, (travelled / reach).clamp(max=1.0))
    d1 = d1 / reach
    d2 = d2 / reach**2
    s = state.s[..., None] + travelled
    xy, heading, curvature = interpolate(points, s, tangents=along)
    normal = torch.stack([-torch.sin(heading), torch.cos(heading)], -1)
    x, y = (xy + d[..., None] * normal).unbind(-1)
    heading = heading + torch.atan(d1 / (1 - curvature * d).clamp(min=LEAST_STRETCH))
    return LaneState(s, d, d1, d2, v, accel, x, y, heading, kappa=curvature + d2)


@fused(f"B V {SIZE}", "B V", "B V P 2!")
def decode_plans(x: Tensor, state: LaneState, points: Tensor) -> LaneState:
    """`decode` of every vehicle's plan."""
    return decode(x, state, points)


@fused(f"G O {SIZE}", "G O", "G P 2!")
def decode_options(x: Tensor, state: LaneState, points: Tensor) -> LaneState:
    """`decode` of O plans of each of G vehicles on its route."""
    routes = points[:, None]
    return decode(x, state, routes, along=tangents(routes))


class _Polynomial(torch.autograd.Function):
    """Horner's rule with its derivative in closed form; autograd would record a hundred
    small operations."""

    @staticmethod
    def forward(ctx: Any, c: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        value = c[..., 6, None] * u + c[..., 5, None]
        first = c[..., 6, None]
        second = third = torch.zeros_like(first)
        for k in range(4, -1, -1):
            third = third * u + 3 * second
            second = second * u + (first + first)
            first = first * u + value
            value = value * u + c[..., k, None]
        ctx.save_for_backward(c, u, first, second, third)
        return value, first, second

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        c, u, first, second, third = ctx.saved_tensors
        powers = [torch.ones_like(u), u]
        for _ in range(5):
            powers.append(powers[-1] * u)
        table = torch.stack(powers, -2)  # [..., 7, H]
        of_value, of_first, of_second = (
            (table[..., : 7 - shift, :] * grad[..., None, :]).sum(-1)
            for shift, grad in enumerate(grads)
        )
        power = torch.arange(
            7,
            device=c.device,
            dtype=c.dtype,
        )
        pad = torch.nn.functional.pad
        of_c = of_value + power * pad(of_first, (1, 0))
        of_c = of_c + power * (power - 1) * pad(of_second, (2, 0))
        of_u = grads[0] * first + grads[1] * second + grads[2] * third
        return of_c.sum_to_size(c.shape), of_u


def polynomial(c: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Value, first and second derivative (in u) of the polynomial c [..., 7] at u [...,
    H]."""
    return _Polynomial.apply(c, u)


def fit(
    track: LaneState,
    known: Tensor | None,
    state: LaneState,
) -> tuple[Tensor, Tensor]:
    """x [..., V, SIZE] that reproduces recorded motion, and its mean error [..., V] in
    m.

    track: fields s, d, v [..., V, HORIZON] of the steps ahead; known: their mask, None:
    all; state: at the start. Ridge least squares on speed and distance for the knots
    (second differences damped), on offset for the lateral knots.
    """
    knots = _fit_knots(track, known, state=state)
    mask = torch.ones_like(track.v) if known is None else known
    _, travelled = speeds(state, knots)
    u = (travelled / lateral_horizon(state.v)[..., None]).clamp(max=1.0)

    def offsets(begin: LaneState, half: Tensor, end: Tensor) -> Tensor:
        return polynomial(offset_coefficients(begin, half, end), u)[0]

    zero = torch.zeros_like(state.d)
    still = replace(state.map(torch.zeros_like), v=state.v)
    of_half = offsets(still, zero + 1, zero)
    half = of_half * mask
    end = offsets(still, zero, zero + 1) * mask
    # In units of x: half = (d + end) / 2 + BEND_SCALE x_0, end = OFFSET_SCALE x_1.
    unit = torch.stack([BEND_SCALE * half, OFFSET_SCALE * (end + 0.5 * half)], -1)
    base = offsets(state, zero, zero)
    rest = (track.d - base - 0.5 * state.d[..., None] * of_half) * mask
    lateral = ridge(unit, rest, torch.diag(unit.new_tensor(LATERAL_DAMPING)))
    beside = (rest - (unit * lateral[..., None, :]).sum(-1)).abs()
    left = beside + (track.s - state.s[..., None] - travelled).abs()
    error = (left * mask).sum(-1) / mask.sum(-1).clamp(min=1)
    return torch.cat([knots / ACCEL_SCALE, lateral], -1), error


def ridge(unit: Tensor, target: Tensor, damping: Tensor) -> Tensor:
    """Weights [..., D] of columns unit [..., H, D] that fit target [..., H], with
    damping [D, D] on their squares."""
    right = (unit * target[..., None]).sum(-2)
    if torch.compiler.is_compiling():  # of two columns; the compiler has no `solve`
        first, second = unit.unbind(-1)
        a = (first * first).sum(-1) + damping[0, 0]
        b = (first * second).sum(-1)
        d = (second * second).sum(-1) + damping[1, 1]
        e, f = right.unbind(-1)
        cramer = torch.stack([d * e - b * f, a * f - b * e], -1)
        return cramer / (a * d - b * b)[..., None]
    gram = unit.transpose(-1, -2) @ unit + damping
    return torch.linalg.solve(gram, right[..., None])[..., 0]


def _fit_knots(track: LaneState, known: Tensor | None, state: LaneState) -> Tensor:
    """Acceleration knots [..., V, KNOTS] m/s^2 of recorded motion."""
    device = track.v.device
    basis = _speed_basis(device)
    distance = _distance_basis(device)
    time = DT * torch.arange(1, HORIZON + 1, device=device)
    begin = state.map(lambda value: value[..., None])
    speed = track.v - begin.v - begin.a * basis[:, 0]
    driven = track.s - begin.s - begin.v * time - begin.a * distance[:, 0]
    damp, bend = _roughness(device)
    pull = bend * begin.a
    rows, inverse = _fit_of_all(device)  # a constant, made before anything is compiled
    if torch.compiler.is_compiling():  # all is known: the system is solved already
        target = torch.cat([speed, 0.5 * driven], -1)
        return ((target @ rows + pull) @ inverse).clamp(HARDEST[0], HARDEST[1])
    weight = torch.ones_like(track.v) if known is None else known.to(basis.dtype)
    target = torch.cat([weight * speed, 0.5 * weight * driven], -1)
    weight = weight[..., None]
    rows = torch.cat([weight * basis[:, 1:], 0.5 * weight * distance[:, 1:]], -2)
    gram = rows.transpose(-1, -2) @ rows + damp
    right = (rows.transpose(-1, -2) @ target[..., None])[..., 0] + pull
    return torch.linalg.solve(gram, right[..., None])[..., 0].clamp(
        HARDEST[0], HARDEST[1]
    )


@cache
def _roughness(device: torch.device) -> tuple[Tensor, Tensor]:
    """The damping [KNOTS, KNOTS] of fitted knots, and the pull [KNOTS] of a present
    acceleration of 1 on them."""
    second = torch.diff(
        torch.eye(KNOTS + 1, device=device),
        n=2,
        dim=0,
    )
    ridge_of_knots = KNOT_DAMPING * torch.eye(KNOTS, device=device)
    damp = ROUGHNESS * second[:, 1:].T @ second[:, 1:] + ridge_of_knots
    return damp, -ROUGHNESS * second[:, 1:].T @ second[:, 0]


@cache
def _fit_of_all(device: torch.device) -> tuple[Tensor, Tensor]:
    """Of motion that is known throughout: the rows [2 HORIZON, KNOTS] of the least
    squares, and the inverse of their damped Gram matrix [KNOTS, KNOTS]."""
    basis = [_speed_basis(device)[:, 1:], 0.5 * _distance_basis(device)[:, 1:]]
    rows = torch.cat(basis)
    gram = rows.double().T @ rows.double() + _roughness(device)[0]
    return rows, torch.linalg.inv(gram).float()
