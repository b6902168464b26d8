"""nuPlan's closed-loop score of PDM-Closed's proposals (Dauner et al. 2023), against
others that keep their velocity.

Where the paper is silent, numbers and rules are those of its published code;
docs/reference/deviations.md lists what differs.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.path import MissionPath
from e2rl.scenes.boxes import corners, overlap, to_frame, unit_vectors
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim.dynamics import constant_velocity, wrap
from e2rl.sim.world import World

SCORED_STEPS = 40  # steps that are scored: 4 s
LOOKS = (0.0, 0.3, 0.6, 0.9)  # s ahead of each state: the time to collision
STANDS = 0.05  # m/s: up to which one stands at a collision
NO_LOOK = 0.005  # m/s: below which the ego has no time to a collision
REAR_AXLE = 1.461 / 5.176  # of the length: from nuPlan's vehicle's centre to its axle
AHEAD = math.radians(30)  # angle at the rear axle from the heading to another's centre
BEHIND = math.radians(150)
LANE_WIDTH = 3.5  # m: an ego that reaches beyond counts as in several lanes
OBJECT_HIT = 0.5  # what hitting an object at fault leaves of a score
PROGRESS = 5.0  # weight
TIME_TO_COLLISION = 5.0  # weight
COMFORT = 2.0  # weight
LEAST_PROGRESS = 0.1  # m: where no proposal drives farther, all have all progress
MIN_ACCELERATION = -4.05  # m/s^2, comfortable along the heading
MAX_ACCELERATION = 2.40  # m/s^2
LONGITUDINAL_JERK = 4.13  # m/s^3
JERK = 8.37  # m/s^3
YAW_RATE = 0.95  # rad/s
YAW_ACCELERATION = 1.93  # rad/s^2


class Others(NamedTuple):
    """M agents at constant velocity, those left out that touch the ego already."""

    states: Tensor  # [B, M, T, 4] at T steps
    size: Tensor  # [B, M, 2] m
    present: Tensor  # [B, M] bool: the row holds an agent
    objects: Tensor  # [B, M] bool: neither a vehicle nor a person; it stands


class Drives(NamedTuple):
    """What the ego drives in P proposals, and whether it is in several lanes."""

    states: Tensor  # [B, P, T, 4]
    size: Tensor  # [B, 2] m
    loose: Tensor  # [B, P, T] bool


def score(
    world: World,
    proposals: Tensor,
    others: Others,
) -> tuple[Tensor, Tensor]:
    """nuPlan's score [B, P] in [0, 1] of proposals [B, P, PLAN_STEPS, 4] over the
    SCORED_STEPS, and the s [B, P] to their first collision at fault, inf without;
    others: at steps 0 to SCORED_STEPS.

    Collision and drivable area multiply the weighted mean of progress, relative to the
    proposal that gets farthest by what these two leave of it, time to collision and
    comfort. Proposals follow the mission, and so never drive against its direction,
    which nuPlan scores too.
    """
    start = world.states[:, None, None, 0].expand_as(proposals[:, :, :1])
    states = torch.cat([start, proposals[:, :, :SCORED_STEPS]], 2)
    size = world.scene["size"][:, 0]
    ego = Drives(
        states,
        size,
        loose=in_several_lanes(world, states),
    )
    contacts = contacts_of(ego, others)
    fault = at_fault(
        ego,
        others,
        touch=contacts[..., 0],
    )
    hit = fault & ~others.objects[:, None, :, None]
    object_factor = torch.where(fault.any((2, 3)), OBJECT_HIT, 1.0)
    factor = torch.where(hit.any((2, 3)), 0.0, object_factor) * on_road(world, states)
    times = DT * torch.arange(SCORED_STEPS + 1, device=fault.device)
    collides = torch.where(fault.any(2), times, torch.inf).amin(-1)
    weighted = (
        PROGRESS * progress(world, states, factor=factor)
        + TIME_TO_COLLISION * ~runs_into(ego, others, touch=contacts)
        + COMFORT * comfortable(world, states)
    )
    return factor * weighted / (PROGRESS + TIME_TO_COLLISION + COMFORT), collides


def progress(
    world: World,
    states: Tensor,
    factor: Tensor,
) -> Tensor:
    """Metres along the mission of states [B, P, T, 4], times factor [B, P], as a
    fraction [B, P] of the most."""
    path = MissionPath(world)
    length = states[..., :2].diff(dim=2).norm(dim=-1).sum(-1)
    s = project(
        states[:, :, -1, :2],
        path.route,
        hint=path.s[:, None] + length,
    )[0]
    distance = (s - path.s[:, None]).clamp(min=0) * factor
    farthest = distance.amax(1, keepdim=True)
    relative = distance / farthest.clamp(min=LEAST_PROGRESS)
    return torch.where(farthest > LEAST_PROGRESS, relative, (factor > 0).to(relative))


def contacts_of(ego: Drives, others: Others) -> Tensor:
    """Bool [B, P, M, T, L]: the ego and an agent touch, LOOKS s after step T."""
    looks = ego.states.new_tensor(LOOKS)
    touch = overlap(
        constant_velocity(ego.states, looks)[:, :, None],
        ego.size[:, None, None, None, None],
        second=constant_velocity(others.states, looks)[:, None],
        second_size=others.size[:, None, :, None, None],
    )
    return touch & others.present[:, None, :, None, None]


def first(events: Tensor) -> tuple[Tensor, ...]:
    """Indices of the first true value along the last dim of events [..., T]."""
    return (events & (events.cumsum(-1) == 1)).nonzero(as_tuple=True)


def angle_at_axle(
    states: Tensor,
    size: Tensor,
    centre: Tensor,
) -> Tensor:
    """Angle [Q] in [0, pi] at the rear axle of states [Q, 4] of size [Q, 2], from their
    heading to centres [Q, 2]."""
    ahead, beside = to_frame(centre, states).unbind(-1)
    return torch.atan2(beside, ahead + REAR_AXLE * size[:, 0]).abs()


def at_fault(
    ego: Drives,
    others: Others,
    touch: Tensor,
) -> Tensor:
    """Bool [B, P, M, T]: collisions at the ego's fault, at the step at which it first
    touches an agent; touch [B, P, M, T] bool.

    The ego is at fault if it moves and the other stands, if its front touches the
    other, or if the other, not behind it, touches it beside while it is in several
    lanes. Whom it touches without fault it does not look at again.
    """
    scene, proposal, agent, step = first(touch)
    state = ego.states[scene, proposal, step]
    size = ego.size[scene]
    other = others.states[scene, agent, step]
    direction = unit_vectors(state[:, 2])
    xy = state[:, :2] + size[:, :1] / 2 * direction
    front = overlap(
        torch.cat([xy, state[:, 2:]], -1),
        size * size.new_tensor([0.0, 1.0]),
        second=other,
        second_size=others.size[scene, agent],
    )
    behind = (
        angle_at_axle(
            state,
            size,
            centre=other[:, :2],
        )
        > BEHIND
    )
    moves = state[:, 3] > STANDS
    stands = other[:, 3].abs() <= STANDS
    drives_into = ~behind & (front | ego.loose[scene, proposal, step])
    fault = torch.zeros_like(touch)
    fault[scene, proposal, agent, step] = moves & (stands | drives_into)
    return fault


def runs_into(
    ego: Drives,
    others: Others,
    touch: Tensor,
) -> Tensor:
    """Bool [B, P]: at constant velocities the ego would touch an agent within a second
    that is ahead of it, or, while it is in several lanes, not behind it. What it would
    first touch elsewhere does not count later. touch [B, P, M, T, L] bool."""
    moves = ego.states[..., 3].abs() >= NO_LOOK
    events = (touch & moves[:, :, None, :, None]).flatten(3)
    scene, proposal, agent, event = first(events)
    step = event // len(LOOKS)
    time = ego.states.new_tensor(LOOKS)[event % len(LOOKS)]
    other = constant_velocity(others.states[scene, agent, step], time[:, None])[:, 0]
    state = ego.states[scene, proposal, step]
    angle = angle_at_axle(
        state,
        ego.size[scene],
        centre=other[:, :2],
    )
    beside = ego.loose[scene, proposal, step] & (angle <= BEHIND)
    counts = (angle < AHEAD) | beside
    result = torch.zeros_like(ego.loose[..., 0])
    result[scene[counts], proposal[counts]] = True
    return result


def in_several_lanes(world: World, states: Tensor) -> Tensor:
    """Bool [B, P, T]: states [B, P, T, 4] reach beyond a lane of LANE_WIDTH about the
    mission: egos know no other."""
    path = MissionPath(world)
    xy = states[..., :2]
    driven = pad(xy.diff(dim=2).norm(dim=-1).cumsum(-1), (1, 0))
    hint = (path.s[:, None, None] + driven).flatten(1, 2)
    offset = project(
        xy.flatten(1, 2),
        path.route,
        hint=hint,
    )[1].view(driven.shape)
    half_width = world.scene["size"][:, 0, 1, None, None] / 2
    return offset.abs() + half_width > LANE_WIDTH / 2


def on_road(world: World, states: Tensor) -> Tensor:
    """Bool [B, P]: no corner of states [B, P, T, 4] leaves the drivable area."""
    boxes = corners(states, world.scene["size"][:, 0][:, None, None])
    beyond = off_road(
        boxes.flatten(1, 3),
        world.scene["field"],
        origin=world.scene["field_origin"],
    )
    return beyond.view(*states.shape[:2], -1).amax(-1) <= 0


def comfortable(world: World, states: Tensor) -> Tensor:
    """Bool [B, P]: states [B, P, SCORED_STEPS + 1, 4] keep nuPlan's bounds of comfort,
    by the published filters.

    The accelerations are a step's changes of speed, the first one the ego's last; like
    nuPlan's vehicle it has none to the side.
    """
    speed = states[..., 3]
    last = world.accel[:, None, :1].expand_as(speed[..., :1])
    accel = torch.cat([last, speed.diff(dim=-1) / DT], -1)
    turned = pad(wrap(states[..., 2].diff(dim=-1)).cumsum(-1), (1, 0))
    longitudinal = _filtered(accel)
    jerk = _filtered(_filtered(accel, window=8), derivative=1)
    total_jerk = _filtered(_filtered(accel.abs(), window=8), derivative=1)
    yaw_rate = _filtered(
        turned,
        window=5,
        derivative=1,
    )
    yaw_acceleration = _filtered(
        turned,
        window=5,
        order=3,
        derivative=2,
    )
    bounded = longitudinal > MIN_ACCELERATION
    bounded &= longitudinal < MAX_ACCELERATION
    bounded &= jerk.abs() < LONGITUDINAL_JERK
    bounded &= total_jerk.abs() < JERK
    bounded &= yaw_rate.abs() < YAW_RATE
    bounded &= yaw_acceleration.abs() < YAW_ACCELERATION
    return bounded.all(-1)


def _filtered(
    values: Tensor,
    window: int = SCORED_STEPS + 1,
    order: int = 2,
    derivative: int = 0,
) -> Tensor:
    return (
        values
        @ savitzky_golay(
            window,
            order,
            derivative=derivative,
        )
        .to(values)
        .mT
    )


@cache
def savitzky_golay(
    window: int,
    order: int,
    derivative: int,
) -> Tensor:
    """The filter of SCORED_STEPS + 1 values at steps of DT as a matrix [SCORED_STEPS +
    1, SCORED_STEPS + 1]."""
    from scipy.signal import savgol_filter  # loads all of scipy, for half a second

    unit = np.eye(SCORED_STEPS + 1)
    matrix = savgol_filter(
        unit,
        window,
        order,
        deriv=derivative,
        delta=DT,
        axis=0,
    )
    return torch.from_numpy(matrix)
