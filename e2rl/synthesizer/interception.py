"""Interceptions: proposals that no lane leads to (Sec. IV-B1), a smooth way from a vehicle's pose to its target's path.

A lane-graph proposal can only choose when a vehicle is where its lane leads, where every planner expects it. Whoever
drifts over, cuts in or turns in early leaves its lane for a few seconds. Here is that way in closed form: a cubic from
the pose to where the target will be at one of several moments, driven at one constant acceleration, on the drivable
area, clear of everybody else, within limits of acceleration that grow with the intensity. The prior then plans along
this way as along any route, so what is driven stays a sample of the prior.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.prior.lane_relative import HORIZON, KNOT_STEPS
from e2rl.scene.boxes import overlap
from e2rl.scene.recording import DT
from e2rl.scene.route import SPACING
from e2rl.sim.drivable import off_road
from e2rl.sim.dynamics import wrap

ENDS = 3  # directions tried at the end of a way
SAMPLES = 17  # points of a way at which it is looked at
MAX_BEARING, MAX_TURN = 1.05, 1.4  # rad between heading and target, and between the two ends of a way
MAX_CURVATURE = 0.12  # 1/m, what a car's steering allows
ROOM = 0.3  # m kept to others on the way


@dataclass(frozen=True)
class InterceptionSettings:
    """Limits per unit of intensity and costs of interceptions; conf/synthesizer/e2.yaml explains each."""

    reach: float = 5.0
    push: float = 1.5
    brake: float = 1.2
    lateral: float = 2.0
    shoulder: float = 0.5
    accel_cost: float = 0.2
    lateral_cost: float = 0.2
    time_cost: float = 0.1
    preference: float = 2.0

    def __post_init__(self):
        if min(self.push, self.brake, self.lateral) < 0 or not 0 <= self.reach <= HORIZON * DT:
            raise InputError(
                "synthesizer.interception needs push, brake and lateral of at least 0, and reach between "
                f"0 (none) and {HORIZON * DT} s; they are {self.push}, {self.brake}, {self.lateral} and "
                f"{self.reach}"
            )


@dataclass(frozen=True)
class Interception:
    """points [B, M, P, 2]: the way, a vertex every SPACING m; knots [B, M, 10] m/s^2; cost [B, M] in seconds, inf where
    there is none within the limits."""

    points: Tensor
    knots: Tensor
    cost: Tensor


def _direction(heading: Tensor) -> Tensor:
    return torch.stack([heading.cos(), heading.sin()], -1)


def cubic(start: Tensor, heading: Tensor, end: Tensor, end_heading: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Points and derivatives [..., U, 2] at u [U] of the cubic between poses [..., 2] and [...]; where one circle
    touches both poses it is that circle's arc, to a thousandth."""
    chord = end - start
    bearing = wrap(torch.atan2(chord[..., 1], chord[..., 0]) - heading)
    chord = chord.norm(dim=-1)[..., None] / (bearing / 2).cos().square().clamp(min=0.5)[..., None]
    a, b = start[..., None, :], end[..., None, :]
    m, n = (chord * _direction(heading))[..., None, :], (chord * _direction(end_heading))[..., None, :]
    u = u[:, None]
    points = (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * m + (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * n
    slope = (6 * u**2 - 6 * u) * (a - b) + (3 * u**2 - 4 * u + 1) * m + (3 * u**2 - 2 * u) * n
    return points, slope


@dataclass(frozen=True)
class _Ways:
    """O ways of each vehicle: points, slope [B, M, O, U, 2] at even parameters, way [B, M, O, U]: metres to each point,
    bearing, turn [B, M, O]: of the target against the heading, and between both ends; end [B, M, O]: heading there."""

    points: Tensor
    slope: Tensor
    way: Tensor
    bearing: Tensor
    turn: Tensor
    end: Tensor


def _ways(states: Tensor, aim: Tensor) -> _Ways:
    """Ways from states [B, M, 4] to aims [B, M, I, 4], ENDS for each: an arc, straight at the aim in the end, or into
    the target's direction."""
    heading = states[:, :, None, 2].expand(aim.shape[:3])
    gap = aim[..., :2] - states[:, :, None, :2]
    bearing = wrap(torch.atan2(gap[..., 1], gap[..., 0]) - heading)
    end = torch.stack([heading + 2 * bearing, heading + bearing, aim[..., 2]], -1).flatten(2)
    heading, bearing, xy = (x.repeat_interleave(ENDS, 2) for x in (heading, bearing, aim[..., :2]))
    points, slope = cubic(
        states[:, :, None, :2].expand_as(xy), heading, xy, end, torch.linspace(0, 1, SAMPLES, device=states.device)
    )
    way = torch.nn.functional.pad(points.diff(dim=3).norm(dim=-1).cumsum(-1), (1, 0))
    return _Ways(points, slope, way, bearing, wrap(end - heading), end)


def _lateral(ways: _Ways, v: Tensor, accel: Tensor) -> tuple[Tensor, Tensor]:
    """Largest lateral acceleration [m/s^2] and curvature [1/m] (both [B, M, O]) on ways entered at speed v [B, M, 1]
    and driven at accel [B, M, O]."""
    turn = wrap(torch.atan2(ways.slope[..., 1], ways.slope[..., 0]).diff(dim=-1))
    curvature = (turn / ways.way.diff(dim=-1).clamp(min=0.1)).abs()
    squared = (v[..., None] ** 2 + 2 * accel[..., None] * ways.way[..., 1:]).clamp(min=0)
    return (squared * curvature).amax(-1), curvature.amax(-1)


def _clear(ways: _Ways, gone: Tensor, size: Tensor, others: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Bool [B, M, O]: vehicles that have gone `gone` [B, M, O, W] m of their ways (< 0: arrived) touch none of the
    others (states [B, M, J, W, 4], sizes [B, M, J, 2], presence [B, M, J])."""
    index = torch.searchsorted(ways.way.contiguous(), gone.contiguous()).clamp(0, SAMPLES - 1)
    index = index[..., None].expand(*index.shape, 2)
    slope = ways.slope.gather(3, index)
    heading = torch.atan2(slope[..., 1:], slope[..., :1])
    pose = torch.cat([ways.points.gather(3, index), heading, torch.zeros_like(heading)], -1)
    states, sizes, there = others
    hit = overlap(
        pose[:, :, :, None], (size + ROOM)[:, :, None, None, None], states[:, :, None], sizes[:, :, None, :, None]
    )
    return ~(hit & there[:, :, None, :, None] & (gone >= 0)[:, :, :, None]).flatten(3).any(-1)


def intercept(
    scene: TensorDictBase,
    states: Tensor,
    size: Tensor,
    target: Tensor,
    target_size: Tensor,
    eta: Tensor,
    others: tuple[Tensor, Tensor, Tensor],
    settings: InterceptionSettings,
) -> Interception:
    """The cheapest interception of each vehicle.

    states [B, M, 4], size [B, M, 2]; target [B, M, H, 4]: where its target will be at steps 1..H, target_size; eta [B];
    others: whom it must not touch on the way, their states [B, M, J, H, 4], sizes [B, M, J, 2] and presence [B, M, J].
    """
    steps = torch.arange(KNOT_STEPS, round(settings.reach / DT) + 1, KNOT_STEPS, device=states.device)
    aim, moments = target[:, :, steps - 1], DT * steps
    ways, v = _ways(states, aim), states[:, :, None, 3]
    time = moments.repeat_interleave(ENDS).expand_as(ways.bearing)
    # Boxes that move alike touch before their centres meet.
    alike = wrap(ways.end - aim[..., 2].repeat_interleave(ENDS, -1)).cos().clamp(min=0) ** 2
    length = ways.way[..., -1] - 0.4 * (size[..., 0] + target_size[..., 0])[..., None] * alike
    accel = 2 * (length.clamp(min=0) - v * time) / time**2
    lateral, curvature = _lateral(ways, v, accel)
    field, origin, dial = scene["field"], scene["field_origin"], eta[:, None, None]
    allowed = off_road(states[..., :2], field, origin).clamp(min=settings.shoulder)[..., None]
    ok = (accel <= settings.push * dial) & (accel >= -settings.brake * dial) & (v + accel * time >= 0)
    ok &= (lateral <= settings.lateral * dial) & (curvature < MAX_CURVATURE)
    ok &= (ways.bearing.abs() < MAX_BEARING) & (ways.turn.abs() < MAX_TURN)
    ok &= off_road(ways.points, field, origin).amax(-1) <= allowed
    gone = (v[..., None] * moments + 0.5 * accel[..., None] * moments**2).clamp(min=0)
    gone = gone.masked_fill(moments >= time[..., None], -1.0)
    ok &= _clear(ways, gone, size, (others[0][:, :, :, steps - 1], *others[1:]))
    cost = settings.accel_cost * accel.abs() + settings.lateral_cost * lateral + settings.time_cost * time
    cost = cost - settings.preference
    return _cheapest(ways, accel, time, cost.masked_fill(~ok, torch.inf), scene["route_points"].shape[3])


def _cheapest(ways: _Ways, accel: Tensor, time: Tensor, cost: Tensor, vertices: int) -> Interception:
    cost, pick = cost.min(-1)

    def best(values: Tensor) -> Tensor:
        index = pick.view(*pick.shape, *[1] * (values.dim() - 2)).expand(*pick.shape, 1, *values.shape[3:])
        return values.gather(2, index)[:, :, 0]

    at = DT * KNOT_STEPS * torch.arange(1, HORIZON // KNOT_STEPS + 1, device=cost.device)
    knots = best(accel)[..., None] * (at <= best(time)[..., None])
    return Interception(_resampled(best(ways.points), best(ways.way), best(ways.end), vertices), knots, cost)


def _resampled(points: Tensor, way: Tensor, heading: Tensor, count: int) -> Tensor:
    """Vertices [B, M, count, 2] every SPACING m along polylines points [B, M, U, 2] of lengths way [B, M, U], then
    straight on along heading [B, M]."""
    s = SPACING * torch.arange(count, device=points.device, dtype=points.dtype).expand(*way.shape[:2], count)
    after = torch.searchsorted(way.contiguous(), s.contiguous(), right=True).clamp(1, SAMPLES - 1)
    low, high = way.gather(-1, after - 1), way.gather(-1, after)
    share = ((s - low) / (high - low).clamp(min=1e-6)).clamp(max=1.0)
    a, b = (points.gather(2, i[..., None].expand(*i.shape, 2)) for i in (after - 1, after))
    beyond = (s - way[..., -1:]).clamp(min=0)
    return a + share[..., None] * (b - a) + beyond[..., None] * _direction(heading)[:, :, None]
