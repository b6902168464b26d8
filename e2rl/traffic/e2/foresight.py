"""V, the predicted verdict: would a plan make a driver fail whose place a competent one could take?

Each plan is met by a population of drivers who go the way that the ego is expected to go: the competent driver of UN
R157, four who react later and brake less, and one who does not react. A plan is worth the share of those that run into
it from behind, weighed towards the better ones, if the competent driver does not; it is worth nothing if that one does.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.drivers import HumanDriver, Observation, no_conflict
from e2rl.metrics.preventable import Along, Tracks, along_way
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.traffic import REPLAN_STEPS

# The competent driver first; the last never reacts.
DELAYS = (0.75, 0.85, 1.0, 1.25, 1.6, 99.0)  # s
BRAKING = (7.59, 6.5, 5.5, 5.0, 4.0, 1.0)  # m/s^2
WEIGHTS = (0.4, 0.3, 0.15, 0.1, 0.05)  # of the failures of all but the first
FRONT_GAP = 0.8  # m before the ego's front, a step before the contact, at least which makes it the ego's front
MOVING = 1.0  # m/s: slower drivers do not run into anybody
SOON = 0.1  # share of the worth that a failure at the end of the horizon loses


class Foresight(NamedTuple):
    """Of plans [G, O]: worth in [0, 1]; prevented: whether the competent driver is not hit; time [s] at which one who
    does not react is, inf for never."""

    worth: Tensor
    prevented: Tensor
    time: Tensor


def population(like: Tensor) -> HumanDriver:
    """The drivers, parameters [D, 1, 1]."""
    delay, braking = (like.new_tensor(values)[:, None, None] for values in (DELAYS, BRAKING))
    return HumanDriver(delay=delay, braking=braking, release=0.0)  # type: ignore[arg-type]


def foresee(path: Tensor, size: Tensor, tracks: Tensor, sizes: Tensor, since: Tensor, settled: Tensor) -> Foresight:
    """The Foresight of O plans of each of G vehicles, tracks [G, O, T + 1, 4] from now on, each alone with an ego.

    path [G, T + 1, 4]: the ego's expected states; size, sizes [G, 2] of ego and vehicle; since [G]: s for which the ego
    has had the vehicle before it (-1: not yet), when a competent driver would have begun to react; settled [G] bool:
    that driver would have prevented what has begun, so that it need not prevent what is left of it.
    """
    plans = tracks.transpose(1, 2)
    box = sizes[:, None].expand(*tracks.shape[:2], 2)
    along = along_way(path, size[:, 1], Tracks(plans, box, torch.ones_like(plans[..., 0], dtype=torch.bool)))
    hit, time = _contacts(path, size[:, 0], along, since)
    prevented, horizon = ~hit[0], DT * tracks.shape[2]
    worth = (hit[1:] * path.new_tensor(WEIGHTS)[:, None, None]).sum(0)
    worth = worth * (prevented | settled[:, None]) * (1 - SOON * time.clamp(max=horizon) / horizon)
    return Foresight(worth, prevented, time)


def _contacts(path: Tensor, length: Tensor, along: Along, since: Tensor) -> tuple[Tensor, Tensor]:
    """Whether drivers [D, G, O] run their front into the plans seen `along` path [G, T + 1, 4] ([T + 1, G, O] each),
    and when [G, O] s the one who does not react does; length [G] m of the ego, since [G].

    The competent driver counts any contact as its own.
    """
    drivers = population(path)
    shape = torch.broadcast_shapes(drivers.delay.shape, along.rear.shape[1:])  # type: ignore[attr-defined]
    speed, way = path[:, 0, 3, None].expand(shape), path.new_zeros(shape)
    memory = no_conflict(way)._replace(since=since[:, None].expand(shape))
    own, length = path[..., 3].diff(dim=1) / DT, length[:, None].expand(shape)
    hit, front, reacts = (torch.zeros_like(way, dtype=torch.bool) for _ in range(3))
    time = path.new_full(shape[1:], torch.inf)
    for t in range(path.shape[1] - 1):
        gap = along.rear[t] - way - length / 2
        kept = along.speed, along.lateral_gap, along.lateral_speed, along.length
        other, aside, nearing, extent = (value[t].expand_as(gap) for value in kept)
        seen = Observation(speed, speed * 0, gap, other, aside, nearing, aside <= 0, length, extent)
        memory, asked = drivers.step(memory, seen)
        reacts = reacts | (asked < -1.0)
        planned = own[:, t, None].expand(shape)
        after = (speed + DT * torch.where(reacts, torch.minimum(asked, planned), planned)).clamp(min=0)
        way, speed = way + (speed + after) / 2 * DT, after
        now = along.rear[t + 1] - way - length / 2
        touch = (now < 0) & (now > -(length + along.length[t + 1])) & (along.lateral_gap[t + 1] < 0) & ~hit
        front = front | (touch & (gap > -FRONT_GAP) & (speed > MOVING))
        time = torch.where(touch[-1], (t + 1) * DT, time)
        hit = hit | touch
    return torch.cat([hit[:1], front[1:]]), time


def time_before(world: World, ego_plan: Tensor, since: Tensor) -> Tensor:
    """`since` [B, V] of the present moment, one replan after `since` was right."""
    vehicles, size = since.shape[1], world.scene["size"]
    path = torch.cat([world.states[:, :1], ego_plan[:, :HORIZON]], 1)
    present = world.valid[:, None, :vehicles]
    seen = along_way(path, size[:, 0, 1], Tracks(world.states[:, None, :vehicles], size[:, :vehicles], present))
    gap = seen.rear[0] - size[:, :1, 0] / 2
    closing, driver = world.states[:, :1, 3] - seen.speed[0], HumanDriver()
    before = (seen.lateral_gap[0] <= 0) & (closing > 0) & (gap > 0)
    needed = torch.maximum(closing * driver.time_to_collision, driver.stopping_gap(closing))
    begun = torch.where(gap <= needed, 0.0, -1.0)
    return torch.where(before, torch.where(since >= 0, since + REPLAN_STEPS * DT, begun), -1.0)
