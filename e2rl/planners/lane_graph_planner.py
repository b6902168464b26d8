"""The lane-graph planner of STRIVE (Rempe et al. 2022) on the mission route.

It samples speed profiles along the mission, predicts the other agents on every matched
route at several speeds, and drives the longest profile whose probability of collision
(of five-circle boxes, hazard.py) is below `max_risk`. Vectorised over scenes, profiles,
agents and routes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.hazard import Prediction, collision_hazard
from e2rl.planners.path import MissionPath, RoutePath
from e2rl.planners.profiles import (
    NODES,
    PLAN_DT,
    approach,
    capped,
    targets,
    upsample,
)
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import unit_vectors
from e2rl.sim.dynamics import midpoints
from e2rl.sim.world import World

FIRST_HALF = 12  # nodes towards the first speed target
SECOND_HALF = NODES - FIRST_HALF
EARLIER = (
    0.01  # weight of the mean distance: of profiles that halt at one point the earliest
)
INTERACTION_DISTANCE = 70.0  # m from the ego, others farther away are not looked at
MATCH_DISTANCE = 2.0  # m between a vehicle and a route that it is on
MATCH_ANGLE = 20.0  # degrees


@configured("ego/lane_graph")
@dataclass(eq=False)
class LaneGraphEgo(Ego):
    """STRIVE's planner on our routes.

    Differences: the ego takes its mission instead of the first branch of its lane;
    curves, known limits and lights cap its speed; a car can drive its plan.
    """

    tuned = {
        "risk_slope": (0.15, 6.0, "log"),
        "max_risk": (0.02, 0.6),
        "risk_growth": (0.0, 0.2),
        "max_acceleration": (2.0, 7.0),
        "predicted_acceleration": (0.1, 1.0),
        "replan_every": (1, 5),
    }

    max_speed: float = setting(low=0.1)
    max_acceleration: float = setting(low=0.01)
    speeds: int = setting(low=1)
    max_risk: float = setting(low=0, high=1)
    risk_slope: float = setting(low=0)
    risk_growth: float = setting(low=0)
    predicted_speeds: Sequence[float] = setting(low=0)
    predicted_acceleration: float = setting(low=0)
    brake_if_unsafe: bool = setting()
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    def plan(self, world: World) -> Tensor:
        """The chosen profile as states [B, PLAN_STEPS, 4]."""
        path = MissionPath(world)
        speed = self.profiles(world, path)
        steps = midpoints(speed) * PLAN_DT
        driven = pad(steps.cumsum(-1), (1, 0))
        poses = path.at(path.ahead(driven.transpose(0, 1))).transpose(0, 1)
        others = predict(
            world,
            self.predicted_speeds,
            acceleration=self.predicted_acceleration * self.max_acceleration,
        )
        hazard = collision_hazard(
            poses,
            world.scene["size"][:, 0],
            others,
            slope=self.risk_slope,
            growth=self.risk_growth,
        )
        distance = driven[..., -1] + EARLIER * driven.mean(-1)
        best = self.choose(
            hazard,
            distance,
            matched=matched(path),
        )
        chosen = speed[torch.arange(len(best), device=best.device), best]
        return path.drive(upsample(chosen))

    def profiles(self, world: World, path: MissionPath) -> Tensor:
        """Speeds [B, C, NODES + 1] every PLAN_DT s of the C = speeds^2 profiles.

        Each half of the horizon has a target speed, evenly spaced over the range that
        max_acceleration reaches from the speed at its start. The path's speed caps
        apply as far as braking at max_acceleration attains them.
        """
        start = world.states[:, 0, 3]
        slope = self.max_acceleration * PLAN_DT
        caps = path.speed_caps(self.max_speed)
        top = caps.amax(1).clamp(min=0).sqrt()
        reach = FIRST_HALF * slope
        aims = targets(
            start,
            top,
            reach=reach,
            count=self.speeds,
        )
        first = approach(
            start[:, None],
            aims,
            slope=slope,
            steps=FIRST_HALF,
        )
        middle = first[..., -1]
        reach = SECOND_HALF * slope
        aims = targets(
            middle,
            top[:, None],
            reach=reach,
            count=self.speeds,
        )
        second = approach(
            middle[..., None],
            aims,
            slope=slope,
            steps=SECOND_HALF,
        )
        first = first[:, :, None].expand(-1, -1, self.speeds, -1)
        begin = start[:, None, None, None].expand(*first.shape[:3], 1)
        wanted = torch.cat([begin, first, second], -1).flatten(1, 2)
        return capped(wanted, caps, slope=slope)

    def choose(
        self,
        hazard: Tensor,
        driven: Tensor,
        matched: Tensor,
    ) -> Tensor:
        """Profile [B] by hazard [B, C] = -log(1 - probability of collision) and
        distance [B, C]: the longest below max_risk (the shortest for an ego off its
        route with agents around), if none the least hazardous, or with
        `brake_if_unsafe` the shortest.

        The hazard adds up over the time in contact, so the least hazardous of profiles
        that all end in a contact is often the fastest.
        """
        allowed = hazard < -math.log1p(-self.max_risk)
        longest = matched | (hazard == 0).all(1)
        score = torch.where(longest[:, None], driven, -driven)
        score = score.masked_fill(~allowed, -torch.inf)
        unsafe = driven.argmin(1) if self.brake_if_unsafe else hazard.argmin(1)
        return torch.where(allowed.any(1), score.argmax(1), unsafe)


def predict(
    world: World,
    speed_factors: Sequence[float],
    acceleration: float,
) -> Prediction:
    """The Prediction of the agents within INTERACTION_DISTANCE of the ego, NODES steps
    of PLAN_DT.

    A vehicle follows each matched route candidate (nearer than MATCH_DISTANCE, heading
    within MATCH_ANGLE), or its heading without a match; other agents keep their
    heading. Each agent is predicted at each speed factor times its speed, approached at
    `acceleration` m/s^2.
    """
    states = world.states
    routes = world.scene["route_points"]
    vehicles = world.scene["route_log"].shape[1]
    distance = (states[..., :2] - states[:, :1, :2]).norm(dim=-1)
    near = world.valid & (distance < INTERACTION_DISTANCE)
    near[:, 0] = False
    candidates = near[:, :vehicles, None] & world.scene["route_valid"]
    batch, agent, route = candidates.nonzero(as_tuple=True)
    on = matched(RoutePath(states[batch, agent], routes[batch, agent, route]))
    batch, agent, route = (index[on] for index in (batch, agent, route))
    straight = near.clone()
    straight[batch, agent] = False
    path = RoutePath(states[batch, agent], routes[batch, agent, route])
    rest_batch, rest_agent = straight.nonzero(as_tuple=True)
    batch = torch.cat([batch, rest_batch])
    agent = torch.cat([agent, rest_agent])
    followers = len(path.s)
    driven = ahead(
        states[batch, agent, 3],
        speed_factors,
        acceleration=acceleration,
    ).flatten(1)
    rest = straight_on(states[rest_batch, rest_agent], driven[followers:])
    poses = torch.cat([path.at(driven[:followers]), rest])
    count = len(speed_factors)
    return Prediction(
        poses.view(-1, NODES + 1, 3),
        world.scene["size"][batch, agent].repeat_interleave(count, 0),
        scene=batch.repeat_interleave(count),
    )


def matched(path: RoutePath) -> Tensor:
    """Bool [...]: the vehicle is on its route, near it and along it."""
    aligned = path.turned.abs() < torch.pi * MATCH_ANGLE / 180
    return (path.d.abs() < MATCH_DISTANCE) & aligned


def ahead(
    speed: Tensor,
    factors: Sequence[float],
    acceleration: float,
) -> Tensor:
    """Metres [J, F, NODES + 1] driven from speed [J] while it approaches each factor
    times speed."""
    start = speed[:, None, None]
    aims = start * speed.new_tensor(factors)[:, None]
    step = torch.arange(1, NODES + 1, device=speed.device, dtype=speed.dtype)
    change = acceleration * PLAN_DT * step
    slower = torch.maximum(aims, start - change)
    faster = torch.minimum(aims, start + change)
    future = torch.where(aims < start, slower, faster)
    return pad((future * PLAN_DT).cumsum(-1), (1, 0))


def straight_on(state: Tensor, distance: Tensor) -> Tensor:
    """Poses [J, K, 3] at distance [J, K] m along the heading of state [J, 4]."""
    heading = state[:, 2:3]
    direction = unit_vectors(heading)
    xy = state[:, None, :2] + direction * distance[..., None]
    return torch.cat([xy, heading[..., None].expand(*distance.shape, 1)], -1)
