"""Topological anchoring (Sec. IV-B1): a coarse lane-graph proposal for every link of the skeleton, and how it is
blended.

A proposal is a route candidate and a constant acceleration (within limits of speed and curvature) with which a vehicle
meets its target: reference section 3.3 and 12.14. It is evaluated with the prior's own decoder of speeds, so arrival
times are those the prior would draw.
"""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.prior.lane_relative import HORIZON, KNOTS, LaneState, lateral_horizon, speeds
from e2rl.scene.recording import DT
from e2rl.scene.route import SPACING, interpolate, project
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.synthesizer.interception import Interception, InterceptionSettings, intercept
from e2rl.synthesizer.motion import compact, cruise, fade, place, ride, take
from e2rl.synthesizer.skeleton import Skeleton

EXTRA = 2  # steps beyond the horizon, for the slope of the speed at the last knot
SWING = 0.2  # peak of the lateral decoder's offset, per unit of slope and lateral horizon
TURNING = 64  # vertices ahead whose curvature is looked at


@dataclass(frozen=True)
class AnchorSettings:
    """Settings of the proposals and of the blend; conf/synthesizer/e2.yaml explains each."""

    strength: float = 1.0
    min_accel: float = -3.0
    max_accel: float = 2.0
    options: int = 19
    lateral_accel: float = 4.0
    turn_brake: float = 3.0
    top_speed: float = 25.0
    margin: float = 0.0
    accel_cost: float = 0.2
    lateral_cost: float = 0.05
    max_offset: float = 1.0
    max_shift: float = 4.5
    max_swing: float = 1.0

    def __post_init__(self):
        if not 0 <= self.strength <= 1:
            raise InputError(f"synthesizer.anchor.strength is {self.strength}; it must lie between 0 (no anchor) and 1")
        if self.min_accel >= self.max_accel or self.options < 2:
            raise InputError("synthesizer.anchor needs min_accel < max_accel and at least 2 options")


@dataclass(frozen=True)
class Anchor:
    """route [B, V] int64: candidate to follow (the present one where `has` is false); knots [B, V, 10] acceleration
    knots [m/s^2] at 0.5 .. 5.0 s; has [B, V]: C* members that can meet their target; cost [B, V]: in seconds, inf where
    `has` is false; leaves [B, V]: members that meet it on a way of their own, points [B, V, P, 2] (vertices SPACING m
    apart), and not on a lane.
    """

    route: Tensor
    knots: Tensor
    has: Tensor
    cost: Tensor
    leaves: Tensor
    points: Tensor


@dataclass
class _Riders:
    """The vehicles that look for a proposal: slots [B, M] and their candidates [B, M, R], numbered as in the scene."""

    candidate: Tensor
    routes: Tensor
    usable: Tensor
    end: Tensor
    s: Tensor
    d: Tensor
    v: Tensor
    a: Tensor
    size: Tensor
    envelope: Tensor


def turn_envelope(route: Tensor, s: Tensor, settings: AnchorSettings) -> Tensor:
    """Squared speed [..., K] allowed at arc lengths s + SPACING k, route [..., P, 2], s [...].

    Bounded by curvature there and by what braking at turn_brake can still lose before the bends ahead.
    """
    way = SPACING * torch.arange(TURNING, device=s.device)
    curvature = interpolate(route, s[..., None] + way)[2]
    bound = settings.lateral_accel / curvature.abs().clamp(min=1e-4) + 2 * settings.turn_brake * way
    return bound.flip(-1).cummin(-1).values.flip(-1) - 2 * settings.turn_brake * way


def _constant(riders: _Riders, accel: Tensor, settings: AnchorSettings) -> Tensor:
    """Knots [B, M, R, A, 10] that hold accelerations accel [B, M, R, A] but for standstill, top speed and bends.

    The bound on speed depends on the way, the way on speed: a few fixed-point steps from the unbounded motion.
    """
    time = DT * torch.arange(HORIZON + EXTRA + 1, device=accel.device)
    v0 = riders.v[..., None, None, None]
    free = v0 + accel[..., None] * time
    free = torch.minimum(free.clamp(min=0), v0.clamp(min=settings.top_speed))
    braking = (v0 + settings.min_accel * time).clamp(min=0)  # nobody loses speed faster, bend or not
    speed = free
    for _ in range(3):
        way = torch.nn.functional.pad(((speed[..., 1:] + speed[..., :-1]) / 2 * DT).cumsum(-1), (1, 0))
        at = (way / SPACING).clamp(max=TURNING - 1.001)
        low = at.long()
        table = riders.envelope[..., None, :].expand(*way.shape[:-1], TURNING)
        bound = torch.lerp(table.gather(-1, low), table.gather(-1, low + 1), at - low)
        speed = torch.maximum(torch.minimum(free, bound.clamp(min=0).sqrt()), braking)
    stride = HORIZON // KNOTS
    knot = stride * torch.arange(1, KNOTS + 1, device=accel.device)
    slope = (speed[..., knot + EXTRA] - speed[..., knot - EXTRA]) / (2 * EXTRA * DT)
    return slope.clamp(settings.min_accel, settings.max_accel)


def _decode(riders: _Riders, knots: Tensor) -> tuple[Tensor, Tensor]:
    """Speed and way [..., HORIZON] of knots [B, M, R, A, 10], by the prior's decoder."""
    shape = knots.shape[:-1]
    zero = torch.zeros(shape, device=knots.device)
    state = LaneState(*(zero for _ in range(10)))
    state.v, state.a = (x[..., None, None].expand(shape) for x in (riders.v, riders.a))
    return speeds(state, knots)


def _score(riders: _Riders, accel: Tensor, target: dict[str, Tensor], settings: AnchorSettings):
    """Cost, arrival offset [s] (both [B, M, R, A]) and knots [B, M, R, A, 10] of accelerations accel [B, M, R, A].

    At each step at which the target is on a candidate, the vehicle's distance to that point over its speed is the
    difference of the two arrival times; the step counts that makes it least.
    """
    knots = _constant(riders, accel, settings)
    v, way = _decode(riders, knots)
    there, d = target["s"][..., None, :], target["d"][..., None, :]
    own_d = riders.d[..., None, None] * fade(way, riders.v[..., None, None, None])
    across = (d - own_d).abs()
    short = (there - riders.s[..., None, None] - way).abs() - target["slack"][..., None, :]
    late = short.clamp(min=0) / v.clamp(min=1.0) + across * target["aside"][..., None, :]
    met = (across <= target["corridor"][..., None, None, None]) & (there <= riders.end[..., None, None])
    offset = late.masked_fill(~met, torch.inf).amin(-1)
    offset = offset.masked_fill(~riders.usable[..., None], torch.inf)
    cost = offset + settings.accel_cost * accel.abs() + settings.lateral_cost * riders.d.abs()[..., None]
    return cost, offset, knots


def _targets(riders: _Riders, path: Tensor, size: Tensor, settings: AnchorSettings) -> dict[str, Tensor]:
    """A target's path [B, M, H, 4] and size [B, M, 2] seen along each candidate.

    s, d [B, M, R, H]: place on the candidate; slack [m]: boxes that move alike touch before their centres meet; aside
    [s/m]: time per metre until a crossing target is over the centreline; corridor [B, M]: half widths that touch.
    """
    s, d, heading = project(path[:, :, None, :, :2], riders.routes)
    along = wrap(path[:, :, None, :, 2] - heading).cos()
    touch = (riders.size[..., 0] + size[..., 0]) / 2
    aside = (1 - along**2) / path[:, :, None, :, 3].clamp(min=1.0)
    corridor = (riders.size[..., 1] + size[..., 1]) / 2 + settings.margin
    return {
        "s": s,
        "d": d,
        "slack": 0.8 * touch[..., None, None] * along.clamp(min=0) ** 2,
        "aside": aside,
        "corridor": corridor,
    }


def _best(cost: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Rows of values [B, M, R, A, ...] at the least cost [B, M, R, A]; the first is the flat index [B, M]."""
    pick = cost.flatten(2).argmin(-1)
    flat = [value.flatten(2, 3) for value in values]
    at = [pick[..., None, None] if value.dim() == 4 else pick[..., None] for value in flat]
    rows = [
        value.gather(2, i.expand(*i.shape[:3], *value.shape[3:]))[:, :, 0] for value, i in zip(flat, at, strict=True)
    ]
    return pick, *rows


def _riders(scene: TensorDictBase, world: World, index: Tensor, settings: AnchorSettings, keep_route: bool) -> _Riders:
    vehicles, count = scene["route_points"].shape[1:3]
    states, route = take(world.states[:, :vehicles], index), take(world.route, index)[..., None]
    candidate = route.clamp(min=0) if keep_route else torch.arange(count, device=index.device).expand(*index.shape, -1)
    row = torch.arange(len(index), device=index.device)[:, None, None]
    of = lambda key: scene[key][row, index[..., None], candidate]  # noqa: E731
    routes, end = of("route_points"), of("route_length")
    s, d, error = place(states, routes)
    swing = SWING * error.clamp(-1.0, 1.0).tan().abs() * lateral_horizon(states[..., 3])[..., None]
    reachable = (d.abs() <= settings.max_shift) & (swing <= settings.max_swing)
    usable = of("route_valid") & (reachable | (candidate == route))
    if keep_route:
        usable = usable & (route >= 0)
    return _Riders(
        candidate,
        routes,
        usable,
        end,
        s,
        d,
        states[..., 3],
        take(world.accel[:, :vehicles], index),
        take(scene["size"], index),
        turn_envelope(routes, s, settings),
    )


def _propose(riders: _Riders, path: Tensor, size: Tensor, settings: AnchorSettings):
    """Candidate [B, M], knots [B, M, 10], offset [B, M]: a coarse grid of accelerations, then a fine one around its
    best.
    """
    target = _targets(riders, path, size, settings)
    grid = torch.linspace(settings.min_accel, settings.max_accel, settings.options, device=path.device)
    grid = grid.expand(*riders.s.shape, settings.options)
    cost, _, _ = _score(riders, grid, target, settings)
    pick = cost.argmin(-1, keepdim=True)  # per candidate
    width = (settings.max_accel - settings.min_accel) / (settings.options - 1)
    fine = grid.gather(-1, pick) + width * torch.linspace(-1, 1, 9, device=path.device)
    cost, offset, knots = _score(riders, fine.clamp(settings.min_accel, settings.max_accel), target, settings)
    pick, offset, knots, cost = _best(cost, offset, knots, cost)
    return pick // fine.shape[-1], knots, offset, cost


def propose(
    scene: TensorDictBase,
    world: World,
    skeleton: Skeleton,
    ego_plan: Tensor,
    settings: AnchorSettings,
    interception: InterceptionSettings,
    eta: Tensor,
    keep_route: bool = False,
) -> Anchor:
    """The skeleton-consistent clean state of Sec. IV-A3 for scenes [B]; ego_plan [B, H >= 50, 4], eta [B].

    Links are worked off from the ego outwards: those that act on the ego meet its plan, on a lane or (where that costs
    less) by an interception; the others meet their target's proposal, or its route at present speed where it has none
    on a lane. keep_route: only the candidates that vehicles follow now
    (between two choices of the support, where nobody changes its route).
    """
    times = DT * torch.arange(1, HORIZON + 1, device=ego_plan.device)
    expected = cruise(scene, world, times)
    expected[:, 0] = ego_plan[:, :HORIZON].detach()
    found = Anchor(
        world.route.clone(),
        expected.new_zeros(*world.route.shape, KNOTS),
        skeleton.coalition & False,
        expected.new_full(world.route.shape, torch.inf),
        skeleton.coalition & False,
        torch.zeros_like(scene["route_points"][:, :, 0]),
    )
    for depth in range(1, int(skeleton.depth.max()) + 1):
        index, present = compact(skeleton.depth == depth)
        riders = _riders(scene, world, index, settings, keep_route)
        target = skeleton.target.gather(1, index).clamp(min=0)
        pick, knots, late, cost = _propose(riders, take(expected, target), take(scene["size"], target), settings)
        cost = cost.masked_fill(~present | (late > settings.max_offset), torch.inf)
        way = None
        if depth == 1 and interception.reach > 0:
            way = _intercept(scene, world, index, expected, target, eta, interception)
        on_lane = cost.isfinite() if way is None else cost.isfinite() & ~(way.cost < cost)
        expected = _write(expected, index, on_lane, _rides(riders, pick, knots))
        chosen = riders.candidate.gather(2, pick[..., None])[..., 0]
        found = _noted(found, index, on_lane, has=on_lane, cost=cost, knots=knots, route=chosen)
        if way is not None:
            leaves = present & (way.cost < cost)
            found = _noted(found, index, leaves, has=leaves, leaves=leaves, **vars(way))
    return found


def _noted(anchor: Anchor, index: Tensor, mask: Tensor, **rows: Tensor) -> Anchor:
    """The Anchor with fields' rows [B, M, ...] written at slots index [B, M] where mask [B, M]."""
    return replace(anchor, **{name: _write(getattr(anchor, name), index, mask, new) for name, new in rows.items()})


def _rides(riders: _Riders, pick: Tensor, knots: Tensor) -> Tensor:
    """States [B, M, H, 4] of the riders on candidates pick [B, M] with knots [B, M, 10]."""
    pick = pick[..., None]
    v, way = (x[:, :, 0, 0] for x in _decode(riders, knots[:, :, None, None]))
    own = riders.routes.gather(2, pick[..., None, None].expand(-1, -1, 1, *riders.routes.shape[3:]))[:, :, 0]
    return ride(own, riders.s.gather(2, pick) + way, riders.d.gather(2, pick) * fade(way, riders.v[..., None]), v)


def _intercept(
    scene: TensorDictBase,
    world: World,
    index: Tensor,
    expected: Tensor,
    target: Tensor,
    eta: Tensor,
    settings: InterceptionSettings,
) -> Interception:
    """Interceptions of slots index [B, M]; everybody else is expected to drive as in expected [B, V, H, 4]."""
    vehicles = expected.shape[1]
    row = torch.arange(vehicles, device=index.device)
    there = world.valid[:, None, :vehicles] & (row != index[..., None]) & (row != target[..., None])
    sizes, wide = scene["size"][:, :vehicles], (-1, index.shape[1], -1, -1)
    others = (expected[:, None].expand(*wide, -1), sizes[:, None].expand(wide), there)
    return intercept(
        scene,
        take(world.states, index),
        take(sizes, index),
        take(expected, target),
        take(sizes, target),
        eta,
        others,
        settings,
    )


def _write(full: Tensor, index: Tensor, mask: Tensor, rows: Tensor) -> Tensor:
    """full [B, V, ...] with rows [B, M, ...] at index [B, M] where mask [B, M]."""
    extra = [1] * (full.dim() - 2)
    mask = mask.view(*mask.shape, *extra)
    at = index.view(*index.shape, *extra).expand(*index.shape, *full.shape[2:])
    return full.scatter(1, at, torch.where(mask, rows, full.gather(1, at)))


def blend_clean(
    x: Tensor, x0: Tensor, anchor_x0: Tensor, alpha: Tensor | float, mask: Tensor, strength: float
) -> Tensor:
    """Anchoring that keeps the noise (design.md 7.2): x0' = (1 - a) x0 + a anchor_x0 on `mask`, the noise of x as it
    was.

    x, x0, anchor_x0 [B, V, D]; alpha: signal scale of the noise level (square root of the paper's gamma-bar);
    mask [B, V] or [B, V, D]; strength a in [0, 1]. With x = alpha x0 + sigma e this is alpha x0' + sigma e.
    """
    mask = mask if mask.dim() == x.dim() else mask[..., None]
    return torch.where(mask, x + alpha * strength * (anchor_x0 - x0), x)


def blend_literal(
    x: Tensor,
    anchor_x0: Tensor,
    alpha: Tensor | float,
    sigma: Tensor | float,
    mask: Tensor,
    strength: float,
    noise: Tensor,
) -> Tensor:
    """Anchoring as printed, eq. (anchor_injection): (1 - a) x + a (alpha anchor_x0 + sigma noise) on `mask`.

    Independent noises shrink the noise variance by (1 - a)^2 + a^2; kept for the ablation. Shapes as in blend_clean,
    noise [B, V, D] standard normal.
    """
    mask = mask if mask.dim() == x.dim() else mask[..., None]
    return torch.where(mask, (1 - strength) * x + strength * (alpha * anchor_x0 + sigma * noise), x)
