"""Would a competent driver in the ego's place have had the collision (docs/verdicts.md)?

The ego is driven again along its own way; all others are replayed. A vehicle behind that is replayed into a driver who
brakes earlier than the ego did is driven again, too: if its own competent braking avoids the contact, it does not
count. Such chains are at most two vehicles long.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scene.boxes import to_frame
from e2rl.scene.recording import DT
from e2rl.verdicts.drivers import DRIVERS, Driver
from e2rl.verdicts.redrive import Along, Tracks, along_way, contacts, redrive

NEAREST = 16  # vehicles that come nearest to the ego are seen
AFTER = round(3.0 / DT)  # steps beyond the ego's contact for which the driver must have none
CHAIN = 2  # followers that may be driven again
SAME_WAY = 0.5  # cosine of the headings of a follower and its leader at least


class Collision(NamedTuple):
    """B collisions: states [B, T+1, N, 4] (the ego in row 0), present [B, T+1, N], size [B, N, 2]; partner, stop [B]
    int64: row of the vehicle that the ego hits, and the step."""

    states: Tensor
    present: Tensor
    size: Tensor
    partner: Tensor
    stop: Tensor


class Prevention(NamedTuple):
    """Of B collisions: avoided [B] bool; followers [B] int64: vehicles behind the ego that had to brake for it; states
    [B, T+1, 4]: of the driver."""

    avoided: Tensor
    followers: Tensor
    states: Tensor


def nearest_first(collision: Collision) -> Collision:
    """The collision with the ego, its partner, then the other NEAREST - 1 vehicles by their least distance to it."""
    states, present = collision.states, collision.present
    gap = (states[..., :2] - states[:, :, :1, :2]).square().sum(-1).masked_fill(~present, torch.inf).amin(1)
    gap[:, 0] = -2.0
    gap = gap.scatter(1, collision.partner[:, None], -1.0)
    order = gap.argsort(dim=1, stable=True)[:, : NEAREST + 1]
    row = torch.arange(len(states), device=states.device)[:, None]
    times = torch.arange(states.shape[1], device=states.device)[None, :, None]
    at = row[..., None], times, order[:, None]
    partner = torch.ones_like(collision.partner)
    return Collision(held(states[at], present[at]), present[at], collision.size[row, order], partner, collision.stop)


def held(states: Tensor, present: Tensor) -> Tensor:
    """States [B, T+1, N, 4] with those of absent vehicles replaced by their last (else their first) present ones."""
    steps = torch.arange(states.shape[1], device=states.device)[None, :, None].expand_as(present)
    last = steps.masked_fill(~present, -1).cummax(1).values
    first = present.int().argmax(1, keepdim=True)
    index = torch.where(last >= 0, last, first)
    return states.gather(1, index[..., None].expand_as(states))


def prevention(driver: Driver, collision: Collision, along: Along) -> Prevention:
    """What becomes of collisions sorted by `nearest_first` with a driver in the ego's place; along: the others seen
    along the ego's way."""
    states, present, size, _, stop = collision
    others = Tracks(states[:, :, 1:], size[:, 1:], present[:, :, 1:])
    driven = redrive(driver, states[:, :, 0], size[:, 0], along)
    steps = torch.arange(states.shape[1], device=states.device)
    counts = (steps >= 1) & (steps <= stop[:, None] + AFTER)
    touched = contacts(driven, size[:, 0], others) & counts[..., None]
    avoided, followers = ~touched[:, :, 0].any(1), torch.zeros_like(stop)
    leader, leader_size = driven, size[:, 0]
    blamed = touched.any(1)
    blamed[:, 0] = False  # the partner
    for _ in range(CHAIN):
        hits = blamed.any(1) & avoided
        if not bool(hits.any()):
            break
        first = touched.int().argmax(1).masked_fill(~blamed, len(steps)).argmin(1)
        row = torch.arange(len(stop), device=stop.device)
        follows = _follows(leader, others, touched, first) & (blamed.sum(1) == 1)
        avoided = avoided & (~hits | follows)
        track, track_size = others.states[row, :, first], others.size[row, first]
        ahead = Tracks(leader[:, :, None], leader_size[:, None], torch.ones_like(touched[..., :1]))
        braked = redrive(DRIVERS["human"], track, track_size, along_way(track, track_size[:, 1], ahead))
        still = (contacts(braked, track_size, ahead)[..., 0] & counts).any(1)
        avoided = avoided & (~hits | ~still)
        followers = followers + (hits & avoided).long()
        itself = torch.nn.functional.one_hot(first, blamed.shape[1]).bool()
        before = contacts(track, track_size, others) & counts[..., None]
        touched = contacts(braked, track_size, others) & counts[..., None] & ~before.any(1, keepdim=True)
        blamed = touched.any(1) & ~itself & hits[:, None] & avoided[:, None]
        touched = touched & ~itself[:, None]
        leader, leader_size = braked, track_size
    return Prevention(avoided, followers, driven)


def _follows(leader: Tensor, others: Tracks, touched: Tensor, index: Tensor) -> Tensor:
    """Bool [B]: others index [B] run into the rear of their leader at [B, T+1, 4]: they are behind it, along its
    heading, when they first touch it."""
    row = torch.arange(len(index), device=index.device)
    step = touched[row, :, index].int().argmax(1)
    other, ahead = others.states[row, step, index], leader[row, step]
    behind = to_frame(other[:, :2], ahead)[:, 0] < 0
    return behind & ((other[:, 2] - ahead[:, 2]).cos() > SAME_WAY)


def preventions(collision: Collision, drivers: dict[str, Driver] = DRIVERS) -> dict[str, Prevention]:
    """The Prevention of B collisions by each driver."""
    collision = nearest_first(collision)
    others = Tracks(collision.states[:, :, 1:], collision.size[:, 1:], collision.present[:, :, 1:])
    along = along_way(collision.states[:, :, 0], collision.size[:, 0, 1], others)
    return {name: prevention(driver, collision, along) for name, driver in drivers.items()}
