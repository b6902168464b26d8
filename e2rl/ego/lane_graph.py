"""The lane-graph planner of STRIVE (Rempe et al. 2022) on the mission route.

It samples speed profiles along the mission, predicts the other agents on their matched routes, and drives the
longest profile whose probability of collision is below `max_risk`. Vectorised over scenes, profiles, agents, routes.
"""

import math

import torch
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS, Ego
from e2rl.ego.path import MissionPath, look_up
from e2rl.ego.prediction import Prediction, predict
from e2rl.ego.risk import collision_hazard
from e2rl.scene.recording import DT
from e2rl.sim.world import World

PLAN_DT = 0.2  # s between nodes of a profile
HALVES = (12, 13)  # nodes towards the first and the second speed target: 5 s in all
EARLIER = 0.01  # weight of the mean distance: breaks ties of profiles that halt at one point in favour of the earliest


class LaneGraphEgo(Ego):
    """STRIVE's planner on our routes; differences: the ego takes its mission instead of the first branch of its lane,
    obeys curve speeds, known limits and lights (its speeds are capped by them), and its plan is drivable by a car."""

    def __init__(
        self,
        max_speed: float = 20.0,
        max_acceleration: float = 4.0,
        speeds: int = 5,
        max_risk: float = 0.1,
        risk_slope: float = 0.3,
        risk_growth: float = 0.02,
        interaction_distance: float = 70.0,
        predicted_speeds: tuple[float, ...] = (0.5, 1.0),
        predicted_acceleration: float = 0.5,
        match_distance: float = 2.0,
        match_angle: float = 20.0,
        lateral_acceleration: float = 3.0,
        braking: float = 3.0,
        use_limits: bool = True,
        obey_lights: bool = True,
        see_vrus: bool = True,
        brake_if_unsafe: bool = False,
        replan_every: int = 5,
    ) -> None:
        """Fields: conf/ego/lane_graph.yaml."""
        super().__init__(replan_every)
        self.max_speed, self.max_acceleration, self.speeds = max_speed, max_acceleration, int(speeds)
        self.max_risk, self.risk_slope, self.risk_growth = max_risk, risk_slope, risk_growth
        self.interaction_distance = interaction_distance
        self.predicted_speeds, self.predicted_acceleration = tuple(predicted_speeds), predicted_acceleration
        self.match_distance, self.match_angle = match_distance, match_angle
        self.lateral_acceleration, self.braking = lateral_acceleration, braking
        self.use_limits, self.obey_lights, self.see_vrus = use_limits, obey_lights, see_vrus
        self.brake_if_unsafe = brake_if_unsafe

    def plan(self, world: World) -> Tensor:
        """The chosen profile as states [B, PLAN_STEPS, 4]."""
        path = MissionPath(world)
        speed = self.profiles(world, path)
        driven = torch.nn.functional.pad(((speed[..., 1:] + speed[..., :-1]) / 2 * PLAN_DT).cumsum(-1), (1, 0))
        poses = path.at(path.ahead(driven.transpose(0, 1))).transpose(0, 1)
        hazard = collision_hazard(
            poses, world.scene["size"][:, 0], self.predict(world), self.risk_slope, self.risk_growth
        )
        way = driven[..., -1] + EARLIER * driven.mean(-1)
        best = self.choose(hazard, way, self.matched(path))
        chosen = speed[torch.arange(len(best), device=best.device), best]
        return path.drive(upsample(chosen))

    def profiles(self, world: World, path: MissionPath) -> Tensor:
        """Speeds [B, C, 26] every PLAN_DT s of the C = speeds^2 profiles.

        Each half of the horizon has a target speed, evenly spaced over the range that max_acceleration reaches from the
        speed at its start. The path's speed caps apply as far as braking at max_acceleration attains them.
        """
        first, second = HALVES
        start, slope = world.states[:, 0, 3], self.max_acceleration * PLAN_DT
        caps = path.speed_caps(
            self.max_speed, self.lateral_acceleration, self.braking, self.use_limits, self.obey_lights
        )
        top = caps.amax(1).clamp(min=0).sqrt()
        one = approach(start[:, None], targets(start, top, first * slope, self.speeds), slope, first)
        begin = one[..., -1]
        aims = targets(begin, top[:, None], second * slope, self.speeds)
        two = approach(begin[..., None], aims, slope, second)
        one = one[:, :, None].expand(-1, -1, self.speeds, -1)
        wanted = torch.cat([start[:, None, None, None].expand(*one.shape[:3], 1), one, two], -1).flatten(1, 2)
        return capped(wanted, caps, slope)

    def predict(self, world: World) -> Prediction:
        """Agents within interaction_distance, on every matched route at every predicted speed."""
        return predict(
            world,
            sum(HALVES),
            PLAN_DT,
            self.predicted_speeds,
            self.predicted_acceleration * self.max_acceleration,
            self.interaction_distance,
            self.match_distance,
            self.match_angle,
            self.see_vrus,
        )

    def matched(self, path: MissionPath) -> Tensor:
        """Bool [B]: the ego is on its mission route, near it and along it."""
        return (path.d.abs() < self.match_distance) & (path.turned.abs() < torch.pi * self.match_angle / 180)

    def choose(self, hazard: Tensor, driven: Tensor, matched: Tensor) -> Tensor:
        """Profile [B] by hazard [B, C] = -log(1 - probability of collision) and distance [B, C]: the longest below
        max_risk (the shortest for an ego off its route with agents around), if none the least hazardous, or with
        `brake_if_unsafe` the shortest.

        The hazard adds up over the time in contact, so the least hazardous of profiles that all end in a contact is
        often the fastest.
        """
        allowed = hazard < -math.log1p(-self.max_risk)
        longest = matched | (hazard == 0).all(1)
        score = torch.where(longest[:, None], driven, -driven).masked_fill(~allowed, -torch.inf)
        unsafe = driven.argmin(1) if self.brake_if_unsafe else hazard.argmin(1)
        return torch.where(allowed.any(1), score.argmax(1), unsafe)


def targets(start: Tensor, top: Tensor, reach: float, count: int) -> Tensor:
    """Target speeds [..., count], evenly from max(0, start - reach) to min(top, start + reach); start, top [...]."""
    low, high = (start - reach).clamp(min=0), torch.minimum(top, start + reach)
    share = torch.linspace(0, 1, count, device=start.device, dtype=start.dtype)
    return low[..., None] + share * (high - low)[..., None]


def approach(start: Tensor, aims: Tensor, slope: float, steps: int) -> Tensor:
    """Speeds [..., steps] moving from start [...] to aims [...] by at most `slope` a step, then holding."""
    moved = slope * torch.arange(1, steps + 1, device=start.device, dtype=start.dtype)
    change = aims - start
    return start[..., None] + change.sign()[..., None] * torch.minimum(change.abs()[..., None], moved)


def capped(wanted: Tensor, caps: Tensor, slope: float) -> Tensor:
    """Speeds [B, C, 26] that follow wanted [B, C, 26] under the squared caps [B, K] of the path, braking by at most
    `slope` a node.

    The caps depend on the distance driven so far, so this loops over the 26 nodes, for all profiles at once.
    """
    speed = wanted[..., 0]
    speeds, driven = [speed], torch.zeros_like(speed)
    for node in wanted.unbind(-1)[1:]:
        allowed = look_up(caps, driven + speed * PLAN_DT)
        after = torch.minimum(node, torch.maximum(allowed, (speed - slope).clamp(min=0)))
        driven = driven + (speed + after) / 2 * PLAN_DT
        speed = after
        speeds.append(speed)
    return torch.stack(speeds, -1)


def upsample(speed: Tensor) -> Tensor:
    """Speeds [..., PLAN_STEPS + 1] every DT, linear between nodes [..., 26] every PLAN_DT."""
    tick = torch.arange(PLAN_STEPS + 1, device=speed.device) * (DT / PLAN_DT)
    low = tick.floor().long().clamp(max=speed.shape[-1] - 2)
    share = tick - low
    return speed[..., low] * (1 - share) + speed[..., low + 1] * share
