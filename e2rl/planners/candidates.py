"""Candidates of a planner: speed profiles on lateral moves beside the mission, driven
by the unicycle."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, RETURN_LENGTH
from e2rl.planners.lane_graph_planner import HALVES, PLAN_DT, capped, upsample
from e2rl.planners.path import RoutePath, between_entries, fading
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate
from e2rl.sim import dynamics
from e2rl.sim.dynamics import wrap

NODES = sum(HALVES)  # nodes of a speed profile, PLAN_DT apart: 5 s
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
    speed: Tensor, accelerations: Tensor, caps: Tensor, braking: float
) -> Tensor:
    """Speeds [B, L, PLAN_STEPS + 1] every DT from speed [B] m/s on.

    accelerations [L, 2] m/s^2: in the first second and after it; caps [B, K]: squared
    speeds of `MissionPath.speed_caps`, kept by braking at up to `braking` m/s^2 where a
    profile does not brake harder itself.
    """
    node = torch.arange(NODES, device=speed.device)
    rate = torch.where(node < FIRST, accelerations[:, :1], accelerations[:, 1:])
    start = speed[:, None, None].expand(-1, len(accelerations), 1)
    wanted = dynamics.bounded_speed(start, rate * PLAN_DT)
    return upsample(
        capped(torch.cat([start, wanted], -1), caps, slope=braking * PLAN_DT)
    )


def drive(
    start: Tensor, path: RoutePath, speed: Tensor, shift: Tensor, time: Tensor
) -> Candidates:
    """The C = L S Candidates of L speed profiles on S lateral moves each.

    A move leads `shift` m beside the mission over max(RETURN_LENGTH, time v) m, as
    `RoutePath` returns to its route. Its headings become yaw rates, within MAX_YAW_RATE
    and the tyres' grip, which braking shares; the unicycle makes states of them.

    start: states [B, 4]; speed: profiles [B, L, PLAN_STEPS + 1] m/s; shift m, time s:
    [B, L, S] or what broadcasts to it.
    """
    shift, time = (
        value.expand(*speed.shape[:2], value.shape[-1]) for value in (shift, time)
    )
    speed = speed[:, :, None]
    mean = (speed[..., 1:] + speed[..., :-1]) / 2
    accel = speed.diff(dim=-1) / DT
    driven = torch.nn.functional.pad((mean * DT).cumsum(-1), (1, 0))
    length = (time * start[:, 3, None, None]).clamp(min=RETURN_LENGTH)[..., None]
    beside = shift[..., None]
    turned = path.turned[:, None, None]
    offset, slope = fading(
        path.d[:, None, None, None] - beside,
        turned[..., None],
        length=length,
        ahead=driven,
    )
    table = heading_table(path)
    before, after, _ = between_entries(table, driven / CELL)
    inner = (1 - (after - before) / CELL * (beside + offset)).clamp(min=0.2)
    stretch = torch.hypot(inner, slope)
    along = (driven.diff(dim=-1) * 2 / (stretch[..., 1:] + stretch[..., :-1])).cumsum(
        -1
    )
    aimed = torch.lerp(*between_entries(table, along / CELL)) + torch.atan(
        slope[..., 1:] / inner[..., 1:]
    )
    grip = (dynamics.MAX_LATERAL**2 - accel.square()).clamp(min=0).sqrt() / mean.clamp(
        min=1e-3
    )
    bound = torch.minimum(grip, dynamics.yaw_rate_bound(mean)).clamp(max=MAX_YAW_RATE)
    yaw_rate = steer(turned.expand_as(shift), aimed, bound=bound * DT) / DT
    actions = torch.stack([accel.expand_as(yaw_rate), yaw_rate], -1).flatten(1, 2)
    states = dynamics.rollout(start[:, None].expand(-1, actions.shape[1], 4), actions)
    return Candidates(states, along[..., -1].flatten(1), shift=shift.flatten(1))


def steer(heading: Tensor, aimed: Tensor, bound: Tensor) -> Tensor:
    """Turns [..., T] rad of each step from heading [...] to aimed [..., T] rad, within
    bound [..., T], which broadcasts. What a bound withholds is made up later."""
    turns = []
    for aim, most in zip(aimed.unbind(-1), bound.unbind(-1), strict=True):
        turn = torch.clamp(aim - heading, -most, most)
        heading = heading + turn
        turns.append(turn)
    return torch.stack(turns, -1)


def heading_table(path: RoutePath) -> Tensor:
    """Headings [B, REACH] of the missions every CELL m ahead, relative to the heading
    at the ego's place, unwrapped."""
    grid = CELL * torch.arange(REACH, device=path.s.device, dtype=path.s.dtype)
    heading = interpolate(path.route, path.s[:, None] + grid)[1]
    return torch.nn.functional.pad(wrap(heading.diff(dim=-1)).cumsum(-1), (1, 0))
