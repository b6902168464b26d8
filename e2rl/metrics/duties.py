"""Which duty a vehicle broke before a collision (docs/reference/verdicts.md).

The partner broke the first of these duties that applies: it ran into the ego from
behind; it had crossed a stop line at red; it drove against its lane; it crossed the
ego's path, or came into it, leaving less than a careful and competent driver needs to
brake.
"""

import torch
from torch import Tensor

from e2rl.metrics.collisions import EGO, PARTNER, Collisions
from e2rl.metrics.drivers import HumanDriver
from e2rl.metrics.fault import trailing_edge
from e2rl.metrics.geometry import travel_heading
from e2rl.metrics.preventable import Tracks, along_path, driven_length, hold
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

DUTIES = ("none", "rear-end", "light", "wrong way", "right of way", "entry")
NONE, REAR_END, LIGHT, WRONG_WAY, RIGHT_OF_WAY, ENTRY = range(6)
LIGHT_STEPS = round(5.0 / DT)  # before the contact in which a red light counts
WRONG_STEPS = round(1.0 / DT)  # before the contact of which a part is against the lanes
WRONG_SHARE = 0.5  # of these steps
ENTRY_ANGLE = torch.pi / 6  # rad to the path up to which it enters, not crosses it
ONCOMING_ANGLE = 5 * torch.pi / 6  # rad to the path from which on it comes towards it
REAR_ANGLE = torch.pi / 3  # rad to the path up to which it runs into the ego's rear
TURN_ANGLE = torch.pi / 7  # rad of heading within TURN_STEPS that make a turn
TURN_STEPS = round(4.0 / DT)


def duties(collisions: Collisions, struck: Tensor) -> tuple[Tensor, Tensor]:
    """Which duty the partner broke, as an index [C] into DUTIES, and whether the ego
    broke one [C] bool.

    The ego breaks its own by crossing a stop line at red before a vehicle of another
    direction, or by driving against its lane towards a vehicle that keeps to its own.
    Whoever meets it there owes it neither way nor gap. struck [C] bool: see
    `Prevention`.
    """
    stop = collisions.stop
    states = hold(collisions.states, collisions.valid)
    last = states[torch.arange(len(stop)), (stop - 1).clamp(min=0)]
    heading = travel_heading(last)
    angle = wrap(heading[:, PARTNER] - heading[:, EGO])
    crosses = angle.abs() > ENTRY_ANGLE
    oncoming = angle.abs() > ONCOMING_ANGLE
    speed = last[..., 3].abs()
    faster = speed[:, PARTNER] * angle.cos() > speed[:, EGO]
    from_behind = (angle.abs() < REAR_ANGLE) & faster
    runs_into = (collisions.kind == trailing_edge(collisions)) & from_behind
    ego_against, against = drives_against_lane(states, collisions).unbind(1)
    ego_ran, ran = ran_red_light(collisions).unbind(1)
    ego_broke = ((ego_ran & crosses) | (ego_against & oncoming)) & ~against & ~ran

    entered, safe = entry(states, collisions)
    # A driver who stands cannot lose the speed of who comes.
    unsafe = entered & (~safe | (oncoming & struck))
    # Who turns gives way; where both or none do, the other does if it comes from the
    # ego's left, or leaves its side.
    ego_turned, turned = turns(states, stop).unbind(1)
    gives_way = torch.where(ego_turned == turned, angle < 0, turned)
    gives_way = torch.where(oncoming, ~ego_turned, gives_way)

    duty = torch.full_like(stop, NONE)
    duty = torch.where(unsafe & ~crosses, ENTRY, duty)
    duty = torch.where(unsafe & crosses & gives_way, RIGHT_OF_WAY, duty)
    duty = torch.where(ego_broke, NONE, duty)
    duty = torch.where(against, WRONG_WAY, duty)
    duty = torch.where(ran, LIGHT, duty)
    return torch.where(runs_into, REAR_END, duty), ego_broke


def turns(states: Tensor, stop: Tensor) -> Tensor:
    """Bool [C, 2]: vehicles of states [C, T+1, 2, 4] turn by more than TURN_ANGLE in
    the TURN_STEPS before stop [C]."""
    steps = torch.arange(states.shape[1] - 1)
    counted = (steps < stop[:, None]) & (steps >= stop[:, None] - TURN_STEPS)
    change = wrap(states[..., 2].diff(dim=1))
    return (change * counted[..., None]).sum(1).abs() > TURN_ANGLE


def ran_red_light(collisions: Collisions) -> Tensor:
    """Bool [C, 2]: vehicles crossed a stop line at red in the LIGHT_STEPS before the
    contact."""
    steps_ago = collisions.stop[:, None] - collisions.red
    return (collisions.red >= 0) & (steps_ago >= 0) & (steps_ago <= LIGHT_STEPS)


def drives_against_lane(states: Tensor, collisions: Collisions) -> Tensor:
    """Bool [C, 2]: in WRONG_SHARE of the WRONG_STEPS before the contact the lane that a
    vehicle of states [C, T+1, 2, 4] is on runs against it."""
    steps = collisions.stop[:, None] - torch.arange(1, WRONG_STEPS + 1)
    window = states[torch.arange(len(steps))[:, None], steps.clamp(min=0)]
    against = [
        against_lanes(
            collisions.lane_points,
            collisions.lane_index,
            xy=track[..., :2],
            heading=travel_heading(track)[..., None],
        )
        for track in window.unbind(2)
    ]
    return torch.cat(against, -1).float().mean(1) >= WRONG_SHARE


def entry(states: Tensor, collisions: Collisions) -> tuple[Tensor, Tensor]:
    """Whether the partner came into the ego's path, and whether the gap has at some
    time after the last entry been what a competent driver needs; each [C] bool, of
    states [C, T+1, 2, 4]."""
    ego, partner = states.unbind(2)
    size = collisions.size
    track = Tracks(
        partner[:, :, None],
        size[:, PARTNER:],
        present=torch.ones_like(partner[..., :1], dtype=torch.bool),
    )
    along = along_path(
        ego,
        size[:, EGO, 1],
        others=track,
    )
    lateral_gap, rear, speed = (
        value[..., 0].T for value in (along.lateral_gap, along.rear, along.speed)
    )
    stop = collisions.stop[:, None]
    steps = torch.arange(ego.shape[1])
    outside = (lateral_gap > 0) & (steps <= stop)
    last_outside = torch.where(outside, steps, -1).amax(1, keepdim=True)
    gap = rear - driven_length(ego) - size[:, EGO, :1] / 2
    safe = gap >= HumanDriver().stopping_gap(ego[..., 3].abs() - speed)
    after = (steps > last_outside) & (steps <= stop.maximum(last_outside + 1))
    return last_outside[:, 0] >= 0, (safe & after).any(1)
