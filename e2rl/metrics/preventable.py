"""Would a competent driver in the ego's place have had the collision
(docs/reference/verdicts.md)?

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
from torch.nn.functional import one_hot, pad

from e2rl.metrics.drivers import DRIVERS, Driver, Observation, no_conflict
from e2rl.metrics.geometry import travel_heading
from e2rl.metrics.passing import with_passing
from e2rl.run.fused import fused
from e2rl.scenes.boxes import separation, to_frame, unit_vectors
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, project
from e2rl.sim.dynamics import constant_velocity, wrap

STRAIGHT = 60.0  # m by which a path goes on straight
NEAREST = 16  # vehicles that come nearest to the ego are seen
AFTER = round(3.0 / DT)  # steps after the ego's contact in which the driver has none
CHAIN = 2  # followers that may be driven again
CREEPING = 0.5  # m/s: an ego that is slower does not run into anybody
MOVED = 0.02  # m within a step that tell the direction of motion
LEAST_COSINE = 0.5  # of the angle between a follower and its leader


class Tracks(NamedTuple):
    """Recorded motion of vehicles."""

    states: Tensor  # [B, T+1, N, 4]
    size: Tensor  # [B, N, 2]
    present: Tensor  # [B, T+1, N] bool


class Along(NamedTuple):
    """Others seen along a path, each [T+1, B, N]. Those absent or never on it are at an
    infinite distance."""

    rear: Tensor  # m, arc length of its near end
    speed: Tensor  # m/s, along the path
    lateral_gap: Tensor  # m, between the facing sides
    lateral_speed: Tensor  # m/s, towards the path
    length: Tensor  # m, along the path


class Collision(NamedTuple):
    """B collisions of the ego, which is in row 0."""

    states: Tensor  # [B, T+1, N, 4]
    present: Tensor  # [B, T+1, N] bool
    size: Tensor  # [B, N, 2]
    partner: Tensor  # [B] int64, row of the vehicle that the ego hits
    stop: Tensor  # [B] int64, step of the contact

    @property
    def others(self) -> Tracks:
        """All but the ego."""
        return Tracks(
            self.states[:, :, 1:],
            self.size[:, 1:],
            present=self.present[:, :, 1:],
        )


class Prevention(NamedTuple):
    """What becomes of B collisions with a driver in the ego's place."""

    avoided: Tensor  # [B] bool
    followers: Tensor  # [B] int64, vehicles behind that had to brake for the driver
    states: Tensor  # [B, T+1, 4], of the driver
    struck: Tensor  # [B] bool: the partner comes to the driver, who stands


def preventions(
    collision: Collision, drivers: dict[str, Driver] = DRIVERS
) -> dict[str, Prevention]:
    """The Prevention of B collisions by each driver."""
    length = collision.states.shape[1]
    collision = extended(nearest_first(collision))
    along = along_path(
        collision.states[:, :, 0],
        collision.size[:, 0, 1],
        others=collision.others,
    )
    result = {}
    for name, driver in drivers.items():
        preventions = prevention(
            driver,
            collision,
            along=along,
        )
        result[name] = preventions._replace(states=preventions.states[:, :length])
    return result


def prevention(driver: Driver, collision: Collision, along: Along) -> Prevention:
    """What becomes of collisions sorted by `nearest_first` with a driver in the ego's
    place; along: the others seen along the ego's path."""
    others = collision.others
    stop = collision.stop
    size = collision.size[:, 0]
    driven = redrive(
        driver,
        collision.states[:, :, 0],
        size=size,
        others=along,
    )
    steps = torch.arange(driven.shape[1], device=stop.device)
    counts = ((steps >= 1) & (steps <= stop[:, None] + AFTER))[..., None]
    touched = contacts(driven, size, others) & counts
    misses_partner = ~touched[:, :, 0].any(1)
    row = torch.arange(len(stop), device=stop.device)
    first_touch = touched[:, :, 0].int().argmax(1)
    stands = driven[row, first_touch, 3] <= CREEPING
    avoided, followers = followers_brake(
        Leader(driven, size),
        others,
        touched,
        counts=counts,
        avoided=misses_partner,
    )
    return Prevention(
        avoided,
        followers,
        states=driven,
        struck=~misses_partner & stands,
    )


class Leader(NamedTuple):
    """A vehicle that was driven again, into which others are replayed."""

    states: Tensor  # [B, T+1, 4]
    size: Tensor  # [B, 2]

    @property
    def track(self) -> Tracks:
        """The same, as the only one of N = 1 vehicles."""
        present = torch.ones_like(self.states[:, :, :1], dtype=torch.bool)
        return Tracks(
            self.states[:, :, None],
            self.size[:, None],
            present=present,
        )


def followers_brake(
    leader: Leader,
    others: Tracks,
    touched: Tensor,
    *,
    counts: Tensor,
    avoided: Tensor,
) -> tuple[Tensor, Tensor]:
    """Whether collisions are still avoided once all followers brake as a competent
    driver does, and how many had to, each [B].

    Args:
        leader: the driver in the ego's place.
        others: the vehicles replayed, the ego's partner first.
        touched: [B, T+1, N] bool, those that touch the leader.
        counts: [B, T+1, 1] bool, steps in which a contact counts.
        avoided: [B] bool, the partner is not touched.
    """
    followers = torch.zeros(
        len(avoided),
        dtype=torch.int64,
        device=avoided.device,
    )
    row = torch.arange(len(avoided), device=avoided.device)
    blamed = touched.any(1)
    blamed[:, 0] = False  # the partner
    for _ in range(CHAIN):
        hits = blamed.any(1) & avoided
        if not hits.any():
            break
        first_touch = touched.int().argmax(1)
        follower = first_touch.masked_fill(~blamed, touched.shape[1]).argmin(1)
        comes_from_behind = follows(
            leader.states,
            others,
            step=first_touch[row, follower],
            index=follower,
        )
        avoided = avoided & (~hits | (comes_from_behind & (blamed.sum(1) == 1)))
        states = others.states[row, :, follower]
        size = others.size[row, follower]
        braked = redrive(
            DRIVERS["human"],
            states,
            size=size,
            others=along_path(
                states,
                size[:, 1],
                others=leader.track,
            ),
        )
        still_hits = (contacts(braked, size, leader.track) & counts).any(1)
        avoided = avoided & (~hits | ~still_hits[:, 0])
        followers = followers + (hits & avoided).long()
        recorded = (contacts(states, size, others) & counts).any(1, keepdim=True)
        itself = one_hot(follower, blamed.shape[1]).bool()[:, None]
        touched = contacts(braked, size, others) & counts & ~recorded & ~itself
        blamed = touched.any(1) & (hits & avoided)[:, None]
        leader = Leader(braked, size)
    return avoided, followers


def follows(leader: Tensor, others: Tracks, *, step: Tensor, index: Tensor) -> Tensor:
    """Whether [B] others run into the rear of their leader: they are behind it, along
    its heading, when they first touch it.

    Args:
        leader: states [B, T+1, 4].
        others: the vehicles replayed.
        step: [B] int64, of the first touch.
        index: [B] int64, the other.
    """
    row = torch.arange(len(index), device=index.device)
    other = others.states[row, step, index]
    direction = last_direction(leader, step)
    frame = torch.cat([leader[row, step, :2], direction[:, None]], -1)
    behind = to_frame(other[:, :2], frame)[:, 0] < 0
    return behind & ((travel_heading(other) - direction).cos() > LEAST_COSINE)


def redrive(driver: Driver, states: Tensor, *, size: Tensor, others: Along) -> Tensor:
    """States [B, T+1, 4] of a vehicle with another driver on its own path.

    It reacts to each of the others as if that were alone, and brakes for the one that
    asks most.

    Args:
        driver: of `drivers`.
        states: [B, T+1, 4], the vehicle's path.
        size: [B, 2], of the vehicle.
        others: what the driver sees.
    """
    recorded_speed = states[..., 3].abs()  # the path has no backwards
    recorded = recorded_speed.diff(dim=1) / DT
    speed = recorded_speed[:, 0]
    s = torch.zeros_like(speed)
    acceleration = torch.zeros_like(speed)
    has_reacted = torch.zeros_like(speed, dtype=torch.bool)
    memory = no_conflict(others.rear[0])
    lengths = [s]
    speeds = [speed]
    for t in range(recorded.shape[1]):
        gap = others.rear[t] - (s + size[:, 0] / 2)[:, None]
        observation = Observation(
            speed=speed[:, None].expand_as(gap),
            acceleration=acceleration[:, None].expand_as(gap),
            gap=gap,
            other_speed=others.speed[t],
            lateral_gap=others.lateral_gap[t],
            lateral_speed=others.lateral_speed[t],
            length=size[:, :1].expand_as(gap),
            other_length=others.length[t],
        )
        memory, reactions = driver.step(memory, observation)
        reaction = reactions.amin(1)
        has_reacted = has_reacted | (reaction < 0)
        planned = recorded[:, t]
        wanted = torch.where(has_reacted, torch.minimum(reaction, planned), planned)
        next_speed = (speed + wanted * DT).clamp(min=0)
        acceleration = (next_speed - speed) / DT
        s = s + (speed + next_speed) / 2 * DT
        speed = next_speed
        lengths.append(s)
        speeds.append(speed)
    driven = poses(states, torch.stack(lengths, 1))
    return torch.cat([driven, torch.stack(speeds, 1)[..., None]], -1)


def contacts(states: Tensor, size: Tensor, others: Tracks) -> Tensor:
    """Bool [B, T+1, N]: a vehicle at states [B, T+1, 4] of size [B, 2] overlaps each of
    the others, or has passed through it in the step before."""
    first = states[:, :, None]
    first_size = size[:, None, None]
    second_size = others.size[:, None]
    gap = separation(
        first,
        first_size,
        second=others.states,
        second_size=second_size,
    )
    touches = (gap < 0) & others.present
    _, moment = with_passing(
        first,
        first_size,
        second=others.states,
        second_size=second_size,
        possible=others.present,
        area=touches.to(states.dtype),
    )
    return touches | (moment < 1)


def driven_length(states: Tensor) -> Tensor:
    """Arc length [B, T+1] m at each step of a path states [B, T+1, 4], 0 at its start."""
    return pad(states[..., :2].diff(dim=1).norm(dim=-1).cumsum(-1), (1, 0))


def last_direction(states: Tensor, step: Tensor) -> Tensor:
    """Direction [B] rad in which vehicles at states [B, T+1, 4] moved last, up to step
    [B]: against their heading where they reversed, and have halted since."""
    row = torch.arange(len(step), device=step.device)
    change = states[..., :2].diff(dim=1)
    steps = torch.arange(change.shape[1], device=step.device)
    moves = (change.norm(dim=-1) > MOVED) & (steps < step[:, None])
    last = torch.where(moves, steps, -1).amax(1)
    heading = states[row, last.clamp(min=0), 2]
    motion = change[row, last.clamp(min=0)]
    ahead = motion[:, 0] * heading.cos() + motion[:, 1] * heading.sin()
    present = states[row, step, 2]
    reversed_last = (last >= 0) & (ahead < 0)
    return torch.where(reversed_last, wrap(present + torch.pi), present)


def poses(states: Tensor, s: Tensor) -> Tensor:
    """Poses [B, K, 3] at arc lengths s [B, K] of a path states [B, T+1, 4], straight on
    beyond its end."""
    length = driven_length(states)
    after = torch.searchsorted(
        length,
        s.contiguous(),
        right=True,
    )
    after = after.clamp(1, length.shape[1] - 1)
    low = length.gather(1, after - 1)
    high = length.gather(1, after)
    fraction = ((s - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)[..., None]
    first = states.gather(1, (after - 1)[..., None].expand(-1, -1, 4))
    second = states.gather(1, after[..., None].expand(-1, -1, 4))
    turn = wrap(second[..., 2] - first[..., 2])
    heading = first[..., 2] + fraction[..., 0] * turn
    end = torch.full_like(after[:, 0], states.shape[1] - 1)
    onwards = last_direction(states, end)[:, None]
    direction = unit_vectors(onwards)
    beyond = (s - length[:, -1:]).clamp(min=0)[..., None]
    position = torch.lerp(first[..., :2], second[..., :2], fraction)
    return torch.cat([position + beyond * direction, heading[..., None]], -1)


def along_path(states: Tensor, width: Tensor, others: Tracks) -> Along:
    """Others seen along the path states [B, T+1, 4] of a vehicle of `width` [B] m."""
    reach = STRAIGHT + (driven_length(states).amax().item() if len(states) else 0.0)
    vertices = SPACING * torch.arange(
        int(reach / SPACING) + 2,
        device=states.device,
        dtype=states.dtype,
    )
    route = poses(states, vertices.expand(len(states), -1))[..., :2]
    present = others.present.to(route.dtype)
    return Along(*seen_along(route, width, others.states, others.size, present))


@fused("B P 2", "B", "B T N 4", "B N 2", "B T N")
def seen_along(
    route: Tensor,
    width: Tensor,
    states: Tensor,
    size: Tensor,
    present: Tensor,
) -> tuple[Tensor, ...]:
    """The fields of Along.

    Args:
        route: [B, P, 2], points of the path.
        width: [B] m, of the vehicle on it.
        states: [B, T+1, N, 4], of the others.
        size: [B, N, 2].
        present: [B, T+1, N], 1 or 0.
    """
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


def nearest_first(collision: Collision) -> Collision:
    """The collision with the ego, its partner, then the other NEAREST - 1 vehicles by
    their least distance to it."""
    states = collision.states
    present = collision.present
    apart = (states[..., :2] - states[:, :, :1, :2]).square().sum(-1)
    rank = apart.masked_fill(~present, torch.inf).amin(1)
    rank[:, 0] = -2.0
    rank = rank.scatter(1, collision.partner[:, None], -1.0)
    order = rank.argsort(dim=1, stable=True)[:, : NEAREST + 1]
    states = states.gather(
        2, order[:, None, :, None].expand(-1, states.shape[1], -1, states.shape[3])
    )
    present = present.gather(2, order[:, None].expand(-1, present.shape[1], -1))
    return Collision(
        hold(states, present),
        present,
        size=collision.size.gather(1, order[..., None].expand(-1, -1, 2)),
        partner=torch.ones_like(collision.partner),
        stop=collision.stop,
    )


def extended(collision: Collision) -> Collision:
    """The collision with AFTER more steps at constant velocity, so that the end of a
    rollout saves nobody."""
    states = collision.states
    present = collision.present
    times = DT * torch.arange(
        1,
        AFTER + 1,
        device=states.device,
        dtype=states.dtype,
    )
    onwards = constant_velocity(states[:, -1], times).transpose(1, 2)
    return collision._replace(
        states=torch.cat([states, onwards], 1),
        present=torch.cat([present, present[:, -1:].expand(-1, AFTER, -1)], 1),
    )


def hold(states: Tensor, present: Tensor) -> Tensor:
    """States [B, T+1, N, 4] with those of absent vehicles replaced by their last (else
    their first) present ones."""
    steps = torch.arange(states.shape[1], device=states.device)[:, None]
    last = torch.where(present, steps, -1).cummax(1).values
    first = present.int().argmax(1, keepdim=True)
    index = torch.where(last >= 0, last, first)
    return states.gather(1, index[..., None].expand_as(states))
