"""Small scenes with straight routes in any direction, all ground drivable, for the
synthesizer's tests."""

import math
from dataclasses import replace

import torch

from e2rl.prior.lane_relative import LaneState, speeds
from e2rl.scenes.route import SPACING
from e2rl.sim.world import World
from e2rl.traffic.e2.interception import Wish
from e2rl.traffic.e2.skeleton import STEP, Skeleton, SkeletonSettings, build_skeleton
from e2rl.traffic.motion import constant_speed_states
from tests.synthetic import BACK, make_scenes


def make_world(vehicles, copies: int = 1, rows: int = 8) -> World:
    """World of `copies` equal scenes of vehicles (x, y, heading, speed), the ego first,
    each on its own straight route.

    Routes are candidate 0 of each and begin 20 m behind it; nobody is parked; lanes are
    those of the synthetic road (y = 0 and y = 3.5, towards +x).
    """
    count = len(vehicles)
    scene = make_scenes(
        copies, num_vehicles=count, num_vrus=0, max_vehicles=rows, max_agents=rows + 2
    ).scenes
    state = torch.tensor(vehicles, dtype=torch.float32)
    scene["start"][:, :count] = state
    forward = torch.stack([state[:, 2].cos(), state[:, 2].sin()], -1)
    arc = SPACING * torch.arange(scene["route_points"].shape[3])
    line = state[:, None, :2] + (arc - BACK)[:, None] * forward[:, None]
    scene["route_points"][:, :count] = line[None, :, None].expand_as(
        scene["route_points"][:, :count]
    )
    scene["route_length"][:] = arc[-1]
    scene["route_open"][:] = False
    scene["parked"][:] = False
    step = 0.1 * torch.arange(scene["logged"].shape[1])
    scene["logged"][:, :, :count] = state
    scene["logged"][:, :, :count, :2] += (step[:, None, None] * state[:, 3:] * forward)[
        None
    ]
    scene["field"] = torch.full_like(scene["field"], -5.0)
    return replace(World.at_start(scene), route=scene["route_log"].clamp(min=0))


def add_route(world: World, vehicle: int, candidate: int, heading: float) -> None:
    """One more straight candidate for a vehicle, through its place."""
    state = world.states[:, vehicle]
    forward = torch.tensor([math.cos(heading), math.sin(heading)])
    arc = SPACING * torch.arange(world.scene["route_points"].shape[3]) - BACK
    world.scene["route_points"][:, vehicle, candidate] = (
        state[:, None, :2] + arc[:, None] * forward
    )
    world.scene["route_valid"][:, vehicle, candidate] = True


def decoded(
    knots: torch.Tensor, speed: float, accel: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Speed and way [50] of one vehicle's knots [10], by the prior's decoder."""
    state = LaneState(*(torch.zeros(()) for _ in range(10)))
    state.v = torch.tensor(speed)
    state.a = torch.as_tensor(accel)
    return speeds(state, knots)


def mask(world: World, *vehicles: int) -> torch.Tensor:
    """Bool [B, V], true for the vehicles."""
    chosen = torch.zeros(world.scene["route_points"].shape[:2], dtype=torch.bool)
    chosen[:, list(vehicles)] = True
    return chosen


def skeleton_of(
    world: World,
    support: torch.Tensor,
    feasible: torch.Tensor | None = None,
    cost=None,
    **settings,
) -> Skeleton:
    """The skeleton if everybody keeps its speed; cost: of meeting the ego, by default
    the distance to it."""
    chosen = SkeletonSettings(**settings)
    times = STEP * torch.arange(1, 11)
    distance = (world.states[:, : support.shape[1], :2] - world.states[:, :1, :2]).norm(
        dim=-1
    )
    expected = constant_speed_states(world.scene, world, times=times)
    feasible = support if feasible is None else feasible
    return build_skeleton(
        world,
        support=support,
        feasible=feasible,
        settings=chosen,
        expected=expected,
        cost=distance if cost is None else cost,
    )


def wish_of(batch, eta=2.0, moment=-1.0, wrong_way=0.0):
    return Wish(*(torch.full((batch,), value) for value in (eta, moment, wrong_way)))
