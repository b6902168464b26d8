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
from e2rl.metrics.preventable import Along, Tracks, along_way
from e2rl.prior.lane_relative import HORIZON
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.traffic import REPLAN_STEPS

# The competent driver first; the last never reacts.
DELAYS = (0.75, 0.85, 1.0, 1.25, 1.6, 99.0)  # s
BRAKING = (7.59, 6.5, 5.5, 5.0, 4.0, 1.0)  # m/s^2
WEIGHTS = (0.4, 0.3, 0.15, 0.1, 0.05)  # of the failures of all but the first
FRONT_GAP = 0.8  # m before the ego's front, a step before the contact, at least which makes it the ego's front
MOVING = 1.0  # m/s: slower drivers do not run into anybody
STEPS = 5  # of DT in one fused function
SOON = 0.1  # share of the worth that a failure at the end of the horizon loses


class Foresight(NamedTuple):
    """Of plans [G, O]: worth in [0, 1]; prevented: whether the competent driver is not
    hit; time [s] at which one who does not react is, inf for never."""

    worth: Tensor
    prevented: Tensor
    time: Tensor


def foresee(
    path: Tensor,
    size: Tensor,
    tracks: Tensor,
    sizes: Tensor,
    since: Tensor,
    settled: Tensor,
) -> Foresight:
    """The Foresight of O plans of each of G vehicles, tracks [G, O, T + 1, 4] from now
    on, each alone with an ego.

    path [G, T + 1, 4]: the ego's expected states, whose way has no backwards; size,
    sizes [G, 2] of ego and vehicle; since [G]: s for which the ego has had the vehicle
    before it (-1: not yet), when a competent driver would have begun to react; settled
    [G] bool: that driver would have prevented what has begun, so that it need not
    prevent what is left of it.
    """
    plans = tracks.transpose(1, 2)
    box = sizes[:, None].expand(*tracks.shape[:2], 2)
    along = along_way(
        path,
        size[:, 1],
        others=Tracks(
            plans, box, present=torch.ones_like(plans[..., 0], dtype=torch.bool)
        ),
    )
    hit, time = _contacts(path, size[:, 0], along=along, since=since)
    prevented = ~hit[0]
    horizon = DT * tracks.shape[2]
    worth = (hit[1:] * path.new_tensor(WEIGHTS)[:, None, None]).sum(0)
    worth = (
        worth
        * (prevented | settled[:, None])
        * (1 - SOON * time.clamp(max=horizon) / horizon)
    )
    return Foresight(worth, prevented, time=time)


def _contacts(
    path: Tensor, length: Tensor, along: Along, since: Tensor
) -> tuple[Tensor, Tensor]:
    """Whether drivers [D, G, O] run their front into the plans seen `along` path [G, T
    + 1, 4] ([T + 1, G, O] each), and when [G, O] s the one who does not react does;
    length [G] m of the ego, since [G].

    The competent driver counts any contact as its own.
    """
    plans = along.rear.shape[1:]
    steps = path.shape[1] - 1
    delay, braking = (path.new_tensor(values) for values in (DELAYS, BRAKING))
    pace = path[..., 3].abs()
    own = (pace.diff(dim=1) / DT).T[..., None].expand(steps, *plans).flatten(1)
    length, speed, since = (
        value[:, None].expand(plans).flatten() for value in (length, pace[:, 0], since)
    )
    way = path.new_zeros(len(DELAYS), plans.numel())
    met = (
        speed.expand_as(way),
        way,
        since.expand_as(way),
        way,
        way,
        way,
        way,
        torch.full_like(way, torch.inf),
    )
    seen = [
        value.flatten(1)
        for value in (along.rear, along.speed, along.lateral_gap, along.length)
    ]
    for t in range(0, steps, STEPS):
        moments = path.new_tensor(
            [DT * (k + 1) for k in range(t, min(t + STEPS, steps))]
        )
        part = [value[t : t + STEPS + 1] for value in seen]
        met = meet(delay, braking, moments, length, own[t : t + STEPS], *met, *part)
    hit, front = (value.unflatten(1, plans) > 0 for value in met[4:6])
    return torch.cat([hit[:1], front[1:]]), met[7][-1].view(plans)


@fused("D", "D", f"{STEPS}", "C", f"{STEPS} C", *["D C"] * 8, *[f"{STEPS + 1} C"] * 4)
def meet(
    delay: Tensor,
    braking: Tensor,
    moments: Tensor,
    length: Tensor,
    own: Tensor,
    speed: Tensor,
    way: Tensor,
    since: Tensor,
    brakes: Tensor,
    hit: Tensor,
    front: Tensor,
    reacts: Tensor,
    time: Tensor,
    rear: Tensor,
    other: Tensor,
    aside: Tensor,
    extent: Tensor,
) -> tuple[Tensor, ...]:
    """Some steps, which end at `moments`, of drivers [D] who meet plans [C].

    Returns, each [D, C], their speed, way, since and braking; whether they have been
    hit, by their front, and react, as 0 or 1, which compiled code loads faster than
    truth values; and when they are hit. length [C] and own [STEPS, C]: the ego's, and
    its planned acceleration; rear, other (speed), aside and extent [STEPS + 1, C]: of
    what it meets.
    """
    drivers = HumanDriver(delay=delay[:, None], braking=braking[:, None], release=0.0)  # type: ignore
    length = length.expand_as(speed)
    hit = hit > 0
    front = front > 0
    reacts = reacts > 0
    memory = DriverState(since, brakes, decided=hit)
    for t in range(own.shape[0]):
        gap = rear[t] - way - length / 2
        met, lateral, long = (
            value[t].expand_as(gap) for value in (other, aside, extent)
        )
        seen = Observation(
            speed,
            way,
            gap=gap,
            other_speed=met,
            lateral_gap=lateral,
            lateral_speed=way,
            overlaps=lateral <= 0,
            length=length,
            other_length=long,
        )
        memory, asked = drivers.step(memory, seen)
        reacts = reacts | (asked < -1.0)
        planned = own[t].expand_as(speed)
        after = (
            speed + DT * torch.where(reacts, torch.minimum(asked, planned), planned)
        ).clamp(min=0)
        way = way + (speed + after) / 2 * DT
        speed = after
        now = rear[t + 1] - way - length / 2
        touch = (
            (now < 0) & (now > -(length + extent[t + 1])) & (aside[t + 1] < 0) & ~hit
        )
        front = front | (touch & (gap > -FRONT_GAP) & (speed > MOVING))
        time = torch.where(touch, moments[t], time)
        hit = hit | touch
    return (
        speed,
        way,
        *memory[:2],
        *(torch.where(value, 1.0, 0.0) for value in (hit, front, reacts)),
        time,
    )


def time_before(world: World, ego_plan: Tensor, since: Tensor) -> Tensor:
    """`since` [B, V] of the present moment, one replan after `since` was right."""
    vehicles = since.shape[1]
    size = world.scene["size"]
    path = torch.cat([world.states[:, :1], ego_plan[:, :HORIZON]], 1)
    present = world.valid[:, None, :vehicles]
    seen = along_way(
        path,
        size[:, 0, 1],
        others=Tracks(
            world.states[:, None, :vehicles], size[:, :vehicles], present=present
        ),
    )
    gap = seen.rear[0] - size[:, :1, 0] / 2
    closing = world.states[:, :1, 3].abs() - seen.speed[0]
    driver = HumanDriver()
    before = (seen.lateral_gap[0] <= 0) & (closing > 0) & (gap > 0)
    needed = torch.maximum(
        closing * driver.time_to_collision, driver.stopping_gap(closing)
    )
    begun = torch.where(gap <= needed, 0.0, -1.0)
    return torch.where(
        before, torch.where(since >= 0, since + REPLAN_STEPS * DT, begun), -1.0
    )
