"""Interceptions: proposals off the lanes (Sec. IV-B1), a smooth path from a vehicle's
pose to its target's path.

Every planner expects a vehicle where its lane leads. One that cuts in or turns in early
leaves it for a few seconds: on a cubic from its pose to where the target will be at one
of several moments, at one constant acceleration, on the drivable area, clear of all
others, within limits that are proportional to the intensity. The prior then plans along
it as along any route, so what is driven stays a sample of the prior.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import HORIZON, KNOT_STEPS, KNOTS, LaneState
from e2rl.prior.routes import take_route
from e2rl.run.config import configured, setting
from e2rl.run.fused import fused
from e2rl.scenes.boxes import angle_of, overlap, unit_vectors
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.dynamics import SHARPEST, midpoints, wrap
from e2rl.sim.world import World
from e2rl.traffic.e2.foresight import foresee
from e2rl.traffic.e2.pull import SPREAD
from e2rl.traffic.motion import distance_to_stop_line, take

ENDS = 3  # directions tried at the end of a path
SAMPLES = 17  # points of a path that are checked
MAX_BEARING = 1.05  # rad between heading and target
MAX_TURN = 1.4  # rad between both ends of a path
CLEARANCE = 0.3  # m kept to others on the path
SHOULDER = 0.5  # m that its centre may leave the drivable area by
# Fraction of both lengths by which boxes that move alike touch before their centres do.
TOUCH = 0.4

# What an interception weighs, in seconds of time gap.
ACCEL_COST = 0.2  # of 1 m/s^2
LATERAL_COST = 0.2  # of 1 m/s^2 of lateral acceleration
TIME_COST = 0.1  # of 1 s until the meeting
MOMENT_COST = 1.0  # of 1 s before or after the moment that is wished for
WORTH = 2.0  # by which a path is preferred that only the competent driver survives


@configured("synthesizer/e2", "interception")
@dataclass(frozen=True)
class InterceptionSettings:
    """Limits per unit of intensity; conf/synthesizer/e2.yaml explains each."""

    reach: float = setting(low=0, high=HORIZON * DT)
    push: float = setting(low=0)
    brake: float = setting(low=0)
    lateral: float = setting(low=0)
    wrong_way: float = setting(low=0)
    preference: float = setting()


class Interception(NamedTuple):
    """path [B, M, P, 2]: a vertex every SPACING m; knots [B, M, 10] m/s^2; cost [B, M]
    s, inf for none."""

    path: Tensor
    knots: Tensor
    cost: Tensor


class Wish(NamedTuple):
    """What is asked of interceptions, each [B]: intensity eta; moment s of the meeting,
    negative: the cheapest; wrong_way s: weight, beside the settings', of ending against
    the lanes."""

    eta: Tensor
    moment: Tensor
    wrong_way: Tensor


class _Paths(NamedTuple):
    """O paths of each vehicle: points and tangents [B, M, O, U, 2] at even parameters;
    length [B, M, O, U]: m to each point; bearing, turn [B, M, O]: angles from the
    heading to the target and to the end; end_heading [B, M, O].
    """

    points: Tensor
    tangents: Tensor
    length: Tensor
    bearing: Tensor
    turn: Tensor
    end_heading: Tensor


class _Drive(NamedTuple):
    """How paths are driven: speed [B, M, 1] m/s at their start, accel [B, M, O] m/s^2,
    time [B, M, O] s until the meeting."""

    speed: Tensor
    accel: Tensor
    time: Tensor


def cubic(
    start: Tensor,
    heading: Tensor,
    end: Tensor,
    end_heading: Tensor,
    u: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns points and derivatives [..., U, 2] of the cubic Hermite curve between two
    poses.

    Where one circle is tangent to both poses the curve is its arc, to a thousandth of
    the radius.

    Args:
        start: [..., 2] m.
        heading: [...] rad, at the start.
        end: [..., 2] m.
        end_heading: [...] rad.
        u: [U], parameters in [0, 1].
    """
    chord = end - start
    bearing = wrap(angle_of(chord) - heading)
    arc = (bearing / 2).cos().square().clamp(min=0.5)[..., None]
    chord = chord.norm(dim=-1)[..., None] / arc
    a = start[..., None, :]
    b = end[..., None, :]
    m = (chord * unit_vectors(heading))[..., None, :]
    n = (chord * unit_vectors(end_heading))[..., None, :]
    u = u[:, None]
    points = (
        (2 * u**3 - 3 * u**2 + 1) * a
        + (u**3 - 2 * u**2 + u) * m
        + (3 * u**2 - 2 * u**3) * b
        + (u**3 - u**2) * n
    )
    tangents = (
        (6 * u**2 - 6 * u) * (a - b)
        + (3 * u**2 - 4 * u + 1) * m
        + (3 * u**2 - 2 * u) * n
    )
    return points, tangents


def _paths(states: Tensor, meeting: Tensor) -> _Paths:
    """Paths to meeting states [B, M, I, 4], ENDS to each: on an arc, straight at the
    target, or into its heading."""
    heading = states[:, :, None, 2].expand(meeting.shape[:3])
    gap = meeting[..., :2] - states[:, :, None, :2]
    bearing = wrap(angle_of(gap) - heading)
    ends = (heading + 2 * bearing, heading + bearing, meeting[..., 2])
    end_heading = torch.stack(ends, -1).flatten(2)
    heading, bearing, xy = (
        value.repeat_interleave(ENDS, 2)
        for value in (heading, bearing, meeting[..., :2])
    )
    start = states[:, :, None, :2].expand_as(xy)
    u = torch.linspace(0, 1, SAMPLES, device=states.device)
    points, tangents = cubic(start, heading, end=xy, end_heading=end_heading, u=u)
    length = points.diff(dim=3).norm(dim=-1).cumsum(-1)
    return _Paths(
        points,
        tangents,
        length=torch.nn.functional.pad(length, (1, 0)),
        bearing=bearing,
        turn=wrap(end_heading - heading),
        end_heading=end_heading,
    )


def _lateral(paths: _Paths, drive: _Drive) -> tuple[Tensor, Tensor]:
    """Largest lateral acceleration [m/s^2] and curvature [1/m] on paths."""
    heading = angle_of(paths.tangents)
    turn = wrap(heading.diff(dim=-1))
    curvature = (turn / paths.length.diff(dim=-1).clamp(min=0.1)).abs()
    gained = 2 * drive.accel[..., None] * paths.length[..., 1:]
    squared_speed = (drive.speed[..., None] ** 2 + gained).clamp(min=0)
    return (squared_speed * curvature).amax(-1), curvature.amax(-1)


def _within_limits(
    paths: _Paths,
    drive: _Drive,
    eta: Tensor,
    settings: InterceptionSettings,
) -> Tensor:
    """Bool [B, M, O]: paths keep the limits of intensities eta [B, 1, 1]."""
    lateral, curvature = _lateral(paths, drive)
    accel = drive.accel
    arrives = drive.speed + accel * drive.time >= 0
    gentle = (accel <= settings.push * eta) & (accel >= -settings.brake * eta)
    gentle &= (lateral <= settings.lateral * eta) & (curvature < SHARPEST)
    ahead = (paths.bearing.abs() < MAX_BEARING) & (paths.turn.abs() < MAX_TURN)
    return gentle & arrives & ahead


def _on_road(paths: _Paths, states: Tensor, scene: TensorDictBase) -> Tensor:
    """Bool [B, M, O]: paths from states [B, M, 4] leave the drivable area by no more
    than the shoulder, or than now."""
    field = scene["field"]
    origin = scene["field_origin"]
    allowed = off_road(states[..., :2], field, origin).clamp(min=SHOULDER)
    return off_road(paths.points, field, origin).amax(-1) <= allowed[..., None]


class _Others(NamedTuple):
    """Whom a path must not touch: states [B, J, W, 4] at W moments and sizes [B, J, 2]
    of everybody, and who counts [B, M, J] bool."""

    states: Tensor
    sizes: Tensor
    counts: Tensor


def _clear(paths: _Paths, travelled: Tensor, size: Tensor, others: _Others) -> Tensor:
    """Bool [B, M, O]: vehicles touch none of the others after `travelled` [B, M, O, W]
    m of their paths (< 0: arrived)."""
    index = torch.searchsorted(paths.length.contiguous(), travelled.contiguous())
    index = index.clamp(0, SAMPLES - 1)[..., None]
    index = index.expand(*index.shape[:-1], 2)
    tangent = paths.tangents.gather(3, index)
    heading = torch.atan2(tangent[..., 1:], tangent[..., :1])
    points = paths.points.gather(3, index)
    pose = torch.cat([points, heading, torch.zeros_like(heading)], -1)
    counts = others.counts.to(size.dtype)
    return ~touched(
        pose,
        size + CLEARANCE,
        others.states,
        others.sizes,
        counts,
        travelled,
    )


@fused("B M O W 4", "B M 2", "B J W 4", "B J 2", "B M J", "B M O W")
def touched(
    pose: Tensor,
    size: Tensor,
    states: Tensor,
    sizes: Tensor,
    counts: Tensor,
    travelled: Tensor,
) -> Tensor:
    """Bool [B, M, O]: boxes touch one that counts before they arrive (see `_clear`).

    Args:
        pose: [B, M, O, W, 4].
        size: [B, M, 2] m.
        states: [B, J, W, 4], the others'.
        sizes: [B, J, 2] m, the others'.
        counts: [B, M, J], 1 for who counts, else 0.
        travelled: [B, M, O, W] m, < 0 from the arrival on.
    """
    hit = overlap(
        pose[:, :, :, :, None],
        size[:, :, None, None, None],
        states.transpose(1, 2)[:, None, None],
        sizes[:, None, None, None],
    )
    before = torch.where(travelled >= 0, 1.0, 0.0)[..., None]
    counted = torch.where(hit, counts[:, :, None, None] * before, 0.0)
    return counted.flatten(3).amax(-1) > 0


def intercept(
    world: World,
    index: Tensor,
    *,
    target: Tensor,
    expected: Tensor,
    wish: Wish,
    settings: InterceptionSettings,
    halt_at_red: bool = False,
) -> Interception:
    """Returns the cheapest interception by each vehicle of its target, as wished. On
    the path nobody but the target is touched.

    Args:
        world: B scenes.
        index: [B, M] int64, vehicles.
        target: [B, M] int64, of each.
        expected: [B, V, H, 4], states of everybody at steps 1..H.
        wish: what is asked.
        settings: limits.
        halt_at_red: no path is longer than the distance to a stop line that binds the
            vehicle now.
    """
    scene = world.scene
    states = take(world.states, index)
    size = take(scene["size"], index)
    device = states.device
    last = round(settings.reach / DT)
    steps = torch.arange(KNOT_STEPS, last + 1, KNOT_STEPS, device=device)
    times = DT * steps
    meeting = take(expected, target)[:, :, steps - 1]
    paths = _paths(states, meeting)
    time = times.repeat_interleave(ENDS).expand_as(paths.bearing)
    lengths = size[..., 0] + take(scene["size"], target)[..., 0]
    drive = _drive(paths, meeting, speed=states[:, :, None, 3], time=time, both=lengths)
    possible = _within_limits(paths, drive, wish.eta[:, None, None], settings)
    possible &= _on_road(paths, states, scene)
    if halt_at_red:
        assert world.route is not None
        followed = take(world.route, index)[..., None].clamp(min=0)
        free = distance_to_stop_line(world, index, number=followed)
        possible &= paths.length[..., -1] <= free
    others = _others(world, index, target=target, expected=expected, steps=steps)
    possible &= _clear(paths, _travelled(drive, times), size=size, others=others)
    cost = _cost(paths, drive, wish=wish)
    wrong_way = settings.wrong_way + wish.wrong_way
    if bool((wrong_way > 0).any()):
        against = _against_lanes(scene, meeting, end_heading=paths.end_heading)
        cost = torch.where(against, cost + wrong_way[:, None, None], cost)
    worth = _worth(
        world,
        paths,
        drive,
        index=index,
        ego_plan=expected[:, 0],
        possible=possible,
    )
    cost = cost - WORTH * worth - settings.preference
    cost, pick = cost.masked_fill(~possible, torch.inf).min(-1)
    number = torch.arange(1, HORIZON // KNOT_STEPS + 1, device=device)
    accelerates = DT * KNOT_STEPS * number <= take_route(time, pick)[..., None]
    return Interception(
        _resampled(
            take_route(paths.points, pick),
            take_route(paths.length, pick),
            heading=take_route(paths.end_heading, pick),
            count=scene["route_points"].shape[3],
        ),
        take_route(drive.accel, pick)[..., None] * accelerates,
        cost=cost,
    )


def _drive(
    paths: _Paths,
    meeting: Tensor,
    *,
    speed: Tensor,
    time: Tensor,
    both: Tensor,
) -> _Drive:
    """The constant acceleration that meets the target in time; boxes that move alike
    touch before their centres meet. both [B, M]: m of the lengths together."""
    target_heading = meeting[..., 2].repeat_interleave(ENDS, -1)
    alike = wrap(paths.end_heading - target_heading).cos().clamp(min=0) ** 2
    length = paths.length[..., -1] - TOUCH * both[..., None] * alike
    accel = 2 * (length.clamp(min=0) - speed * time) / time**2
    return _Drive(speed, accel, time=time)


def _travelled(drive: _Drive, times: Tensor) -> Tensor:
    """m [B, M, O, W] driven after times [W] s, -1 from the meeting on."""
    free = drive.speed[..., None] * times
    travelled = (free + 0.5 * drive.accel[..., None] * times**2).clamp(min=0)
    return travelled.masked_fill(times >= drive.time[..., None], -1.0)


def _others(
    world: World,
    index: Tensor,
    *,
    target: Tensor,
    expected: Tensor,
    steps: Tensor,
) -> _Others:
    """Everybody at expected steps [W], of whom all count but the vehicle itself and its
    target; arguments of `intercept`."""
    vehicles = expected.shape[1]
    row = torch.arange(vehicles, device=index.device)
    itself = row == index[..., None]
    counts = world.valid[:, None, :vehicles] & ~itself & (row != target[..., None])
    sizes = world.scene["size"][:, :vehicles]
    return _Others(expected[:, :, steps - 1], sizes, counts)


def _cost(paths: _Paths, drive: _Drive, wish: Wish) -> Tensor:
    """What paths weigh [B, M, O] s, but for the lanes they end on and their worth."""
    lateral, _ = _lateral(paths, drive)
    cost = ACCEL_COST * drive.accel.abs() + LATERAL_COST * lateral
    cost = cost + TIME_COST * drive.time
    moment = wish.moment[:, None, None]
    return cost + MOMENT_COST * ((drive.time - moment).abs() * (moment >= 0))


def _tracks(paths: _Paths, speed: Tensor, accel: Tensor) -> Tensor:
    """States [G, O, HORIZON, 4] of vehicles at speed [G, 1] that drive paths [G, O, U]
    at accel [G, O], then straight on."""
    time = DT * torch.arange(HORIZON + 1, device=speed.device)
    v = (speed[..., None] + accel[..., None] * time).clamp(min=0)
    driven = (midpoints(v) * DT).cumsum(-1)
    tangent = _at(paths.tangents, paths.length, s=driven)
    heading = angle_of(tangent)
    beyond = (driven - paths.length[..., -1:]).clamp(min=0)[..., None]
    xy = _at(paths.points, paths.length, s=driven) + beyond * unit_vectors(heading)
    return torch.cat([xy, heading[..., None], v[..., 1:, None]], -1)


def _worth(
    world: World,
    paths: _Paths,
    drive: _Drive,
    *,
    index: Tensor,
    ego_plan: Tensor,
    possible: Tensor,
) -> Tensor:
    """Worth [B, M, O] of driving paths (`foresee`), 0 for vehicles of which no path is
    possible [B, M, O]. ego_plan [B, H, 4]: the ego's expected states."""
    place = possible.any(-1).nonzero(as_tuple=True)
    row = place[0]
    worth = torch.zeros_like(drive.accel)
    if not len(row):
        return worth
    states = take(world.states, index)[place]
    some = _Paths(*(value[place] for value in paths))
    tracks = _tracks(some, states[:, None, 3], accel=drive.accel[place])
    start = states[:, None, None].expand(*tracks.shape[:2], 1, 4)
    path = torch.cat([world.states[:, :1], ego_plan], 1)[row]
    never = torch.full_like(path[:, 0, 3], -1.0)
    foresight = foresee(
        path,
        world.scene["size"][row, 0],
        tracks=torch.cat([start, tracks], 2),
        sizes=take(world.scene["size"], index)[place],
        since=never,
        settled=never > 0,
    )
    return worth.index_put(place, foresight.worth)


def _against_lanes(
    scene: TensorDictBase,
    meeting: Tensor,
    end_heading: Tensor,
) -> Tensor:
    """Bool [B, M, O]: paths end at meeting states [B, M, I, 4] with end_heading [B, M,
    O] against the lanes there."""
    batch, count, moments = meeting.shape[:3]
    return against_lanes(
        scene["lane_points"],
        scene["lane_index"],
        xy=meeting[..., :2].flatten(1, 2),
        heading=end_heading.reshape(batch, count * moments, ENDS),
    ).view_as(end_heading)


def _resampled(points: Tensor, length: Tensor, heading: Tensor, count: int) -> Tensor:
    """Vertices [B, M, count, 2] every SPACING m along points [B, M, U, 2] at length [B,
    M, U], then along `heading`."""
    s = SPACING * torch.arange(count, device=points.device, dtype=points.dtype)
    s = s.expand(*length.shape[:2], count)
    beyond = (s - length[..., -1:]).clamp(min=0)[..., None]
    return _at(points, length, s=s) + beyond * unit_vectors(heading)[:, :, None]


def _at(values: Tensor, length: Tensor, s: Tensor) -> Tensor:
    """Values [..., U, 2] at length [..., U] m, linear between them, after s [..., K] m:
    the last beyond the end."""
    after = torch.searchsorted(length.contiguous(), s.contiguous(), right=True)
    after = after.clamp(1, SAMPLES - 1)
    low = length.gather(-1, after - 1)
    high = length.gather(-1, after)
    share = ((s - low) / (high - low).clamp(min=1e-6)).clamp(max=1.0)[..., None]
    first, second = (
        values.gather(-2, index[..., None].expand(*index.shape, 2))
        for index in (after - 1, after)
    )
    return first + share * (second - first)


def interception_nats(
    path: Tensor,
    knots: Tensor,
    *,
    world: World,
    lane: LaneState,
    route: Tensor,
    off_lane: Tensor,
) -> Tensor:
    """Returns the nats [B, V] of interceptions: of the two lateral knots that fit them
    on the lanes that they leave, under N(0, C) (pull.py).

    An estimate, not a bound: the prior's law beside a lane is not known, only around
    it.

    Args:
        path: [B, V, P, 2], where off_lane.
        knots: [B, V, KNOTS] m/s^2, their accelerations.
        world: B scenes.
        lane: [B, V], the present states, on whatever they follow.
        route: [B, V] int64, candidates that are left.
        off_lane: [B, V] bool, who is on an interception.
    """
    place = off_lane.nonzero(as_tuple=True)
    points = world.scene["route_points"][(*place, route.clamp(min=0)[place])]
    start = lane.map(lambda value: value[place])
    nats = lateral_nats(world.states[place], start, points, path[place], knots[place])
    return torch.zeros_like(lane.s).index_put(place, nats)


@fused("Q 4", "Q", "Q P 2!", "Q P 2!", f"Q {KNOTS}")
def lateral_nats(
    states: Tensor,
    lane: LaneState,
    points: Tensor,
    path: Tensor,
    knots: Tensor,
) -> Tensor:
    """Returns `interception_nats` [Q], compiled.

    Args:
        states: [Q, 4], of vehicles that leave their lanes.
        lane: lane states [Q], on whatever they follow.
        points: [Q, P, 2] m, of the lanes.
        path: [Q, P, 2] m.
        knots: [Q, KNOTS] m/s^2.
    """
    present = lane_relative.locate(
        states,
        lane.a,
        yaw_rate=lane.kappa * lane.v,
        points=points,
    )
    speed, travelled = lane_relative.speeds(present, knots)
    start = project(states[:, None, :2], path)[0]
    xy, heading, _ = interpolate(path, start + travelled)
    s, d, _ = project(xy, points, hint=present.s[..., None] + travelled)
    track = torch.cat([xy, heading[..., None], speed[..., None]], -1)
    x = lane_relative.fit(LaneState.from_states(track, s, d=d), None, state=present)[0]
    variance = torch.tensor(SPREAD[KNOTS:], device=x.device).square()
    return (x[..., KNOTS:].square() / (2 * variance)).sum(-1)
