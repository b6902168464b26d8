"""Provocations: what vehicles ahead of the ego may do to it (Sec. IV-B1 under a duty of care; docs/adversaries.md).

A vehicle that drives the ego's way cuts in ahead of its front, or approaches along its lane, and then brakes late and
hard. Of the motions that a weaker driver hits, those count that a careful and competent one avoids (margin.py), and the
one that leaves it least is proposed. Accelerations grow with the intensity, up to what real leaders do.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON, KNOT_STEPS
from e2rl.scene.boxes import overlap, to_frame
from e2rl.scene.recording import DT
from e2rl.settings import check_range
from e2rl.sim.drivable import off_road
from e2rl.sim.world import World
from e2rl.synthesizer.interception import (
    CLEARANCE,
    ENDS,
    MAX_BEARING,
    MAX_CURVATURE,
    MAX_TURN,
    Paths,
    lateral_limits,
    paths_to,
    resampled,
)
from e2rl.synthesizer.margin import competent_margin
from e2rl.synthesizer.motion import frenet_pose, remaining_offset, states_on_route, take
from e2rl.synthesizer.responsibility import place_of
from e2rl.verdicts.drivers import HumanDriver
from e2rl.verdicts.redrive import driven_length, poses

LAW_BRAKING = 8.0  # m/s^2, what real leaders do in emergencies
APPROACHES = (-2.0, -1.0, 0.0, 1.0, 2.0)  # m/s^2 along a lane, until a vehicle brakes
BEGINS = (0.5, 1.0, 2.0, 3.0)  # s at which it begins to
SHARES = (0.5, 1.0)  # of the braking allowed
LANE_BOUND, LANE_ANGLE = 2.0, 0.5  # m, rad: a lane that a vehicle may take without a path of its own
NEAR = 4.0  # m ahead of the ego's centre from which on a vehicle leads it
VERTICES = 64  # of a path off the lanes
COARSE = 5  # steps between the moments at which the others are looked at


@dataclass(frozen=True)
class ProvocationSettings:
    """Limits per unit of intensity, and costs; conf/synthesizer/e2.yaml explains each."""

    reach: float = 4.0
    gaps: tuple[float, ...] = (1.0, 4.0, 8.0, 12.0)
    overlap: float = 0.6
    push: float = 1.5
    brake: float = 1.2
    lateral: float = 2.0
    stop: float = 4.0
    shoulder: float = 0.5
    weaker: float = 5.5
    margin_cost: float = 0.3
    accel_cost: float = 0.2
    lateral_cost: float = 0.2
    time_cost: float = 0.1

    def __post_init__(self) -> None:
        check_range("synthesizer.provocation.reach", self.reach, KNOT_STEPS * DT, HORIZON * DT)
        check_range("synthesizer.provocation.weaker", self.weaker, 0.5, HumanDriver().braking)


class Provocation(NamedTuple):
    """Of vehicles [B, M]: path [B, M, P, 2], route [B, M] int64 (-1: off the lanes, on `path`), knots [B, M, 10] m/s^2,
    cost [B, M], inf for vehicles without a lawful one."""

    path: Tensor
    route: Tensor
    knots: Tensor
    cost: Tensor


class _Options(NamedTuple):
    """Q motions, each field [Q, ...]: scene b and column m of the vehicle; first acceleration, until the moment [s], and
    the second; lateral acceleration; route (-1: none); number of the path (-1: none); states [Q, HORIZON + 1, 4]."""

    b: Tensor
    m: Tensor
    first: Tensor
    second: Tensor
    moment: Tensor
    lateral: Tensor
    route: Tensor
    path: Tensor
    states: Tensor

    def keep(self, mask: Tensor) -> "_Options":
        return _Options(*(value[mask] for value in self))


def leading(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: vehicles that drive the ego's way ahead of it, in its lane or beside it."""
    place, along = place_of(world, vehicles)
    return along & (place[..., 0] > NEAR)


def travelled(speed: Tensor, first: Tensor, second: Tensor, moment: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and speed [Q, HORIZON + 1] at steps 0..HORIZON of vehicles that accelerate by `first` until `moment` and
    by `second` from then on, and stop for good rather than drive backwards; all arguments [Q]."""
    time = DT * torch.arange(1, HORIZON + 1, device=speed.device)
    accel = torch.where(time <= moment[:, None] + DT / 10, first[:, None], second[:, None])
    free = speed[:, None] + torch.nn.functional.pad((accel * DT).cumsum(-1), (1, 0))
    v = free.masked_fill((free <= 0).cumsum(-1) > 0, 0.0)
    return torch.nn.functional.pad(((v[:, 1:] + v[:, :-1]) / 2 * DT).cumsum(-1), (1, 0)), v


def provoke(
    world: World,
    index: Tensor,
    present: Tensor,
    expected: Tensor,
    eta: Tensor,
    settings: ProvocationSettings,
    keep_route: bool,
) -> Provocation:
    """The provocation of least cost by each of vehicles index [B, M], present [B, M].

    expected [B, V, H, 4]: states of everybody at steps 1..H, the ego in row 0; eta [B]; keep_route: only the lanes that
    vehicles follow now.
    """
    ego = torch.cat([world.states[:, :1], expected[:, 0]], 1)
    paths, off_lane = _cut_ins(world, index, present, ego, eta, settings)
    on_lane = _along_lanes(world, index, present, eta, settings, keep_route)
    options = _Options(*(torch.cat(pair) for pair in zip(off_lane, on_lane, strict=True)))
    sizes, ego_size = take(world.scene["size"], index), world.scene["size"][:, 0]
    options = options.keep(_clear(world, index, options, sizes, expected))

    def margin(driver: HumanDriver) -> Tensor:
        b, m = options.b, options.m
        return competent_margin(ego[b], ego_size[b], options.states, sizes[b, m], driver)

    options = options.keep(margin(HumanDriver(braking=settings.weaker)) <= 0)
    left = margin(HumanDriver())
    cost = settings.margin_cost * left + settings.accel_cost * options.first.abs()
    cost = cost + settings.lateral_cost * options.lateral + settings.time_cost * options.moment
    cost = cost.masked_fill(~((left > 0) & left.isfinite()), torch.inf)
    return _cheapest(options, cost, paths, index, world.scene["route_points"].shape[3])


def _aims(
    world: World, states: Tensor, size: Tensor, ego: Tensor, steps: Tensor, settings: ProvocationSettings
) -> Tensor:
    """Poses [B, M, A, 4] ahead of the ego's front at each of steps [I] and each gap: in its track, and beside it so that
    boxes overlap by `overlap` m on the vehicle's own side."""
    ego_size, gaps = world.scene["size"][:, :1], torch.tensor(settings.gaps, device=states.device)
    bumper = (size[..., 0] + ego_size[..., 0])[..., None, None] / 2
    at = driven_length(ego)[:, None, steps, None] + gaps + bumper  # [B, M, I, J]
    aims = poses(ego, at.flatten(1)).view(*at.shape, 3)
    side = to_frame(states[:, :, None, None, :2], aims)[..., 1].sign()
    beside = ((size[..., 1] + ego_size[..., 1])[..., None, None] / 2 - settings.overlap).clamp(min=0)
    shift = torch.stack([torch.zeros_like(side), side * beside], -1)[..., None]  # [B, M, I, J, 2, 1]
    normal = torch.stack([-aims[..., 2].sin(), aims[..., 2].cos()], -1)[..., None, :]
    heading = aims[..., None, 2:].expand(*shift.shape)
    return torch.cat([aims[..., None, :2] + shift * normal, heading, torch.zeros_like(heading)], -1).flatten(2, 4)


def _cut_ins(
    world: World, index: Tensor, present: Tensor, ego: Tensor, eta: Tensor, settings: ProvocationSettings
) -> tuple[Paths, _Options]:
    """The paths of vehicles [B, M] to places ahead of the ego's front, and the Options on them: constant acceleration
    until they are there, then none, half or all of the braking allowed."""
    states, size = take(world.states, index), take(world.scene["size"], index)
    steps = torch.arange(KNOT_STEPS, round(settings.reach / DT) + 1, KNOT_STEPS, device=states.device)
    paths, v = paths_to(states, _aims(world, states, size, ego, steps, settings)), states[:, :, None, 3]
    time = (DT * steps).repeat_interleave(2 * len(settings.gaps) * ENDS).expand_as(paths.bearing)
    accel = 2 * (paths.length[..., -1] - v * time) / time**2
    lateral, curvature = lateral_limits(paths, v, accel)
    field, origin, dial = world.scene["field"], world.scene["field_origin"], eta[:, None, None]
    allowed = off_road(states[..., :2], field, origin).clamp(min=settings.shoulder)[..., None]
    ok = (accel <= settings.push * dial) & (accel >= -settings.brake * dial) & (v + accel * time >= 0)
    ok &= (lateral <= settings.lateral * dial) & (curvature < MAX_CURVATURE) & present[..., None]
    ok &= (paths.bearing.abs() < MAX_BEARING) & (paths.turn.abs() < MAX_TURN)
    b, m, o = (ok & (off_road(paths.points, field, origin).amax(-1) <= allowed)).nonzero(as_tuple=True)
    share = torch.tensor([0.0, *SHARES], device=states.device).repeat(len(b))
    b, m, o = (value.repeat_interleave(1 + len(SHARES)) for value in (b, m, o))
    second = -share * (settings.stop * eta[b]).clamp(max=LAW_BRAKING)
    first, moment = accel[b, m, o], time[b, m, o]
    way, speed = travelled(states[b, m, 3], first, second, moment)
    points, length, heading = (value[b, m, o][None] for value in (paths.points, paths.length, paths.end_heading))
    line = resampled(points, length, heading, VERTICES)[0]
    turn = torch.cat([states[b, m, 2:3], torch.atan2(*line.diff(dim=1).flip(-1).unbind(-1))], 1)
    line = torch.cat([line, turn[..., None], torch.zeros_like(turn)[..., None]], -1)
    motion = torch.cat([poses(line, way), speed[..., None]], -1)
    return paths, _Options(b, m, first, second, moment, lateral[b, m, o], torch.full_like(b, -1), o, motion)


def _along_lanes(
    world: World, index: Tensor, present: Tensor, eta: Tensor, settings: ProvocationSettings, keep_route: bool
) -> _Options:
    """Options on the lanes: braking at once, or an approach first."""
    scene = world.scene
    assert world.route is not None
    states, route = take(world.states, index), take(world.route, index)
    lanes = take(scene["route_points"], index)
    s, d, error = frenet_pose(states, lanes)
    own = torch.arange(lanes.shape[2], device=index.device) == route[..., None]
    usable = own if keep_route else own | ((d.abs() <= LANE_BOUND) & (error.abs() < LANE_ANGLE))
    b, m, r = (usable & take(scene["route_valid"], index) & present[..., None]).nonzero(as_tuple=True)
    approaches = torch.cartesian_prod(*(torch.tensor(values) for values in (APPROACHES, BEGINS, SHARES)))
    at_once = torch.tensor([[0.0, 0.0, share] for share in SHARES])
    profiles = torch.cat([at_once, approaches]).to(s.device)
    first, moment, share = profiles.repeat(len(b), 1).unbind(-1)
    b, m, r = (value.repeat_interleave(len(profiles)) for value in (b, m, r))
    second = -share * (settings.stop * eta[b]).clamp(max=LAW_BRAKING)
    v0 = states[b, m, 3]
    way, speed = travelled(v0, first, second, moment)
    offset = d[b, m, r, None] * remaining_offset(way, v0[:, None])
    motion = states_on_route(lanes[b, m, r], s[b, m, r, None] + way, offset, v0[:, None])
    motion = torch.cat([motion[..., :3], speed[..., None]], -1)
    options = _Options(b, m, first, second, moment, torch.zeros_like(first), r, torch.full_like(b, -1), motion)
    return options.keep((first <= settings.push * eta[b]) & (first >= -settings.brake * eta[b]))


def _clear(world: World, index: Tensor, options: _Options, sizes: Tensor, expected: Tensor) -> Tensor:
    """Bool [Q]: motions touch nobody but the ego, and those whom the vehicle touches already."""
    b, m = options.b, options.m
    vehicles = expected.shape[1]
    row = torch.arange(vehicles, device=b.device)
    counts = world.valid[b, :vehicles] & (row != index[b, m][:, None]) & (row > 0)
    box, others_size = (sizes[b, m] + CLEARANCE)[:, None], world.scene["size"][b, :vehicles]
    touched = overlap(options.states[:, :1], box, world.states[b, :vehicles], others_size)
    later = options.states[:, None, COARSE::COARSE], box[:, None], expected[b, :, COARSE - 1 :: COARSE]
    hit = overlap(*later, others_size[:, :, None]) & (counts & ~touched)[..., None]
    return ~hit.flatten(1).any(1)


def _cheapest(options: _Options, cost: Tensor, paths: Paths, index: Tensor, vertices: int) -> Provocation:
    """The option of least cost of each vehicle index [B, M]; costs [Q]."""
    flat = options.b * index.shape[1] + options.m
    best = cost.new_full((index.numel(),), torch.inf).scatter_reduce(0, flat, cost, "amin")
    winner = ((cost == best[flat]) & cost.isfinite()).nonzero()[:, 0]
    at, option = flat[winner], options.keep(winner)
    slots = index.numel()
    time = DT * KNOT_STEPS * torch.arange(1, HORIZON // KNOT_STEPS + 1, device=cost.device)
    profile = torch.where(time <= option.moment[:, None] + DT / 10, option.first[:, None], option.second[:, None])
    knots = cost.new_zeros(slots, len(time)).index_put((at,), profile)
    route = torch.full_like(index, -1).flatten().index_put((at,), option.route)
    path, off = cost.new_zeros(slots, vertices, 2), option.path >= 0
    if bool(off.any()):
        chosen = option.b[off], option.m[off], option.path[off]
        line = resampled(*(value[chosen][None] for value in (paths.points, paths.length, paths.end_heading)), vertices)
        path = path.index_put((at[off],), line[0])
    shape = index.shape
    return Provocation(path.view(*shape, vertices, 2), route.view(shape), knots.view(*shape, -1), best.view(shape))
