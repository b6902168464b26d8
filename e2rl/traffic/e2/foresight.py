"""V, the predicted verdict: does a plan make a driver fail where a competent driver
would not?

Each plan is met by a population of drivers who go the way that the ego is expected to
go: the competent driver of UN R157, four who react later and brake less, and one who
does not react. A plan is worth the fraction that runs into it from behind, weighed
towards the better drivers, if the competent one does not; it is worth nothing if that
one does.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.drivers import DriverState, HumanDriver, Observation
from e2rl.metrics.preventable import Along, Tracks, along_path
from e2rl.prior.lane_relative import HORIZON
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.traffic import REPLAN_STEPS

# The competent driver first; the last never reacts.
DELAYS = (0.75, 0.85, 1.0, 1.25, 1.6, 99.0)  # s
BRAKING = (7.59, 6.5, 5.5, 5.0, 4.0, 1.0)  # m/s^2
WEIGHTS = (0.4, 0.3, 0.15, 0.1, 0.05)  # of the failures of all but the first
# m before the ego's front, a step before the contact, at least which makes it the
# ego's front.
FRONT_GAP = 0.8
MOVING = 1.0  # m/s: slower drivers do not run into anybody
STEPS = 5  # of DT in one fused function
SOON = 0.1  # share of the worth that a failure at the end of the horizon loses


class Foresight(NamedTuple):
    """Of plans [G, O]: worth in [0, 1]; prevented: whether the competent driver is not
    hit; time [s] at which one who does not react is, inf for never."""

    worth: Tensor
    prevented: Tensor
    time: Tensor


class Population(NamedTuple):
    """D drivers: delay s and braking m/s^2, [D] each."""

    delay: Tensor
    braking: Tensor


class Encounter(NamedTuple):
    """D drivers who each meet C plans, [D, C] each.

    speed m/s; travelled m; since s (see `foresee`) and braking m/s^2, the driver's
    memory; hit, front (by its front), reacts: 0 or 1, which compiled code loads faster
    than truth values; time s of the contact, inf for none.
    """

    speed: Tensor
    travelled: Tensor
    since: Tensor
    braking: Tensor
    hit: Tensor
    front: Tensor
    reacts: Tensor
    time: Tensor


class Approach(NamedTuple):
    """C plans along the ego's way at T moments, [T, C] each: rear m, speed m/s, lateral
    gap m and length m of what is met."""

    rear: Tensor
    speed: Tensor
    lateral_gap: Tensor
    length: Tensor


def foresee(
    path: Tensor,
    size: Tensor,
    tracks: Tensor,
    sizes: Tensor,
    since: Tensor,
    settled: Tensor,
) -> Foresight:
    """Returns the Foresight of O plans of each of G vehicles, each alone with an ego.

    Args:
        path: [G, T + 1, 4], the ego's expected states, whose way has no backwards.
        size: [G, 2] m, of the egos.
        tracks: [G, O, T + 1, 4], from now on.
        sizes: [G, 2] m, of the vehicles.
        since: [G] s for which the ego has had the vehicle before it (-1: not yet), when
            a competent driver would have begun to react.
        settled: [G] bool, that driver would have prevented what has begun, so that it
            need not prevent what is left of it.
    """
    plans = tracks.transpose(1, 2)
    box = sizes[:, None].expand(*tracks.shape[:2], 2)
    present = torch.ones_like(plans[..., 0], dtype=torch.bool)
    along = along_path(path, size[:, 1], Tracks(plans, box, present))
    hit, time = _contacts(path, size[:, 0], along=along, since=since)
    prevented = ~hit[0]
    horizon = DT * tracks.shape[2]
    weights = path.new_tensor(WEIGHTS)[:, None, None]
    worth = (hit[1:] * weights).sum(0) * (prevented | settled[:, None])
    worth = worth * (1 - SOON * time.clamp(max=horizon) / horizon)
    return Foresight(worth, prevented, time=time)


def _contacts(
    path: Tensor,
    length: Tensor,
    along: Along,
    since: Tensor,
) -> tuple[Tensor, Tensor]:
    """Whether drivers [D, G, O] run their front into the plans, and when [G, O] s the
    one who does not react does. The competent driver counts any contact as its own.

    path [G, T + 1, 4]; length [G] m of the ego; along: the plans on it, [T + 1, G, O]
    each; since [G] s.
    """
    pairs = along.rear.shape[1:]
    steps = path.shape[1] - 1
    population = Population(path.new_tensor(DELAYS), path.new_tensor(BRAKING))
    pace = path[..., 3].abs()
    planned = (
        (pace.diff(dim=1) / DT)
        .T[..., None]
        .expand(steps, *along.rear.shape[1:])
        .flatten(1)
    )
    length, speed, since = (
        value[:, None].expand(pairs).flatten() for value in (length, pace[:, 0], since)
    )
    zero = path.new_zeros(len(DELAYS), pairs.numel())
    encounter = Encounter(
        speed=speed.expand_as(zero),
        travelled=zero,
        since=since.expand_as(zero),
        braking=zero,
        hit=zero,
        front=zero,
        reacts=zero,
        time=torch.full_like(zero, torch.inf),
    )
    approach = (along.rear, along.speed, along.lateral_gap, along.length)
    approach = Approach(*(value.flatten(1) for value in approach))
    for step in range(0, steps, STEPS):
        last = min(step + STEPS, steps)
        moments = path.new_tensor([DT * (k + 1) for k in range(step, last)])
        ahead = Approach(*(value[step : step + STEPS + 1] for value in approach))
        encounter = meet(
            population,
            moments,
            length,
            planned[step:last],
            encounter,
            ahead,
        )
    hit = encounter.hit.unflatten(1, pairs) > 0
    front = encounter.front.unflatten(1, pairs) > 0
    return torch.cat([hit[:1], front[1:]]), encounter.time[-1].view(pairs)


@fused("D", f"{STEPS}", "C", f"{STEPS} C", "D C", f"{STEPS + 1} C")
def meet(
    population: Population,
    moments: Tensor,
    length: Tensor,
    planned: Tensor,
    encounter: Encounter,
    ahead: Approach,
) -> Encounter:
    """The encounter after some steps of DT.

    Args:
        population: the D drivers.
        moments: [STEPS] s at which the steps end.
        length: [C] m, of the egos.
        planned: [STEPS, C] m/s^2, the egos' expected acceleration.
        encounter: of the drivers with C plans.
        ahead: the plans at the STEPS + 1 moments.
    """
    delay = population.delay[:, None]
    braking = population.braking[:, None]
    drivers = HumanDriver(delay=delay, braking=braking, release=0.0)  # type: ignore
    speed = encounter.speed
    travelled = encounter.travelled
    length = length.expand_as(speed)
    hit = encounter.hit > 0
    front = encounter.front > 0
    reacts = encounter.reacts > 0
    time = encounter.time
    memory = DriverState(encounter.since, encounter.braking, hit)
    unseen = torch.zeros_like(speed)  # a HumanDriver does not look at it
    for step in range(planned.shape[0]):
        gap = ahead.rear[step] - travelled - length / 2
        lateral_gap = ahead.lateral_gap[step].expand_as(gap)
        observation = Observation(
            speed=speed,
            acceleration=unseen,
            gap=gap,
            other_speed=ahead.speed[step].expand_as(gap),
            lateral_gap=lateral_gap,
            lateral_speed=unseen,
            length=length,
            other_length=ahead.length[step].expand_as(gap),
        )
        memory, wanted = drivers.step(memory, observation)
        reacts = reacts | (wanted < 0)
        accel = planned[step].expand_as(speed)
        accel = torch.where(reacts, torch.minimum(wanted, accel), accel)
        after = (speed + DT * accel).clamp(min=0)
        travelled = travelled + (speed + after) / 2 * DT
        speed = after
        gap_after = ahead.rear[step + 1] - travelled - length / 2
        overlap = gap_after > -(length + ahead.length[step + 1])
        touch = (gap_after < 0) & overlap & (ahead.lateral_gap[step + 1] < 0) & ~hit
        front = front | (touch & (gap > -FRONT_GAP) & (speed > MOVING))
        time = torch.where(touch, moments[step], time)
        hit = hit | touch
    return Encounter(
        speed,
        travelled,
        since=memory[0],
        braking=memory[1],
        hit=torch.where(hit, 1.0, 0.0),
        front=torch.where(front, 1.0, 0.0),
        reacts=torch.where(reacts, 1.0, 0.0),
        time=time,
    )


def time_before(world: World, ego_plan: Tensor, since: Tensor) -> Tensor:
    """`since` [B, V] s of the present moment, one replan after `since` was right."""
    vehicles = since.shape[1]
    size = world.scene["size"]
    path = torch.cat([world.states[:, :1], ego_plan[:, :HORIZON]], 1)
    present = world.valid[:, None, :vehicles]
    tracks = Tracks(world.states[:, None, :vehicles], size[:, :vehicles], present)
    along = along_path(path, size[:, 0, 1], tracks)
    gap = along.rear[0] - size[:, :1, 0] / 2
    closing = world.states[:, :1, 3].abs() - along.speed[0]
    driver = HumanDriver()
    in_front = (along.lateral_gap[0] <= 0) & (closing > 0) & (gap > 0)
    needed = torch.maximum(
        closing * driver.time_to_collision, driver.stopping_gap(closing)
    )
    first = torch.where(gap <= needed, 0.0, -1.0)
    later = torch.where(since >= 0, since + REPLAN_STEPS * DT, first)
    return torch.where(in_front, later, -1.0)
