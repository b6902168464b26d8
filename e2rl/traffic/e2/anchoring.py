"""Topological anchoring (Sec. IV-B1): a coarse lane-graph proposal for every link of
the skeleton.

A proposal is a candidate route and a constant acceleration, within limits of speed and
curvature, with which a vehicle meets its target. The prior's own decoder turns it into
motion, so arrival times are those that the prior would plan.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.prior.lane_relative import (
    HORIZON,
    KNOT_STEPS,
    KNOTS,
    LaneState,
    lateral_horizon,
    speeds,
)
from e2rl.prior.routes import take_route
from e2rl.run.config import check_range, configured, setting
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.dynamics import midpoints, wrap
from e2rl.sim.world import World
from e2rl.traffic.e2.interception import InterceptionSettings, Wish, intercept
from e2rl.traffic.e2.skeleton import Skeleton
from e2rl.traffic.motion import (
    TOP_SPEED,
    compact,
    constant_speed_states,
    distance_to_stop_line,
    frenet_pose,
    put,
    remaining_offset,
    states_on_route,
    take,
)

# Accelerations tried on each route: over the whole range, then around the best.
COARSE = 19
FINE = 9
LATERAL_ACCEL = 4.0  # m/s^2 in bends
BEND_BRAKING = 3.0  # m/s^2 with which a vehicle slows down for a bend
EXTRA = 2  # steps beyond the horizon, for the slope of the speed at the last knot
# Peak of the lateral decoder's offset, per unit of slope and lateral horizon.
SWING = 0.2
BEND_VERTICES = 64  # of a route ahead, whose curvature bounds the speed
ACCEL_COST = 0.2  # s of time gap that 1 m/s^2 weighs
LATERAL_COST = 0.05  # s that 1 m of present offset from the route weighs
MAX_OFFSET = 1.0  # s of time gap at most; links that cannot meet better have no anchor
# m of present offset from a route that a vehicle may take instead of its own: a lane
# change.
MAX_SHIFT = 4.5
MAX_SWING = 1.0  # m that it may swing out while it turns in


@configured("synthesizer/e2", "anchor")
@dataclass(frozen=True)
class AnchorSettings:
    """Settings of the proposals and of the blend; conf/synthesizer/e2.yaml explains
    each."""

    strength: float = setting(low=0)
    min_accel: float = setting()
    max_accel: float = setting()

    def __post_init__(self) -> None:
        check_range(
            "synthesizer.anchor.max_accel",
            self.max_accel,
            low=self.min_accel + 0.1,
        )


@dataclass(frozen=True)
class Anchor:
    """The proposals of a skeleton.

    route [B, V] int64: candidate to follow (the present one where not feasible); knots
    [B, V, 10]: accelerations [m/s^2] at 0.5 .. 5.0 s; feasible [B, V] bool: members of
    C* that can meet their target; cost [B, V] in s, inf where not feasible; off_lane
    [B, V] bool: members that meet it on off_lane_path [B, V, P, 2] (a vertex every
    SPACING m) instead of a lane.
    """

    route: Tensor
    knots: Tensor
    feasible: Tensor
    cost: Tensor
    off_lane: Tensor
    off_lane_path: Tensor


class _Candidates(NamedTuple):
    """Vehicles [B, M] that need a proposal: speed, accel, size [B, M, 2], and their
    candidate routes [B, M, R]: number in the scene, points [B, M, R, P, 2], usable
    (bool), end [m], Frenet pose s, d [m], and bend_bound [B, M, R, 64]: squared speed
    allowed at the vertices ahead.
    """

    number: Tensor
    points: Tensor
    usable: Tensor
    end: Tensor
    s: Tensor
    d: Tensor
    bend_bound: Tensor
    speed: Tensor
    accel: Tensor
    size: Tensor


class _Target(NamedTuple):
    """A target's path seen along each candidate, [B, M, R, H]: s, d [m]; slack [m] by
    which boxes that move alike touch before their centres meet; crossing_time [s/m]:
    until a crossing target is over the centreline; corridor [B, M] m: lateral distance
    at which the boxes touch.
    """

    s: Tensor
    d: Tensor
    slack: Tensor
    crossing_time: Tensor
    corridor: Tensor


def _bend_bound(route: Tensor, s: Tensor) -> Tensor:
    """Squared speed [..., BEND_VERTICES] allowed at arc lengths s + SPACING k of route
    [..., P, 2], s [...]: by the curvature there, and by what BEND_BRAKING can still
    lose before the bends ahead.
    """
    distance = SPACING * torch.arange(BEND_VERTICES, device=s.device)
    curvature = interpolate(route, s[..., None] + distance)[2]
    bound = (
        LATERAL_ACCEL / curvature.abs().clamp(min=1e-4) + 2 * BEND_BRAKING * distance
    )
    return bound.flip(-1).cummin(-1).values.flip(-1) - 2 * BEND_BRAKING * distance


def _candidates(
    world: World,
    index: Tensor,
    keep_route: bool,
    halt_at_red: bool,
) -> _Candidates:
    """The candidate routes of vehicles index [B, M]; arguments of `propose`."""
    scene = world.scene
    assert world.route is not None
    vehicles, count = scene["route_points"].shape[1:3]
    device = index.device
    states = take(world.states[:, :vehicles], index)
    followed = take(world.route, index)[..., None]
    if keep_route:
        number = followed.clamp(min=0)
    else:
        number = torch.arange(count, device=device).expand(*index.shape, -1)
    row = torch.arange(len(index), device=device)[:, None, None]
    place = (row, index[..., None], number)
    points = scene["route_points"][place]
    s, d, error = frenet_pose(states, points)
    slope = error.clamp(-1.0, 1.0).tan().abs()
    swing = SWING * slope * lateral_horizon(states[..., 3])[..., None]
    reachable = (d.abs() <= MAX_SHIFT) & (swing <= MAX_SWING)
    usable = scene["route_valid"][place] & (reachable | (number == followed))
    if keep_route:
        usable = usable & (followed >= 0)
    end = scene["route_length"][place]
    if halt_at_red:
        end = torch.minimum(end, s + distance_to_stop_line(world, index, number=number))
    return _Candidates(
        number=number,
        points=points,
        usable=usable,
        end=end,
        s=s,
        d=d,
        bend_bound=_bend_bound(points, s),
        speed=states[..., 3],
        accel=take(world.accel[:, :vehicles], index),
        size=take(scene["size"], index),
    )


def _along(candidates: _Candidates, path: Tensor, size: Tensor) -> _Target:
    """A target's path [B, M, H, 4] and size [B, M, 2] seen along each candidate."""
    s, d, heading = project(path[:, :, None, :, :2], candidates.points)
    cosine = wrap(path[:, :, None, :, 2] - heading).cos()
    touch = (candidates.size + size) / 2
    slack = 0.8 * touch[..., 0, None, None] * cosine.clamp(min=0) ** 2
    crossing_time = (1 - cosine**2) / path[:, :, None, :, 3].clamp(min=1.0)
    return _Target(
        s,
        d,
        slack=slack,
        crossing_time=crossing_time,
        corridor=touch[..., 1],
    )


def _knots(candidates: _Candidates, accel: Tensor, limits: Tensor) -> Tensor:
    """Knots [B, M, R, A, 10] that hold accelerations accel [B, M, R, A] but for
    standstill, top speed and bends: the bound depends on the distance, which depends on
    speed, so three fixed-point steps from the free motion."""
    time = DT * torch.arange(HORIZON + EXTRA + 1, device=accel.device)
    v0 = candidates.speed[..., None, None, None]
    free = v0 + accel[..., None] * time
    free = torch.minimum(free.clamp(min=0), v0.clamp(min=TOP_SPEED))
    braking = (v0 + limits[0] * time).clamp(min=0)  # nobody loses speed faster
    speed = free
    for _ in range(3):
        distance = (midpoints(speed) * DT).cumsum(-1)
        travelled = torch.nn.functional.pad(distance, (1, 0))
        vertex = (travelled / SPACING).clamp(max=BEND_VERTICES - 1.001)
        low = vertex.long()
        shape = (*travelled.shape[:-1], BEND_VERTICES)
        table = candidates.bend_bound[..., None, :].expand(shape)
        bound = torch.lerp(
            table.gather(-1, low),
            table.gather(-1, low + 1),
            vertex - low,
        )
        speed = torch.maximum(torch.minimum(free, bound.clamp(min=0).sqrt()), braking)
    knot = KNOT_STEPS * torch.arange(1, KNOTS + 1, device=accel.device)
    slope = (speed[..., knot + EXTRA] - speed[..., knot - EXTRA]) / (2 * EXTRA * DT)
    return slope.clamp(limits[0], limits[1])


def _decode(candidates: _Candidates, knots: Tensor) -> tuple[Tensor, Tensor]:
    """Speed and travelled distance [B, M, R, A, H] of knots [B, M, R, A, 10], by the
    prior's decoder."""
    zero = knots.new_zeros(knots.shape[:-1])
    v, a = (
        x[..., None, None].expand(zero.shape)
        for x in (candidates.speed, candidates.accel)
    )
    return speeds(
        LaneState(
            zero,
            zero,
            d1=zero,
            d2=zero,
            v=v,
            a=a,
            x=zero,
            y=zero,
            heading=zero,
            kappa=zero,
        ),
        knots,
    )


@fused(
    (
        "B M R:int64",
        "B M R P 2!",
        "B M R:bool",
        *["B M R"] * 3,
        f"B M R {BEND_VERTICES}",
        "B M",
        "B M",
        "B M 2",
    ),
    "B M R A",
    (*[f"B M R {HORIZON}"] * 4, "B M"),
    "2",
)
def scored(
    candidates: _Candidates,
    accel: Tensor,
    target: _Target,
    limits: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns cost and time gap [s] (both [B, M, R, A]) and knots [B, M, R, A, 10].

    Time gap: distance to the target over speed, least over the steps at which the
    target is on the candidate.

    Args:
        candidates: routes of the vehicles.
        accel: [B, M, R, A] m/s^2, accelerations to hold.
        target: on the candidates.
        limits: [2] m/s^2, least and largest acceleration.
    """
    knots = _knots(candidates, accel, limits=limits)
    v, travelled = _decode(candidates, knots)
    offset = candidates.d[..., None, None] * remaining_offset(
        travelled, candidates.speed[..., None, None, None]
    )
    lateral = (target.d[..., None, :] - offset).abs()
    ahead = target.s[..., None, :]
    missing = (ahead - candidates.s[..., None, None] - travelled).abs() - target.slack[
        ..., None, :
    ]
    time_gap = (
        missing.clamp(min=0) / v.clamp(min=1.0)
        + lateral * target.crossing_time[..., None, :]
    )
    met = (lateral <= target.corridor[..., None, None, None]) & (
        ahead <= candidates.end[..., None, None]
    )
    time_gap = (
        time_gap.masked_fill(~met, torch.inf)
        .amin(-1)
        .masked_fill(~candidates.usable[..., None], torch.inf)
    )
    cost = (
        time_gap
        + ACCEL_COST * accel.abs()
        + LATERAL_COST * candidates.d.abs()[..., None]
    )
    return cost, time_gap, knots


class _OnLane(NamedTuple):
    """The proposals of least cost of vehicles [B, M]: candidate, knots [B, M, 10],
    cost in s, inf for none."""

    candidate: Tensor
    knots: Tensor
    cost: Tensor


def _on_lane(
    candidates: _Candidates,
    path: Tensor,
    size: Tensor,
    settings: AnchorSettings,
) -> _OnLane:
    """How vehicles best meet targets on their candidates; path [B, M, H, 4] and size
    [B, M, 2]: the targets'."""
    target = _along(candidates, path, size=size)
    low = settings.min_accel
    high = settings.max_accel
    limits = path.new_tensor((low, high))
    grid = torch.linspace(low, high, COARSE, device=path.device)
    grid = grid.expand(*candidates.s.shape, COARSE)
    best = scored(candidates, grid, target, limits)[0].argmin(-1, keepdim=True)
    around = torch.linspace(-1, 1, FINE, device=path.device)
    fine = grid.gather(-1, best) + (high - low) / (COARSE - 1) * around
    cost, time_gap, knots = scored(candidates, fine.clamp(low, high), target, limits)
    pick = cost.flatten(2).argmin(-1)
    cost, time_gap, knots = (
        take_route(value.flatten(2, 3), pick) for value in (cost, time_gap, knots)
    )
    cost = cost.masked_fill(time_gap > MAX_OFFSET, torch.inf)
    return _OnLane(pick // FINE, knots, cost=cost)


def propose(
    world: World,
    skeleton: Skeleton,
    *,
    ego_plan: Tensor,
    settings: AnchorSettings,
    interception: InterceptionSettings,
    wish: Wish,
    keep_route: bool = False,
    halt_at_red: bool = False,
) -> Anchor:
    """Returns the skeleton-consistent clean state of Sec. IV-B1.

    Proposals are made from the ego outwards. Vehicles that act on the ego meet its plan
    on a lane or, where that costs less, by an interception. The others meet their
    target's lane proposal; a target without one keeps its speed along its route.

    Args:
        world: B scenes, with the routes that vehicles follow.
        skeleton: who acts on whom.
        ego_plan: [B, H >= 50, 4], the ego's expected states.
        settings: of the proposals on lanes.
        interception: limits of those off the lanes.
        wish: what is asked of those.
        keep_route: consider only the routes that vehicles follow now.
        halt_at_red: nobody passes a stop line that binds it now.
    """
    scene = world.scene
    assert world.route is not None
    times = DT * torch.arange(1, HORIZON + 1, device=ego_plan.device)
    expected = constant_speed_states(scene, world, times=times)
    expected[:, 0] = ego_plan[:, :HORIZON].detach()
    nobody = torch.zeros_like(skeleton.coalition)
    anchor = Anchor(
        route=world.route.clone(),
        knots=expected.new_zeros(*world.route.shape, KNOTS),
        feasible=nobody,
        cost=expected.new_full(world.route.shape, torch.inf),
        off_lane=nobody,
        off_lane_path=torch.zeros_like(scene["route_points"][:, :, 0]),
    )
    for depth in range(1, int(skeleton.depth.max()) + 1):
        index, present = compact(skeleton.depth == depth)
        target = skeleton.target.gather(1, index).clamp(min=0)
        candidates = _candidates(
            world,
            index,
            keep_route=keep_route,
            halt_at_red=halt_at_red,
        )
        best = _on_lane(
            candidates,
            take(expected, target),
            size=take(scene["size"], target),
            settings=settings,
        )
        cost = best.cost.masked_fill(~present, torch.inf)
        on_lane = cost.isfinite()
        if depth == 1 and interception.reach > 0:
            off = intercept(
                world,
                index,
                target=target,
                expected=expected,
                wish=wish,
                settings=interception,
                halt_at_red=halt_at_red,
            )
            off_lane = present & (off.cost < cost)
            on_lane = on_lane & ~off_lane
            anchor = _updated(
                anchor,
                index,
                off_lane,
                feasible=off_lane,
                off_lane=off_lane,
                cost=off.cost,
                knots=off.knots,
                off_lane_path=off.path,
            )
        anchor = _updated(
            anchor,
            index,
            on_lane,
            feasible=on_lane,
            cost=cost,
            knots=best.knots,
            route=take_route(candidates.number, best.candidate),
        )
        expected = put(expected, index, mask=on_lane, rows=_states(candidates, best))
    return anchor


def _states(candidates: _Candidates, best: _OnLane) -> Tensor:
    """States [B, M, H, 4] of the vehicles that drive their proposals."""
    speed, travelled = _decode(candidates, best.knots[:, :, None, None])
    speed = speed[:, :, 0, 0]
    travelled = travelled[:, :, 0, 0]
    route = take_route(candidates.points, best.candidate)
    s = take_route(candidates.s, best.candidate)[..., None]
    d = take_route(candidates.d, best.candidate)[..., None]
    offset = d * remaining_offset(travelled, candidates.speed[..., None])
    return states_on_route(route, s + travelled, d=offset, speed=speed)


def _updated(anchor: Anchor, index: Tensor, mask: Tensor, **rows: Tensor) -> Anchor:
    """The Anchor with rows [B, M, ...] of its fields written at vehicles index [B, M]
    where mask [B, M]."""
    fields = {
        name: put(getattr(anchor, name), index, mask=mask, rows=new)
        for name, new in rows.items()
    }
    return replace(anchor, **fields)
