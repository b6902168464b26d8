"""Semantic feasibility (Sec. IV-A2): the vehicles that could come into conflict with
the ego, by rules on the scene."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.route import interpolate, project
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World
from e2rl.traffic.motion import (
    MAX_ACCELERATION,
    arrival_window,
    frenet_pose,
)

EGO_ACCELERATION = 2.0  # m/s^2 that the ego is expected to use at most
SAMPLE_SPACING = 3.0  # m between the points of two routes that are compared
SAMPLE_REACH = 120.0  # m of route ahead that is sampled
# s of time gap that 1 m between the routes weighs: they meet where they touch, if they
# touch.
SEPARATION_COST = 10.0
LATERAL_BOUND = 2.0  # m from a lane's centreline that still counts as on the lane
HEADING_BOUND = 0.8  # rad, the same for the heading
MOVING_SPEED = 0.5  # m/s above which a vehicle counts as moving
# m ahead of the ego, bumper to bumper, within which a standing vehicle blocks it.
BLOCKING_DISTANCE = 15.0
# m beside the ego's own width in which a standing vehicle still blocks it.
BLOCKING_MARGIN = 0.3


@configured("synthesizer/e2", "feasibility")
@dataclass(frozen=True)
class FeasibilitySettings:
    """Thresholds of the three criteria; conf/synthesizer/e2.yaml explains each."""

    horizon: float = setting(low=0.1)
    # In a narrower one a crossing could fall between the samples.
    corridor: float = setting(low=0.8 * SAMPLE_SPACING)


@dataclass(frozen=True)
class Conflicts:
    """Conflict points of the candidate routes with the ego's mission route, or with
    that on which it is expected (`NominalTraffic.as_seen`); each [B, V, R], 0 where
    `exists` is false.

    exists: the routes meet, and both vehicles can be there at the same time within the
    horizon; s [m]: arc length of the conflict point on the candidate; earliest, latest
    [s]: times at which both can be there; time_gap [s]: between their arrivals at
    present speeds.
    """

    exists: Tensor
    s: Tensor
    earliest: Tensor
    latest: Tensor
    time_gap: Tensor


@dataclass(frozen=True)
class Feasibility:
    """mask [B, V] = associated & conflicting & relevant, never the ego; conflicts: what
    `conflicting` rests on."""

    mask: Tensor
    associated: Tensor
    conflicting: Tensor
    relevant: Tensor
    conflicts: Conflicts


class _Samples(NamedTuple):
    """K points ahead on each of Q routes: arc length s, xy [Q, K, 2], heading, arrival
    times [s] (earliest, latest, at present speed), and whether the route reaches so
    far; each [Q, K] but xy.
    """

    s: Tensor
    xy: Tensor
    heading: Tensor
    earliest: Tensor
    latest: Tensor
    nominal: Tensor
    on_route: Tensor


def _sample(
    route: Tensor,
    s: Tensor,
    end: Tensor,
    speed: Tensor,
    length: Tensor,
    acceleration: float,
) -> _Samples:
    """Samples ahead of arc lengths s [Q] on routes [Q, P, 2] that end at `end` [Q]; a
    vehicle of `length` [Q] m is at a point from when its front bumper arrives until its
    rear bumper has passed."""
    distance = torch.arange(0, SAMPLE_REACH + 1e-3, SAMPLE_SPACING, device=s.device)
    arc = s[:, None] + distance
    speed = speed[:, None]
    half = length[:, None] / 2
    xy, heading, _ = interpolate(route, arc)
    earliest, _ = arrival_window(distance - half, speed, acceleration=acceleration)
    _, latest = arrival_window(distance + half, speed, acceleration=acceleration)
    return _Samples(
        arc,
        xy,
        heading=heading,
        earliest=earliest,
        latest=latest,
        nominal=distance / speed.clamp(min=1.0),
        on_route=arc <= end[:, None],
    )


class _Meeting(NamedTuple):
    """The samples at which each candidate [Q] meets the mission: index on both,
    earliest, latest and time gap [s], inf for none."""

    candidate: Tensor
    ego: Tensor
    earliest: Tensor
    latest: Tensor
    time_gap: Tensor


def _meeting(own: _Samples, ego: _Samples, settings: FeasibilitySettings) -> _Meeting:
    """Of the samples within the corridor that both vehicles can occupy at once, that of
    least time gap."""
    squared = torch.cdist(own.xy, ego.xy, compute_mode="use_mm_for_euclid_dist")
    squared = squared.square()
    earliest = torch.maximum(own.earliest[:, :, None], ego.earliest[:, None])
    latest = torch.minimum(own.latest[:, :, None], ego.latest[:, None])
    latest = latest.clamp(max=settings.horizon)
    time_gap = (own.nominal[:, :, None] - ego.nominal[:, None]).abs()
    meets = (squared < settings.corridor**2) & (earliest <= latest)
    meets &= own.on_route[:, :, None] & ego.on_route[:, None]
    number = torch.arange(time_gap.shape[1], device=time_gap.device)[:, None]
    order = number * 1e-3  # the first of equals
    separation = (squared.sqrt() - SAMPLE_SPACING).clamp(min=0)
    cost = time_gap + order + SEPARATION_COST * separation
    cost = cost.masked_fill(~meets, torch.inf).flatten(1)
    pick = cost.argmin(-1, keepdim=True)
    count = ego.xy.shape[1]
    time_gap = time_gap.masked_fill(~meets, torch.inf)
    earliest, latest, time_gap = (
        value.flatten(1).gather(1, pick)[:, 0] for value in (earliest, latest, time_gap)
    )
    index = pick[:, 0]
    return _Meeting(
        index // count,
        index % count,
        earliest=earliest,
        latest=latest,
        time_gap=time_gap,
    )


def _to_intersection(
    points: Tensor,
    heading: Tensor,
    ego: Tensor,
    ego_heading: Tensor,
) -> Tensor:
    """Shift [Q] in m along a route from points [Q, 2] to where its tangent crosses that
    of the ego's route at near points `ego` [Q, 2]; 0 where they are near parallel.
    """
    u = unit_vectors(heading)
    w = unit_vectors(ego_heading)
    gap = ego - points
    cross = u[..., 0] * w[..., 1] - u[..., 1] * w[..., 0]
    crossing = cross.abs() > 0.3
    shift = (gap[..., 0] * w[..., 1] - gap[..., 1] * w[..., 0]) / torch.where(
        crossing,
        cross,
        1.0,
    )
    return torch.where(crossing, shift, 0.0).clamp(-SAMPLE_SPACING, SAMPLE_SPACING)


def find_conflicts(
    scene: TensorDictBase,
    world: World,
    own_s: Tensor,
    settings: FeasibilitySettings,
) -> Conflicts:
    """Returns the conflict points of scenes with the ego's mission.

    Args:
        scene: B scenes.
        world: the scenes now.
        own_s: [B, V, R] m, arc length of vehicles on their candidates.
        settings: thresholds.
    """
    vehicles = own_s.shape[1]
    states = world.states[:, :vehicles]
    length = scene["size"][..., 0]
    mission = mission_of(scene)
    candidates = scene["route_valid"] & world.valid[:, :vehicles, None]
    candidates[:, 0] = False
    place = candidates.nonzero(as_tuple=True)  # padding would be most of the work
    b, v, _ = place
    ego = _sample(
        mission.points,
        project(states[:, :1, :2], mission.points)[0][:, 0],
        end=mission.end,
        speed=states[:, 0, 3],
        length=length[:, 0],
        acceleration=EGO_ACCELERATION,
    )
    ego = _Samples(*(value[b] for value in ego))
    vehicle = _sample(
        scene["route_points"][place],
        own_s[place],
        end=scene["route_length"][place],
        speed=states[b, v, 3],
        length=length[b, v],
        acceleration=MAX_ACCELERATION,
    )
    meeting = _meeting(vehicle, ego, settings=settings)
    row = torch.arange(len(b), device=b.device)
    on_candidate = (row, meeting.candidate)
    on_ego = (row, meeting.ego)
    conflict_s = vehicle.s[on_candidate] + _to_intersection(
        vehicle.xy[on_candidate],
        vehicle.heading[on_candidate],
        ego=ego.xy[on_ego],
        ego_heading=ego.heading[on_ego],
    )
    exists = meeting.time_gap.isfinite()

    def table(value: Tensor) -> Tensor:
        value = torch.where(exists, value, 0.0).to(own_s.dtype)
        return torch.zeros_like(own_s).index_put(place, value)

    return Conflicts(
        exists=torch.zeros_like(candidates).index_put(place, exists),
        s=table(conflict_s),
        earliest=table(meeting.earliest),
        latest=table(meeting.latest),
        time_gap=table(meeting.time_gap),
    )


def blocks_ego(scene: TensorDictBase, world: World) -> Tensor:
    """Returns bool [B, V]: on the ego's mission route, at most BLOCKING_DISTANCE m
    (bumper to bumper) ahead of it."""
    mission = mission_of(scene)
    vehicles = scene["route_points"].shape[1]
    size = scene["size"][:, :vehicles]
    s, d, _ = project(world.states[:, :vehicles, :2], mission.points)
    gap = s - s[:, :1] - (size[..., 0] + size[:, :1, 0]) / 2
    in_the_way = d.abs() <= (size[..., 1] + size[:, :1, 1]) / 2 + BLOCKING_MARGIN
    return (s > s[:, :1]) & (gap <= BLOCKING_DISTANCE) & in_the_way


def feasible_vehicles(
    scene: TensorDictBase,
    world: World,
    settings: FeasibilitySettings,
) -> Feasibility:
    """Returns the feasible set F of scenes [B] by the three criteria of Sec. IV-A2.

    associated: on the drivable area, near and along one of its candidate routes;
    conflicting: a candidate has a conflict point with the ego's mission; relevant:
    moving, or standing in front of the ego, and not parked.
    """
    vehicles = scene["route_points"].shape[1]
    states = world.states[:, :vehicles].detach()
    s, d, error = frenet_pose(states, scene["route_points"])
    on_lane = (
        (d.abs() <= LATERAL_BOUND)
        & (error.abs() <= HEADING_BOUND)
        & scene["route_valid"]
    )
    associated = on_lane.any(-1) & (
        off_road(states[..., :2], scene["field"], origin=scene["field_origin"]) <= 0
    )
    conflicts = find_conflicts(scene, world, own_s=s, settings=settings)
    conflicting = conflicts.exists.any(-1)
    moving = states[..., 3] > MOVING_SPEED
    relevant = (moving | blocks_ego(scene, world)) & ~scene["parked"][:, :vehicles]
    mask = world.valid[:, :vehicles] & associated & conflicting & relevant
    mask[:, 0] = False
    return Feasibility(
        mask,
        associated,
        conflicting=conflicting,
        relevant=relevant,
        conflicts=conflicts,
    )
