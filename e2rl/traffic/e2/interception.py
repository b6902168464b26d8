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

from e2rl.prior.lane_relative import HORIZON, KNOT_STEPS
from e2rl.prior.routes import take_route
from e2rl.run.fused import fused
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import overlap
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING
from e2rl.sim.dynamics import SHARPEST, wrap
from e2rl.sim.world import World
from e2rl.traffic.e2.foresight import foresee
from e2rl.traffic.motion import direction, distance_to_stop_line, take

ENDS = 3  # directions tried at the end of a path
SAMPLES = 17  # points of a path that are checked
MAX_BEARING, MAX_TURN = (
    1.05,
    1.4,
)  # rad between heading and target, and between both ends of a path
CLEARANCE = 0.3  # m kept to others on the path
SHOULDER = 0.5  # m that its centre may leave the drivable area by
ACCEL_COST, LATERAL_COST = (
    0.2,
    0.2,
)  # s that 1 m/s^2 of acceleration, and of lateral acceleration, weighs
TIME_COST = 0.1  # s that 1 s until the meeting weighs
MOMENT_COST = 1.0  # s that 1 s before or after the moment that is wished for weighs
WORTH = 2.0  # s by which a path is preferred that only the competent driver survives


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


def cubic(
    start: Tensor, heading: Tensor, end: Tensor, end_heading: Tensor, u: Tensor
) -> tuple[Tensor, Tensor]:
    """Points and derivatives [..., U, 2] at u [U] in [0, 1] of the cubic Hermite curve
    between poses [..., 2], [...].

    Where one circle is tangent to both poses the curve is its arc, to a thousandth of
    the radius.
    """
    chord = end - start
    bearing = wrap(torch.atan2(chord[..., 1], chord[..., 0]) - heading)
    chord = (
        chord.norm(dim=-1)[..., None]
        / (bearing / 2).cos().square().clamp(min=0.5)[..., None]
    )
    a = start[..., None, :]
    b = end[..., None, :]
    m = (chord * direction(heading))[..., None, :]
    n = (chord * direction(end_heading))[..., None, :]
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
    bearing = wrap(torch.atan2(gap[..., 1], gap[..., 0]) - heading)
    end_heading = torch.stack(
        [heading + 2 * bearing, heading + bearing, meeting[..., 2]], -1
    ).flatten(2)
    heading, bearing, xy = (
        x.repeat_interleave(ENDS, 2) for x in (heading, bearing, meeting[..., :2])
    )
    start = states[:, :, None, :2].expand_as(xy)
    u = torch.linspace(0, 1, SAMPLES, device=states.device)
    points, tangents = cubic(start, heading, end=xy, end_heading=end_heading, u=u)
    length = torch.nn.functional.pad(points.diff(dim=3).norm(dim=-1).cumsum(-1), (1, 0))
    return _Paths(
        points,
        tangents,
        length=length,
        bearing=bearing,
        turn=wrap(end_heading - heading),
        end_heading=end_heading,
    )


def _lateral(paths: _Paths, speed: Tensor, accel: Tensor) -> tuple[Tensor, Tensor]:
    """Largest lateral acceleration [m/s^2] and curvature [1/m] on paths entered at
    `speed` and driven at `accel`."""
    turn = wrap(
        torch.atan2(paths.tangents[..., 1], paths.tangents[..., 0]).diff(dim=-1)
    )
    curvature = (turn / paths.length.diff(dim=-1).clamp(min=0.1)).abs()
    squared = (
        speed[..., None] ** 2 + 2 * accel[..., None] * paths.length[..., 1:]
    ).clamp(min=0)
    return (squared * curvature).amax(-1), curvature.amax(-1)


def _within(
    settings: InterceptionSettings,
    paths: _Paths,
    speed: Tensor,
    accel: Tensor,
    time: Tensor,
    eta: Tensor,
) -> Tensor:
    """Bool [B, M, O]: paths entered at speed [B, M, 1], driven at accel for time [B, M,
    O], keep the limits of eta."""
    lateral, curvature = _lateral(paths, speed, accel=accel)
    ok = (
        (accel <= settings.push * eta)
        & (accel >= -settings.brake * eta)
        & (speed + accel * time >= 0)
    )
    ok &= (lateral <= settings.lateral * eta) & (curvature < SHARPEST)
    return ok & (paths.bearing.abs() < MAX_BEARING) & (paths.turn.abs() < MAX_TURN)


def _on_road(paths: _Paths, states: Tensor, scene: TensorDictBase) -> Tensor:
    """Bool [B, M, O]: paths from states [B, M, 4] leave the drivable area by no more
    than the shoulder, or than now."""
    field = scene["field"]
    origin = scene["field_origin"]
    allowed = off_road(states[..., :2], field, origin=origin).clamp(min=SHOULDER)[
        ..., None
    ]
    return off_road(paths.points, field, origin=origin).amax(-1) <= allowed


def _clear(
    paths: _Paths,
    travelled: Tensor,
    size: Tensor,
    others: tuple[Tensor, Tensor, Tensor],
) -> Tensor:
    """Bool [B, M, O]: after `travelled` [B, M, O, W] m of their paths (< 0: arrived)
    vehicles touch none of the others.

    others: states [B, J, W, 4] at the same moments and sizes [B, J, 2] of everybody,
    and who counts [B, M, J] bool.
    """
    index = torch.searchsorted(paths.length.contiguous(), travelled.contiguous()).clamp(
        0, SAMPLES - 1
    )
    index = index[..., None].expand(*index.shape, 2)
    tangent = paths.tangents.gather(3, index)
    heading = torch.atan2(tangent[..., 1:], tangent[..., :1])
    pose = torch.cat(
        [paths.points.gather(3, index), heading, torch.zeros_like(heading)], -1
    )
    states, sizes, counts = others
    return ~touched(
        pose, size + CLEARANCE, states, sizes, counts.to(size.dtype), travelled
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
    """Bool [B, M, O]: boxes at pose [B, M, O, W, 4] touch one that counts (1, else 0),
    before they arrive (see `_clear`)."""
    boxes = (
        pose[:, :, :, :, None],
        size[:, :, None, None, None],
        states.transpose(1, 2)[:, None, None],
    )
    hit = overlap(*boxes, sizes[:, None, None, None])
    before = torch.where(travelled >= 0, 1.0, 0.0)[..., None]
    return (
        torch.where(hit, counts[:, :, None, None] * before, 0.0).flatten(3).amax(-1) > 0
    )


def intercept(
    world: World,
    index: Tensor,
    target: Tensor,
    expected: Tensor,
    wish: Wish,
    settings: InterceptionSettings,
    halt_at_red: bool = False,
) -> Interception:
    """The cheapest interception by each of vehicles index [B, M] of its target [B, M],
    as wished.

    expected [B, V, H, 4]: states of everybody at steps 1..H; on the path nobody but the
    target is touched. halt_at_red: no path is longer than the distance to a stop line
    that binds the vehicle now.
    """
    scene = world.scene
    vehicles = expected.shape[1]
    states = take(world.states, index)
    target_states = take(expected, target)
    size = take(scene["size"], index)
    target_size = take(scene["size"], target)
    steps = torch.arange(
        KNOT_STEPS, round(settings.reach / DT) + 1, KNOT_STEPS, device=states.device
    )
    meeting = target_states[:, :, steps - 1]
    times = DT * steps
    paths = _paths(states, meeting)
    v = states[:, :, None, 3]
    time = times.repeat_interleave(ENDS).expand_as(paths.bearing)
    # Boxes that move alike touch before their centres meet.
    alike = (
        wrap(paths.end_heading - meeting[..., 2].repeat_interleave(ENDS, -1))
        .cos()
        .clamp(min=0)
        ** 2
    )
    length = (
        paths.length[..., -1]
        - 0.4 * (size[..., 0] + target_size[..., 0])[..., None] * alike
    )
    accel = 2 * (length.clamp(min=0) - v * time) / time**2
    ok = _within(
        settings, paths, speed=v, accel=accel, time=time, eta=wish.eta[:, None, None]
    )
    ok &= _on_road(paths, states, scene=scene)
    if halt_at_red:
        assert world.route is not None
        followed = take(world.route, index)[..., None].clamp(min=0)
        ok &= paths.length[..., -1] <= distance_to_stop_line(
            world, index, number=followed
        )
    travelled = (v[..., None] * times + 0.5 * accel[..., None] * times**2).clamp(min=0)
    travelled = travelled.masked_fill(times >= time[..., None], -1.0)
    row = torch.arange(vehicles, device=index.device)
    counts = (
        world.valid[:, None, :vehicles]
        & (row != index[..., None])
        & (row != target[..., None])
    )
    ok &= _clear(
        paths,
        travelled,
        size=size,
        others=(expected[:, :, steps - 1], scene["size"][:, :vehicles], counts),
    )
    cost = ACCEL_COST * accel.abs() + LATERAL_COST * _lateral(paths, v, accel=accel)[0]
    cost = cost + TIME_COST * time
    cost = cost + MOMENT_COST * (
        (time - wish.moment[:, None, None]).abs() * (wish.moment >= 0)[:, None, None]
    )
    wrong_way = settings.wrong_way + wish.wrong_way
    if bool((wrong_way > 0).any()):
        against = _against_lanes(scene, meeting, end_heading=paths.end_heading)
        cost = torch.where(against, cost + wrong_way[:, None, None], cost)
    cost = cost - WORTH * _foresight(
        world, expected[:, 0], states=states, size=size, paths=paths, accel=accel, ok=ok
    )
    cost, pick = (cost - settings.preference).masked_fill(~ok, torch.inf).min(-1)
    knot_times = (
        DT * KNOT_STEPS * torch.arange(1, HORIZON // KNOT_STEPS + 1, device=cost.device)
    )
    knots = take_route(accel, pick)[..., None] * (
        knot_times <= take_route(time, pick)[..., None]
    )
    points, length, heading = (
        take_route(x, pick) for x in (paths.points, paths.length, paths.end_heading)
    )
    return Interception(
        _resampled(
            points, length, heading=heading, count=scene["route_points"].shape[3]
        ),
        knots,
        cost=cost,
    )


def _tracks(paths: _Paths, speed: Tensor, accel: Tensor) -> Tensor:
    """States [G, O, HORIZON, 4] of vehicles at speed [G, 1] that drive paths [G, O, U]
    at accel [G, O], then straight on."""
    time = DT * torch.arange(HORIZON + 1, device=speed.device)
    v = (speed[..., None] + accel[..., None] * time).clamp(min=0)
    driven = ((v[..., 1:] + v[..., :-1]) / 2 * DT).cumsum(-1)
    tangent = _at(paths.tangents, paths.length, s=driven)
    heading = torch.atan2(tangent[..., 1], tangent[..., 0])
    beyond = (driven - paths.length[..., -1:]).clamp(min=0)
    xy = _at(paths.points, paths.length, s=driven) + beyond[..., None] * direction(
        heading
    )
    return torch.cat([xy, heading[..., None], v[..., 1:, None]], -1)


def _foresight(
    world: World,
    ego_plan: Tensor,
    states: Tensor,
    size: Tensor,
    paths: _Paths,
    accel: Tensor,
    ok: Tensor,
) -> Tensor:
    """Worth [B, M, O] of driving paths at accel [B, M, O] (`foresee`) of vehicles at
    states [B, M, 4], size [B, M, 2]; 0 for vehicles that have no path that is ok [B, M,
    O]. ego_plan [B, H, 4]: the ego's expected states."""
    row, vehicle = at = ok.any(-1).nonzero(as_tuple=True)
    worth = torch.zeros_like(accel)
    if not len(row):
        return worth
    tracks = _tracks(
        _Paths(*(value[at] for value in paths)), states[at][:, None, 3], accel=accel[at]
    )
    plans = torch.cat(
        [states[at][:, None, None].expand(*tracks.shape[:2], 1, 4), tracks], 2
    )
    path = torch.cat([world.states[:, :1], ego_plan], 1)[row]
    never = torch.full_like(path[:, 0, 3], -1.0)
    seen = foresee(
        path,
        world.scene["size"][row, 0],
        tracks=plans,
        sizes=size[at],
        since=never,
        settled=never > 0,
    )
    return worth.index_put(at, seen.worth)


def _against_lanes(
    scene: TensorDictBase, meeting: Tensor, end_heading: Tensor
) -> Tensor:
    """Bool [B, M, O]: paths end at meeting states [B, M, I, 4] with end_heading [B, M,
    O] against the lanes there."""
    batch, count, moments = meeting.shape[:3]
    heading = end_heading.reshape(batch, count * moments, ENDS)
    xy = meeting[..., :2].flatten(1, 2)
    return against_lanes(
        scene["lane_points"], scene["lane_index"], xy=xy, heading=heading
    ).view_as(end_heading)


def _resampled(points: Tensor, length: Tensor, heading: Tensor, count: int) -> Tensor:
    """Vertices [B, M, count, 2] every SPACING m along points [B, M, U, 2] at length [B,
    M, U], then along `heading`."""
    s = SPACING * torch.arange(count, device=points.device, dtype=points.dtype).expand(
        *length.shape[:2], count
    )
    beyond = (s - length[..., -1:]).clamp(min=0)
    return _at(points, length, s=s) + beyond[..., None] * direction(heading)[:, :, None]


def _at(values: Tensor, length: Tensor, s: Tensor) -> Tensor:
    """Values [..., U, 2] at length [..., U] m, linear between them, after s [..., K] m:
    the last beyond the end."""
    after = torch.searchsorted(length.contiguous(), s.contiguous(), right=True).clamp(
        1, SAMPLES - 1
    )
    low = length.gather(-1, after - 1)
    high = length.gather(-1, after)
    share = ((s - low) / (high - low).clamp(min=1e-6)).clamp(max=1.0)[..., None]
    first, second = (
        values.gather(-2, i[..., None].expand(*i.shape, 2)) for i in (after - 1, after)
    )
    return first + share * (second - first)
