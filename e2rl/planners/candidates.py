"""Candidates of a planner: speed profiles on lateral moves beside the mission, driven
by the unicycle."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.ego import PLAN_STEPS, RETURN_LENGTH
from e2rl.planners.path import LEAST_STRETCH, RoutePath, between_entries, fading
from e2rl.planners.profiles import NODES, PLAN_DT, capped, upsample
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate
from e2rl.sim import dynamics
from e2rl.sim.dynamics import midpoints, wrap

FIRST = round(1.0 / PLAN_DT)  # nodes of the first acceleration of a profile: 1 s
MAX_YAW_RATE = 1.6  # rad/s, the simulator's bound
CELL = 1.0  # m between entries of the table of a mission's headings
REACH = int(dynamics.MAX_SPEED * PLAN_STEPS * DT / CELL) + 1  # entries of it


class Candidates(NamedTuple):
    """C candidates of each of B scenes: states [B, C, PLAN_STEPS, 4] at steps 1..;
    distance [B, C] m along the mission to their end; shift [B, C] m beside the mission
    where they lead."""

    states: Tensor
    distance: Tensor
    shift: Tensor


def speed_profiles(
    speed: Tensor,
    accelerations: Tensor,
    *,
    caps: Tensor,
    braking: float,
) -> Tensor:
    """Returns speeds [B, L, PLAN_STEPS + 1] every DT.

    Args:
        speed: [B] m/s, now.
        accelerations: [L, 2] m/s^2, in the first second and after it.
        caps: [B, K], squared speeds of `MissionPath.speed_caps`.
        braking: m/s^2 by which the caps are kept where a profile does not brake harder
            itself.
    """
    node = torch.arange(NODES, device=speed.device)
    rate = torch.where(node < FIRST, accelerations[:, :1], accelerations[:, 1:])
    start = speed[:, None, None].expand(-1, len(accelerations), 1)
    wanted = torch.cat([start, dynamics.bounded_speed(start, rate * PLAN_DT)], -1)
    return upsample(
        capped(
            wanted,
            caps,
            slope=braking * PLAN_DT,
        )
    )


def drive(
    start: Tensor,
    path: RoutePath,
    *,
    speed: Tensor,
    shift: Tensor,
    time: Tensor,
) -> Candidates:
    """Returns the C = L S Candidates of L speed profiles on S lateral moves each.

    A move leads `shift` m beside the mission over max(RETURN_LENGTH, time v) m, as
    `RoutePath` returns to its route. Its headings become yaw rates, within MAX_YAW_RATE
    and the tyres' grip, which braking shares; the unicycle makes states of them.

    Args:
        start: states [B, 4].
        path: of these states.
        speed: [B, L, PLAN_STEPS + 1] m/s, the profiles.
        shift: [B, L, S] m, or what broadcasts to it.
        time: [B, L, S] s, or what broadcasts to it.
    """
    profiles = speed.shape[:2]
    shift = shift.expand((*profiles, shift.shape[-1]))
    time = time.expand((*profiles, time.shape[-1]))
    speed = speed[:, :, None]
    mean = midpoints(speed)
    accel = speed.diff(dim=-1) / DT
    driven = pad((mean * DT).cumsum(-1), (1, 0))
    target = shift[..., None]
    turned = path.turned[:, None, None]
    offset, slope = fading(
        path.d[:, None, None, None] - target,
        turned[..., None],
        length=(time * start[:, 3, None, None]).clamp(min=RETURN_LENGTH)[..., None],
        ahead=driven,
    )
    headings = heading_table(path)
    low, high, _ = between_entries(headings, driven / CELL)
    inner = (1 - (high - low) / CELL * (target + offset)).clamp(min=LEAST_STRETCH)
    stretch = torch.hypot(inner, slope)
    doubled = driven.diff(dim=-1) * 2
    along = (doubled / (stretch[..., 1:] + stretch[..., :-1])).cumsum(-1)
    heading = torch.lerp(*between_entries(headings, along / CELL))
    aim = heading + torch.atan(slope[..., 1:] / inner[..., 1:])
    grip = (dynamics.MAX_LATERAL**2 - accel.square()).clamp(min=0).sqrt()
    bound = torch.minimum(grip / mean.clamp(min=1e-3), dynamics.yaw_rate_bound(mean))
    bound = bound.clamp(max=MAX_YAW_RATE)
    yaw_rate = (
        steer(
            turned.expand_as(shift),
            aim,
            bound=bound * DT,
        )
        / DT
    )
    actions = torch.stack([accel.expand_as(yaw_rate), yaw_rate], -1).flatten(1, 2)
    states = dynamics.rollout(start[:, None].expand(-1, actions.shape[1], 4), actions)
    return Candidates(
        states,
        along[..., -1].flatten(1),
        shift=shift.flatten(1),
    )


def steer(
    heading: Tensor,
    aim: Tensor,
    bound: Tensor,
) -> Tensor:
    """Turns [..., T] rad of each step from heading [...] to aim [..., T] rad, within
    bound [..., T], which broadcasts. What a bound withholds is made up later."""
    turns = []
    for target, most in zip(
        aim.unbind(-1),
        bound.unbind(-1),
        strict=True,
    ):
        turn = torch.clamp(target - heading, -most, most)
        heading = heading + turn
        turns.append(turn)
    return torch.stack(turns, -1)


def heading_table(path: RoutePath) -> Tensor:
    """Headings [B, REACH] of the missions every CELL m ahead, relative to the heading
    at the ego's place, unwrapped."""
    grid = CELL * torch.arange(REACH, device=path.s.device, dtype=path.s.dtype)
    heading = interpolate(path.route, path.s[:, None] + grid)[1]
    return pad(wrap(heading.diff(dim=-1)).cumsum(-1), (1, 0))
