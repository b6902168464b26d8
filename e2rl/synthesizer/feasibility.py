"""Who could meet the ego at all: the three semantic criteria of Sec. IV-A2 as rules on scene tensors."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.route import interpolate, project
from e2rl.sim.drivable import off_road
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World
from e2rl.synthesizer.motion import arrival_window, place

APART = 10.0  # s a metre: lines that touch meet there, and not where they only come near


@dataclass(frozen=True)
class FeasibilitySettings:
    """Settings of the semantic rules; conf/synthesizer/e2.yaml explains each."""

    horizon: float = 5.0
    lateral_bound: float = 2.0
    heading_bound: float = 0.8
    corridor: float = 6.0
    sample_spacing: float = 3.0
    sample_reach: float = 120.0
    brake: float = 5.0
    push: float = 4.0
    ego_brake: float = 5.0
    ego_push: float = 2.0
    top_speed: float = 25.0
    moving_speed: float = 0.5
    blocking_distance: float = 15.0
    blocking_margin: float = 0.3

    def __post_init__(self):
        if min(self.horizon, self.brake, self.push, self.ego_brake, self.ego_push, self.top_speed) <= 0:
            raise InputError(
                "synthesizer.feasibility: horizon, brake, push, ego_brake, ego_push and top_speed must be positive"
            )
        if not 0 < self.sample_spacing < self.sample_reach or self.corridor < 0.8 * self.sample_spacing:
            raise InputError(
                "synthesizer.feasibility: sample_spacing must be below sample_reach and at most 1.25 x "
                f"corridor ({self.corridor} m), or crossings fall between the samples"
            )


@dataclass(frozen=True)
class Conflicts:
    """Where each route candidate meets the ego's mission route, each [B, V, R].

    has: they meet, and both vehicles can be there at the same time within the horizon; own_s, ego_s: arc lengths [m] of
    the meeting point on the candidate and on the mission; earliest, latest: window [s from now] in which both can be
    there (latest at most the horizon); offset: difference of the arrival times [s] if both keep their speed. best [B,
    V]: the candidate of smallest offset, -1 none. Where `has` is false the values are 0.
    """

    has: Tensor
    own_s: Tensor
    ego_s: Tensor
    earliest: Tensor
    latest: Tensor
    offset: Tensor
    best: Tensor


@dataclass(frozen=True)
class Feasibility:
    """mask [B, V] = associated & conflicting & relevant, never the ego; conflicts: the table it rests on."""

    mask: Tensor
    associated: Tensor
    conflicting: Tensor
    relevant: Tensor
    conflicts: Conflicts


def _presence(way: Tensor, speed: Tensor, length: Tensor, limits: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """Earliest time [s] at which a front bumper, and latest at which a rear bumper, is `way` m ahead of the centre
    now.
    """
    earliest, _ = arrival_window(way - length / 2, speed, *limits)
    _, latest = arrival_window(way + length / 2, speed, *limits)
    return earliest, latest


def _refine(points: Tensor, heading: Tensor, ego: Tensor, ego_heading: Tensor, most: float) -> tuple[Tensor, Tensor]:
    """Shifts [Q] along two tangents from near points [Q, 2] to where they cross; parallel ones move to the foot
    point.
    """
    u = torch.stack([heading.cos(), heading.sin()], -1)
    w = torch.stack([ego_heading.cos(), ego_heading.sin()], -1)
    gap = ego - points
    cross = u[..., 0] * w[..., 1] - u[..., 1] * w[..., 0]
    crossing = cross.abs() > 0.3
    safe = torch.where(crossing, cross, 1.0)
    own = (gap[..., 0] * w[..., 1] - gap[..., 1] * w[..., 0]) / safe
    other = (gap[..., 0] * u[..., 1] - gap[..., 1] * u[..., 0]) / safe
    own = torch.where(crossing, own, 0.0)
    other = torch.where(crossing, other, -(gap * w).sum(-1))
    return own.clamp(-most, most), other.clamp(-most, most)


def _meetings(samples: dict[str, Tensor], ego: dict[str, Tensor], settings: FeasibilitySettings):
    """Best pair of samples of each candidate [Q] with the mission: index on both [Q], offset, earliest, latest [Q].

    Of the pairs closer than the corridor that both can occupy at once, the one whose nominal arrival times differ
    least, where the lines touch if they do anywhere; offset is inf where there is none.
    """
    squared = torch.cdist(samples["xy"], ego["xy"], compute_mode="use_mm_for_euclid_dist").square()
    earliest = torch.maximum(samples["earliest"][:, :, None], ego["earliest"][:, None])
    latest = torch.minimum(samples["latest"][:, :, None], ego["latest"][:, None]).clamp(max=settings.horizon)
    nominal = (samples["nominal"][:, :, None] - ego["nominal"][:, None]).abs()
    meets = (squared < settings.corridor**2) & (earliest <= latest)
    meets &= samples["inside"][:, :, None] & ego["inside"][:, None]
    prefer = torch.arange(nominal.shape[1], device=nominal.device)[:, None] * 1e-3  # of equals the first
    apart = (squared.sqrt() - settings.sample_spacing).clamp(min=0)
    cost = (nominal + prefer + APART * apart).masked_fill(~meets, torch.inf).flatten(1)
    pick = cost.argmin(-1, keepdim=True)
    nominal = nominal.masked_fill(~meets, torch.inf)
    found = (x.flatten(1).gather(1, pick)[:, 0] for x in (nominal, earliest, latest))
    count = ego["xy"].shape[1]
    return pick[:, 0] // count, pick[:, 0] % count, *found


def _sample(
    route: Tensor,
    s: Tensor,
    end: Tensor,
    speed: Tensor,
    length: Tensor,
    limits: tuple[float, float, float],
    settings: FeasibilitySettings,
) -> dict[str, Tensor]:
    """Samples ahead of arc length s [Q] on route [Q, P, 2]: place, heading, and when the vehicle can be there [Q,
    K].
    """
    way = torch.arange(0, settings.sample_reach + 1e-3, settings.sample_spacing, device=s.device)
    arc = s[:, None] + way
    xy, heading, _ = interpolate(route, arc)
    way = way.expand_as(arc)
    earliest, latest = _presence(way, speed[:, None], length[:, None], limits)
    return {
        "arc": arc,
        "xy": xy,
        "heading": heading,
        "earliest": earliest,
        "latest": latest,
        "nominal": way / speed.clamp(min=1.0)[:, None],
        "inside": arc <= end[:, None],
    }


def find_conflicts(scene: TensorDictBase, world: World, own_s: Tensor, settings: FeasibilitySettings) -> Conflicts:
    """The conflict table; own_s [B, V, R]: arc length of each vehicle on each of its candidates.

    Only candidates that exist are looked at: padding would be most of the work.
    """
    vehicles = own_s.shape[1]
    states, mission = world.states[:, :vehicles], mission_of(scene)
    looked = scene["route_valid"] & world.valid[:, :vehicles, None]
    looked[:, 0] = False
    b, v, r = looked.nonzero(as_tuple=True)
    size = scene["size"][..., 0]
    ego_s = project(states[:, :1, :2], mission.points)[0][:, 0]
    ego = _sample(
        mission.points,
        ego_s,
        mission.end,
        states[:, 0, 3],
        size[:, 0],
        (settings.ego_brake, settings.ego_push, settings.top_speed),
        settings,
    )
    own = _sample(
        scene["route_points"][b, v, r],
        own_s[b, v, r],
        scene["route_length"][b, v, r],
        states[b, v, 3],
        size[b, v],
        (settings.brake, settings.push, settings.top_speed),
        settings,
    )
    ego = {key: value[b] for key, value in ego.items()}
    i, j, offset, earliest, latest = _meetings(own, ego, settings)
    row = torch.arange(len(b), device=b.device)
    shift, ego_shift = _refine(
        own["xy"][row, i], own["heading"][row, i], ego["xy"][row, j], ego["heading"][row, j], settings.sample_spacing
    )
    found = offset.isfinite()
    values = (own["arc"][row, i] + shift, ego["arc"][row, j] + ego_shift, earliest, latest, offset)

    def table(value: Tensor) -> Tensor:
        return torch.zeros_like(own_s).index_put((b, v, r), torch.where(found, value, 0.0).to(own_s.dtype))

    has = torch.zeros_like(looked).index_put((b, v, r), found)
    full = [table(value) for value in values]
    best = full[-1].masked_fill(~has, torch.inf).argmin(-1)
    return Conflicts(has, *full, torch.where(has.any(-1), best, -1))


def blocks_ego(scene: TensorDictBase, world: World, settings: FeasibilitySettings) -> Tensor:
    """Bool [B, V]: in the corridor of the ego's mission, at most blocking_distance m (bumper to bumper) ahead of it."""
    mission = mission_of(scene)
    vehicles = scene["route_points"].shape[1]
    size = scene["size"][:, :vehicles]
    s, d, _ = project(world.states[:, :vehicles, :2], mission.points)
    gap = s - s[:, :1] - (size[..., 0] + size[:, :1, 0]) / 2
    beside = d.abs() <= (size[..., 1] + size[:, :1, 1]) / 2 + settings.blocking_margin
    return (s > s[:, :1]) & (gap <= settings.blocking_distance) & beside


def feasible_vehicles(scene: TensorDictBase, world: World, settings: FeasibilitySettings) -> Feasibility:
    """Feasible set F of Sec. IV-A2 for scenes [B].

    associated: near enough to one of its lanes' centrelines, along it, and on the drivable area; conflicting: a
    candidate meets the ego's mission at a time both can reach; relevant: moving, or standing in the ego's way; never
    parked.
    """
    vehicles = scene["route_points"].shape[1]
    states = world.states[:, :vehicles].detach()
    s, d, error = place(states, scene["route_points"])
    fits = (d.abs() <= settings.lateral_bound) & (error.abs() <= settings.heading_bound) & scene["route_valid"]
    drivable = off_road(states[..., :2], scene["field"], scene["field_origin"]) <= 0
    associated = fits.any(-1) & drivable
    conflicts = find_conflicts(scene, world, s, settings)
    conflicting = conflicts.has.any(-1)
    moving = states[..., 3] > settings.moving_speed
    relevant = (moving | blocks_ego(scene, world, settings)) & ~scene["parked"][:, :vehicles]
    mask = world.valid[:, :vehicles] & associated & conflicting & relevant
    mask[:, 0] = False
    return Feasibility(mask, associated, conflicting, relevant, conflicts)
