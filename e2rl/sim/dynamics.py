"""Unicycle motion with actions (acceleration, yaw rate), forwards and backwards, whole
horizons at once.

A state is (x [m], y [m], heading [rad], speed [m/s], negative in reverse); a step lasts
DT and moves at the mean of the old and the new speed along the mean of the two
headings. Speeds are clamped to [0, MAX_SPEED], yaw rates by curvature and lateral
acceleration (`yaw_rate_bound`). Nobody begins to reverse here; who does at the start
comes to a halt (`rolling_back`).
"""

import torch
from torch import Tensor

from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import DT

MAX_SPEED = 40.0  # m/s
MAX_LATERAL = 8.0  # m/s^2, about the grip of tyres
MAX_CURVATURE = 0.3  # 1/m, path of a car's centre at full steering lock
HALTING = 3.0  # m/s^2 with which who reverses comes to a halt, at least
SLOW = 1.0  # m/s below which a turn rate says little of the path's curvature
SHARPEST = 0.12  # 1/m, of a path that is expected of a vehicle


def midpoints(values: Tensor) -> Tensor:
    """Means [..., T] of values [..., T + 1] and the ones after them."""
    return (values[..., 1:] + values[..., :-1]) / 2


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
        v0,
        torch.where(back < 0, halting, change),
        low=back.clamp(max=0),
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
    v0: Tensor,
    change: Tensor,
    *,
    low: Tensor | float = 0.0,
    high: float = MAX_SPEED,
) -> Tensor:
    """Speeds [..., H] m/s of v' = clip(v + change, low, high); exact, parallel in H.

    Args:
        v0: [..., 1] m/s.
        change: [..., H] m/s.
        low: m/s, one for all, or [..., H].
        high: m/s.

    Each step maps v to clip(v + c, l, h); after clip(v + c1, l1, h1) it is clip(v + c1
    + c2, clip(l1 + c2, l2, h2), clip(h1 + c2, l2, h2)) (Hillis and Steele's scan over
    these triples).
    """
    shape = torch.broadcast_shapes(v0.shape[:-1], change.shape[:-1])
    change = change.expand(shape + change.shape[-1:])
    lo = torch.as_tensor(low).to(change).expand_as(change)
    hi = torch.full_like(change, high)
    width = 1
    while width < change.shape[-1]:
        added = change[..., width:]
        moved = [
            torch.minimum(
                torch.maximum(bound[..., :-width] + added, lo[..., width:]),
                hi[..., width:],
            )
            for bound in (lo, hi)
        ]
        lo = torch.cat([lo[..., :width], moved[0]], -1)
        hi = torch.cat([hi[..., :width], moved[1]], -1)
        change = torch.cat([change[..., :width], change[..., :-width] + added], -1)
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


def curvature_of(turn_rate: Tensor, speed: Tensor) -> Tensor:
    """Path curvature [...] 1/m of vehicles that turn with turn_rate [...] rad/s at
    speed [...] m/s."""
    return (turn_rate / at_least(speed, SLOW)).clamp(-SHARPEST, SHARPEST)


def at_least(speed: Tensor, least: float) -> Tensor:
    """Speeds [...] m/s, forwards or backwards, of `least` at least."""
    return torch.where(speed < 0, speed.clamp(max=-least), speed.clamp(min=least))
