"""Unicycle motion with actions (acceleration, yaw rate), forwards and backwards, whole
horizons at once.

A state is (x [m], y [m], heading [rad], speed [m/s], negative in reverse); a step lasts
DT and moves at the mean of the old and the new speed along the mean of the two
headings. Speeds are clamped to [0, MAX_SPEED], yaw rates by curvature and lateral
acceleration (`yaw_rate_bound`). Nobody begins to reverse here; who does at the start
comes to a halt (`rolling_back`).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import DT

MAX_SPEED = 40.0  # m/s
MAX_LATERAL = 8.0  # m/s^2, about the grip of tyres
MAX_CURVATURE = 0.3  # 1/m, path of a car's centre at full steering lock
HALTING = 3.0  # m/s^2 with which who reverses comes to a halt, at least


def constant_velocity(states: Tensor, times: Tensor) -> Tensor:
    """States [..., K, 4] at times [K] or [..., K] s ahead of states [..., 4] that keep
    their heading and speed."""
    velocity = states[..., 3:] * torch.stack(
        [torch.cos(states[..., 2]), torch.sin(states[..., 2])], -1
    )
    xy = states[..., None, :2] + times[..., None] * velocity[..., None, :]
    return torch.cat([xy, states[..., None, 2:].expand(*xy.shape[:-1], 2)], -1)


def closest_approach_cost(offset: Tensor, closing: Tensor) -> Tensor:
    """exp(-t^2 / 2 - d^2 / 2) [...] of the closest approach, in t s and d m apart, at
    constant velocities.

    offset, closing [..., 2]: relative position [m] and velocity [m/s]. 1 on contact at
    the centres; a pair at the same velocity keeps its distance, hence costs nearly
    nothing.
    """
    time = (-(offset * closing).sum(-1) / (closing.square().sum(-1) + 1e-6)).clamp(
        min=0
    )
    miss = offset + closing * time[..., None]
    return (-(time.square() + miss.square().sum(-1)) / 2).exp()


def yaw_rate_bound(speed: Tensor) -> Tensor:
    """Largest |yaw rate| [rad/s] at speed [m/s]: MAX_CURVATURE * v at low speeds,
    MAX_LATERAL / v at high speeds."""
    return torch.minimum(MAX_CURVATURE * speed, MAX_LATERAL / speed.clamp(min=1e-3))


def turn_bound(speed: Tensor) -> Tensor:
    """Largest |change of heading| [rad] in a step at speed [m/s], forwards or
    backwards."""
    return yaw_rate_bound(speed.abs()) * DT


def rolling_back(speed: Tensor, time: Tensor | float) -> Tensor:
    """Lowest speed [...] m/s after `time` s of vehicles at speed [...]: 0, but of those
    that reverse, which halt."""
    return (speed + HALTING * time).clamp(max=0)


def step(state: Tensor, action: Tensor) -> Tensor:
    """State [..., 4] after one DT of action [..., 2] = (acceleration m/s^2, yaw rate
    rad/s): `rollout` of one step."""
    x, y, heading, before = state.unbind(-1)
    acceleration, yaw_rate = action.unbind(-1)
    speed = torch.maximum(before + acceleration * DT, rolling_back(before, DT)).clamp(
        max=MAX_SPEED
    )
    mean = (before + speed) / 2
    bound = yaw_rate_bound(mean.abs())
    turn = torch.clamp(yaw_rate, -bound, bound) * DT
    heading = heading + turn
    along = mean * DT
    middle = heading - turn / 2
    return torch.stack(
        [x + along * middle.cos(), y + along * middle.sin(), wrap(heading), speed], -1
    )


def rollout(start: Tensor, actions: Tensor) -> Tensor:
    """States [..., H, 4] at steps 1..H from start [..., 4] under actions [..., H, 2],
    without a loop over time.

    The speed recursion v' = clip(v + a DT, low, MAX_SPEED) is a composition of shifted
    clips, which are closed under composition: a parallel scan of log2 H levels.
    Headings and positions are cumulative sums. Who reverses brakes by HALTING at least,
    to a halt: until then its speed is a sum, too, and the bound itself.
    """
    v0 = start[..., 3:4]
    change = actions[..., 0] * DT
    halting = change.clamp(min=HALTING * DT)
    back = v0 + halting.cumsum(-1)
    speed = bounded_speed(
        v0, torch.where(back < 0, halting, change), low=back.clamp(max=0)
    )
    before = torch.cat([v0.expand_as(speed[..., :1]), speed[..., :-1]], -1)
    bound = yaw_rate_bound(((before + speed) / 2).abs())
    turn = torch.maximum(torch.minimum(actions[..., 1], bound), -bound) * DT
    return steered(start, speed, turn=turn)


def steered(start: Tensor, speed: Tensor, turn: Tensor) -> Tensor:
    """States [..., H, 4] at steps 1..H of a unicycle from start [..., 4].

    Each step moves at the mean of the old and the new speed along the mean of the two
    headings.

    Args:
        start: [..., 4] states.
        speed: [..., H] m/s, at steps 1..H.
        turn: [..., H] rad, changes of heading in each step.
    """
    before = torch.cat([start[..., 3:4].expand_as(speed[..., :1]), speed[..., :-1]], -1)
    heading = start[..., 2:3] + turn.cumsum(-1)
    along = (before + speed) / 2 * DT
    middle = heading - turn / 2
    x = start[..., 0:1] + (along * middle.cos()).cumsum(-1)
    y = start[..., 1:2] + (along * middle.sin()).cumsum(-1)
    return torch.stack([x, y, wrap(heading), speed], -1)


def bounded_speed(
    v0: Tensor, change: Tensor, low: Tensor | float = 0.0, high: float = MAX_SPEED
) -> Tensor:
    """Speeds [..., H] of v' = clip(v + change, low, high) from v0 [..., 1] under change
    [..., H]; exact, parallel in H. low: one for all, or [..., H].

    Each step maps v to clip(v + c, l, h); after clip(v + c1, l1, h1) it is clip(v + c1
    + c2, clip(l1 + c2, l2, h2), clip(h1 + c2, l2, h2)) (Hillis and Steele's scan over
    these triples).
    """
    shape = torch.broadcast_shapes(v0.shape[:-1], change.shape[:-1])
    change = change.expand(*shape, change.shape[-1])
    lo = (
        low.expand_as(change)
        if isinstance(low, Tensor)
        else torch.full_like(change, low)
    )
    hi = torch.full_like(change, high)
    horizon = change.shape[-1]
    width = 1
    while width < horizon:
        c = change[..., width:]
        low_then = lo[..., width:]
        high_then = hi[..., width:]
        moved = [
            torch.minimum(torch.maximum(bound[..., :-width] + c, low_then), high_then)
            for bound in (lo, hi)
        ]
        lo, hi = (
            torch.cat([bound[..., :width], then], -1)
            for bound, then in zip((lo, hi), moved, strict=True)
        )
        change = torch.cat([change[..., :width], change[..., :-width] + c], -1)
        width *= 2
    return torch.minimum(torch.maximum(v0 + change, lo), hi)


def inverse(states: Tensor) -> Tensor:
    """Actions [..., H, 2] that reproduce states [..., H + 1, 4]: speed and heading
    differences over DT.

    `rollout(states[..., 0, :], inverse(states))` returns the speeds and headings of
    states within the bounds.
    """
    change = states[..., 1:, 2:] - states[..., :-1, 2:]
    return torch.stack([change[..., 1], wrap(change[..., 0])], -1) / DT


HOLD, TURN = (
    1.0,
    2.0,
)  # s for which a seen acceleration and a seen curvature are expected to last
SLOW = 1.0  # m/s below which a turn rate says little of the path's curvature
SHARPEST = 0.12  # 1/m, of a path that is expected of a vehicle


class Arc(NamedTuple):
    """Constant acceleration [...] m/s^2 and path curvature [...] 1/m (left positive):
    how others may go on."""

    accel: Tensor
    curvature: Tensor


def curvature_of(turn_rate: Tensor, speed: Tensor) -> Tensor:
    """Path curvature [...] 1/m of vehicles that turn with turn_rate [...] rad/s at
    speed [...] m/s."""
    return (turn_rate / at_least(speed, SLOW)).clamp(-SHARPEST, SHARPEST)


def at_least(speed: Tensor, least: float) -> Tensor:
    """Speeds [...] m/s, forwards or backwards, of `least` at least."""
    return torch.where(speed < 0, speed.clamp(max=-least), speed.clamp(min=least))


def along_arc(
    states: Tensor,
    arc: Arc,
    times: Tensor,
    hold: float = torch.inf,
    turn: float = torch.inf,
) -> tuple[Tensor, Tensor]:
    """States [..., T, 4] and metres driven [..., T] at times [..., T] s ahead of states
    [..., 4].

    The acceleration [...] is held for `hold` s, never beyond a halt; the curvature
    [...] for the distance that the present speed drives in `turn` s; then speed and
    heading stay. In reverse metres are negative.
    """
    x, y, heading, v = (value[..., None] for value in states.unbind(-1))
    arc = Arc(*(value[..., None] for value in arc))
    *places, driven = arc_places(
        x, y, heading=heading, v=v, arc=arc, times=times, hold=hold, turn=turn
    )
    return torch.stack(torch.broadcast_tensors(*places), -1), driven


def arc_places(
    x: Tensor,
    y: Tensor,
    heading: Tensor,
    v: Tensor,
    arc: Arc,
    times: Tensor,
    hold: float,
    turn: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`along_arc` of x, y, heading, speed, accelerations, curvatures and times that
    broadcast: these four then, and the metres driven."""
    accel, curvature = arc
    sign = torch.where(v < 0, -1.0, 1.0)
    v = v * sign
    accel = accel * sign
    halt = torch.where(accel < 0, v / (-accel).clamp(min=1e-6), torch.inf)
    held = torch.minimum(times.clamp(max=hold), halt)
    speed = (v + accel * held).clamp(min=0)
    driven = (v + speed) / 2 * held + speed * (times - held)
    bent = (
        driven if turn == torch.inf else torch.minimum(driven, turn * v.clamp(min=SLOW))
    )
    driven = driven * sign
    bent = bent * sign
    speed = speed * sign
    angle = curvature * bent
    chord = bent * torch.sinc(angle / (2 * torch.pi))
    middle = heading + angle / 2
    end = heading + angle
    x = x + chord * middle.cos()
    y = y + chord * middle.sin()
    if turn < torch.inf:
        x = x + (driven - bent) * end.cos()
        y = y + (driven - bent) * end.sin()
    return x, y, wrap(end), speed, driven
