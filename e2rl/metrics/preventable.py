"""Would a competent driver in the ego's place have had the collision
(docs/verdicts.md)?

The ego is driven again along its own path; all others are replayed. A vehicle behind
that is replayed into a driver who brakes earlier than the ego did is driven again, too:
if its own competent braking avoids the contact, it does not count. Such chains are at
most two vehicles long.

Shapes: B rollouts, T + 1 states of DT, N others. A vehicle's path is the one that it
drove, straight on from its end. The driver keeps the recorded acceleration until it
reacts, then what it asks for; it never steers and never drives faster than recorded.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.contact import with_passing
from e2rl.metrics.drivers import DRIVERS, Driver, Observation, no_conflict
from e2rl.metrics.geometry import travel_heading
from e2rl.run.fused import fused
from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, project
from e2rl.sim.dynamics import constant_velocity, wrap

STRAIGHT = 60.0  # m by which a way goes on straight
NEAREST = 16  # vehicles that come nearest to the ego are seen
AFTER = round(
    3.0 / DT
)  # steps beyond the ego's contact for which the driver must have none
CHAIN = 2  # followers that may be driven again
CREEPING = 0.5  # m/s: an ego that is slower does not run into anybody
MOVED = 0.02  # m within a step that tell the direction of motion
LEAST_COSINE = 0.5  # cosine of the headings of a follower and its leader at least


class Tracks(NamedTuple):
    """Recorded motion of vehicles: states [B, T+1, N, 4], size [B, N, 2], present [B,
    T+1, N] bool."""

    states: Tensor
    size: Tensor
    present: Tensor


class Along(NamedTuple):
    """Others seen along a path, each [T+1, B, N]. Those absent or never on it are at an
    infinite distance."""

    rear: Tensor  # m, arc length of its near end
    speed: Tensor  # m/s, along the way
    lateral_gap: Tensor  # m, between the facing sides
    lateral_speed: Tensor  # m/s, towards the way
    length: Tensor  # m, along the way


def driven_length(states: Tensor) -> Tensor:
    """Arc length [B, T+1] m at each step of a path states [B, T+1, 4], 0 at its start."""
    return torch.nn.functional.pad(
        states[..., :2].diff(dim=1).norm(dim=-1).cumsum(-1), (1, 0)
    )


def last_direction(states: Tensor, step: Tensor) -> Tensor:
    """Returns the direction [B] rad in which vehicles moved last: against their heading
    where they reversed, and have halted since.

    Args:
        states: [B, T+1, 4]; speeds may be without sign.
        step: [B] int64, up to which motion counts and whose heading is taken.
    """
    row = torch.arange(len(step), device=step.device)
    change = states[..., :2].diff(dim=1)
    steps = torch.arange(change.shape[1], device=step.device)
    moved = (change.norm(dim=-1) > MOVED) & (steps < step[:, None])
    last = torch.where(moved, steps, -1).amax(1)
    heading = states[..., 2]
    began = heading[row, last.clamp(min=0)]
    along = change[row, last.clamp(min=0)]
    backwards = (last >= 0) & (
        along[:, 0] * began.cos() + along[:, 1] * began.sin() < 0
    )
    present = heading[row, step]
    return torch.where(backwards, wrap(present + torch.pi), present)


def poses(states: Tensor, s: Tensor) -> Tensor:
    """Poses [B, K, 3] at arc lengths s [B, K] of a path states [B, T+1, 4], straight on
    beyond its end."""
    length = driven_length(states)
    after = torch.searchsorted(length, s.contiguous(), right=True).clamp(
        1, length.shape[1] - 1
    )
    low = length.gather(1, after - 1)
    high = length.gather(1, after)
    fraction = ((s - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)[..., None]
    first, second = (
        states.gather(1, index[..., None].expand(-1, -1, 4))
        for index in (after - 1, after)
    )
    heading = first[..., 2] + fraction[..., 0] * wrap(second[..., 2] - first[..., 2])
    beyond = (s - length[:, -1:]).clamp(min=0)[..., None]
    onwards = last_direction(
        states, torch.full_like(s[:, 0], states.shape[1] - 1).long()
    )[:, None]
    ahead = torch.stack([onwards.cos(), onwards.sin()], -1)
    return torch.cat(
        [
            torch.lerp(first[..., :2], second[..., :2], fraction) + beyond * ahead,
            heading[..., None],
        ],
        -1,
    )


def along_way(states: Tensor, width: Tensor, others: Tracks) -> Along:
    """Others seen along the path states [B, T+1, 4] of a vehicle of `width` [B] m."""
    reach = STRAIGHT + (driven_length(states).amax().item() if len(states) else 0.0)
    vertices = SPACING * torch.arange(
        int(reach / SPACING) + 2, device=states.device, dtype=states.dtype
    )
    route = poses(states, vertices.expand(len(states), -1))[..., :2]
    return Along(
        *seen_along(
            route, width, others.states, others.size, others.present.to(route.dtype)
        )
    )


@fused("B P 2", "B", "B T N 4", "B N 2", "B T N")
def seen_along(
    route: Tensor, width: Tensor, states: Tensor, size: Tensor, present: Tensor
) -> tuple[Tensor, ...]:
    """The fields of Along of others states [B, T+1, N, 4], size [B, N, 2], present (1
    or 0) along routes [B, P, 2]."""
    s, d, heading = project(states[..., :2].flatten(1, 2), route)
    s, d, heading = (value.unflatten(1, present.shape[1:]) for value in (s, d, heading))
    turn = states[..., 2] - heading
    speed = states[..., 3]
    cos = turn.cos()
    sin = turn.sin()
    half = size[:, None] / 2
    extent = half[..., 0] * cos.abs() + half[..., 1] * sin.abs()
    side = half[..., 0] * sin.abs() + half[..., 1] * cos.abs()
    gap = d.abs() - side - width[:, None, None] / 2
    enters = torch.where(gap <= 0, present, 0.0).amax(1, keepdim=True)
    away = (present == 0) | (enters == 0)
    rear, gap = (value.masked_fill(away, torch.inf) for value in (s - extent, gap))
    values = rear, speed * cos, gap, -d.sign() * speed * sin, 2 * extent
    return tuple(value.transpose(0, 1).contiguous() for value in values)


def redrive(driver: Driver, states: Tensor, size: Tensor, others: Along) -> Tensor:
    """States [B, T+1, 4] of a vehicle whose path is states [B, T+1, 4] and whose driver
    sees `others`; size [B, 2].

    It reacts to each of the others as if that were alone, and brakes for the one that
    asks most.
    """
    along = states[..., 3].abs()  # the way has no backwards
    recorded = along.diff(dim=1) / DT
    speed = along[:, 0]
    s = torch.zeros_like(along[:, 0])
    acceleration = torch.zeros_like(speed)
    reacted = torch.zeros_like(speed, dtype=torch.bool)
    memory = no_conflict(others.rear[0])
    length = size[:, :1].expand_as(others.rear[0])
    way = [s]
    speeds = [speed]
    for t in range(recorded.shape[1]):
        gap = others.rear[t] - (s + size[:, 0] / 2)[:, None]
        side = others.lateral_gap[t]
        own = speed[:, None].expand_as(gap), acceleration[:, None].expand_as(gap)
        lateral = side, others.lateral_speed[t], side <= 0
        seen = Observation(
            *own, gap, others.speed[t], *lateral, length, others.length[t]
        )
        memory, wanted = driver.step(memory, seen)
        asked = wanted.amin(1)
        reacted = reacted | (asked < 0)
        chosen = torch.where(
            reacted, torch.minimum(asked, recorded[:, t]), recorded[:, t]
        )
        after = (speed + chosen * DT).clamp(min=0)
        acceleration = (after - speed) / DT
        s = s + (speed + after) / 2 * DT
        speed = after
        way.append(s)
        speeds.append(speed)
    way_driven = torch.stack(way, 1)
    speed_driven = torch.stack(speeds, 1)
    return torch.cat([poses(states, way_driven), speed_driven[..., None]], -1)


def contacts(states: Tensor, size: Tensor, others: Tracks) -> Tensor:
    """Bool [B, T+1, N]: a vehicle at states [B, T+1, 4] of size [B, 2] overlaps each of
    the others, or has passed through it since the step before."""
    boxes = states[:, :, None], size[:, None, None], others.states, others.size[:, None]
    touches = (separation(*boxes) < 0) & others.present
    _, moment = with_passing(*boxes, others.present, touches.to(states.dtype))
    return touches | (moment < 1)


class Collision(NamedTuple):
    """B collisions: states [B, T+1, N, 4] (the ego in row 0), present [B, T+1, N], size
    [B, N, 2]; partner, stop [B] int64: row of the vehicle that the ego hits, and the
    step."""

    states: Tensor
    present: Tensor
    size: Tensor
    partner: Tensor
    stop: Tensor


class Prevention(NamedTuple):
    """Of B collisions: avoided [B] bool; followers [B] int64: vehicles behind the ego
    that had to brake for it; states [B, T+1, 4]: of the driver; struck [B] bool: the
    partner comes to the driver, who stands (CREEPING)."""

    avoided: Tensor
    followers: Tensor
    states: Tensor
    struck: Tensor


def nearest_first(collision: Collision) -> Collision:
    """The collision with the ego, its partner, then the other NEAREST - 1 vehicles by
    their least distance to it."""
    states = collision.states
    present = collision.present
    gap = (
        (states[..., :2] - states[:, :, :1, :2])
        .square()
        .sum(-1)
        .masked_fill(~present, torch.inf)
        .amin(1)
    )
    gap[:, 0] = -2.0
    gap = gap.scatter(1, collision.partner[:, None], -1.0)
    order = gap.argsort(dim=1, stable=True)[:, : NEAREST + 1]
    row = torch.arange(len(states), device=states.device)[:, None]
    times = torch.arange(states.shape[1], device=states.device)[None, :, None]
    at = row[..., None], times, order[:, None]
    partner = torch.ones_like(collision.partner)
    return Collision(
        held(states[at], present[at]),
        present[at],
        size=collision.size[row, order],
        partner=partner,
        stop=collision.stop,
    )


def seen_out(collision: Collision) -> Collision:
    """The collision with AFTER more steps at constant velocity, so that the end of a
    rollout saves nobody."""
    states = collision.states
    present = collision.present
    times = DT * torch.arange(1, AFTER + 1, device=states.device, dtype=states.dtype)
    more = constant_velocity(states[:, -1], times).transpose(1, 2)
    longer = present[:, -1:].expand(-1, AFTER, -1)
    return collision._replace(
        states=torch.cat([states, more], 1), present=torch.cat([present, longer], 1)
    )


def held(states: Tensor, present: Tensor) -> Tensor:
    """States [B, T+1, N, 4] with those of absent vehicles replaced by their last (else
    their first) present ones."""
    steps = torch.arange(states.shape[1], device=states.device)[
        None, :, None
    ].expand_as(present)
    last = steps.masked_fill(~present, -1).cummax(1).values
    first = present.int().argmax(1, keepdim=True)
    index = torch.where(last >= 0, last, first)
    return states.gather(1, index[..., None].expand_as(states))


def prevention(driver: Driver, collision: Collision, along: Along) -> Prevention:
    """What becomes of collisions sorted by `nearest_first` with a driver in the ego's
    place; along: the others seen along the ego's way."""
    states, present, size, _, stop = collision
    others = Tracks(states[:, :, 1:], size[:, 1:], present=present[:, :, 1:])
    driven = redrive(driver, states[:, :, 0], size=size[:, 0], others=along)
    steps = torch.arange(states.shape[1], device=states.device)
    counts = (steps >= 1) & (steps <= stop[:, None] + AFTER)
    touched = contacts(driven, size[:, 0], others=others) & counts[..., None]
    avoided = ~touched[:, :, 0].any(1)
    followers = torch.zeros_like(stop)
    first = touched[:, :, 0].int().argmax(1)
    struck = ~avoided & (
        driven[torch.arange(len(stop), device=stop.device), first, 3] <= CREEPING
    )
    leader = driven
    leader_size = size[:, 0]
    blamed = touched.any(1)
    blamed[:, 0] = False  # the partner
    for _ in range(CHAIN):
        hits = blamed.any(1) & avoided
        if not bool(hits.any()):
            break
        first = touched.int().argmax(1).masked_fill(~blamed, len(steps)).argmin(1)
        row = torch.arange(len(stop), device=stop.device)
        follows = _follows(leader, others, touched=touched, index=first) & (
            blamed.sum(1) == 1
        )
        avoided = avoided & (~hits | follows)
        track = others.states[row, :, first]
        track_size = others.size[row, first]
        ahead = Tracks(
            leader[:, :, None],
            leader_size[:, None],
            present=torch.ones_like(touched[..., :1]),
        )
        braked = redrive(
            DRIVERS["human"],
            track,
            size=track_size,
            others=along_way(track, track_size[:, 1], others=ahead),
        )
        still = (contacts(braked, track_size, others=ahead)[..., 0] & counts).any(1)
        avoided = avoided & (~hits | ~still)
        followers = followers + (hits & avoided).long()
        itself = torch.nn.functional.one_hot(first, blamed.shape[1]).bool()
        before = contacts(track, track_size, others=others) & counts[..., None]
        touched = (
            contacts(braked, track_size, others=others)
            & counts[..., None]
            & ~before.any(1, keepdim=True)
        )
        blamed = touched.any(1) & ~itself & hits[:, None] & avoided[:, None]
        touched = touched & ~itself[:, None]
        leader = braked
        leader_size = track_size
    return Prevention(avoided, followers, states=driven, struck=struck)


def _follows(leader: Tensor, others: Tracks, touched: Tensor, index: Tensor) -> Tensor:
    """Bool [B]: others index [B] run into the rear of their leader at [B, T+1, 4]: they
    are behind it, along its heading, when they first touch it."""
    row = torch.arange(len(index), device=index.device)
    step = touched[row, :, index].int().argmax(1)
    other = others.states[row, step, index]
    ahead = leader[row, step]
    onwards = last_direction(leader, step)
    behind = (
        to_frame(other[:, :2], torch.cat([ahead[:, :2], onwards[:, None]], -1))[:, 0]
        < 0
    )
    return behind & ((travel_heading(other) - onwards).cos() > LEAST_COSINE)


def preventions(
    collision: Collision, drivers: dict[str, Driver] = DRIVERS
) -> dict[str, Prevention]:
    """The Prevention of B collisions by each driver."""
    until = collision.states.shape[1]
    collision = seen_out(nearest_first(collision))
    others = Tracks(
        collision.states[:, :, 1:],
        collision.size[:, 1:],
        present=collision.present[:, :, 1:],
    )
    along = along_way(collision.states[:, :, 0], collision.size[:, 0, 1], others=others)
    found = {
        name: prevention(driver, collision, along=along)
        for name, driver in drivers.items()
    }
    return {
        name: each._replace(states=each.states[:, :until])
        for name, each in found.items()
    }
