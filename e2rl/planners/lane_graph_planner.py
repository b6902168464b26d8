"""The lane-graph planner of STRIVE (Rempe et al. 2022) on the mission route.

It samples speed profiles along the mission, predicts the other agents on their matched routes, and drives the
longest profile whose probability of collision is below `max_risk`. Vectorised over scenes, profiles, agents, routes.

Predicted trajectories of the other agents: every matched route at several speeds (STRIVE's planner).

Probability of collision of ego profiles with predicted traffic, by five-circle boxes (STRIVE's planner).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath, RoutePath, look_up
from e2rl.scenes.recording import DT
from e2rl.sim.world import World


@dataclass
class Prediction:
    """J predicted trajectories of all scenes: poses [J, T, 3] from now on, size [J, 2], scene [J] int64."""

    poses: Tensor
    size: Tensor
    scene: Tensor


def predict(
    world: World,
    steps: int,
    dt: float,
    speed_factors: tuple[float, ...],
    acceleration: float,
    reach: float,
    match_distance: float,
    match_angle: float,
    see_vrus: bool,
) -> Prediction:
    """Trajectories of `steps` steps of dt of the agents within `reach` m of the ego.

    A vehicle follows each matched route candidate (nearer than match_distance m, heading within match_angle degrees),
    or its heading without a match; other agents keep their heading (omitted without see_vrus). Each agent is predicted
    at each speed factor times its speed, approached at `acceleration` m/s^2.
    """
    states, vehicles = world.states, world.scene["route_log"].shape[1]
    near = (states[..., :2] - states[:, :1, :2]).norm(dim=-1) < reach
    seen = world.valid & near
    seen[:, 0] = False
    if not see_vrus:
        seen[:, vehicles:] = False
    batch, agent, candidate = (seen[:, :vehicles, None] & world.scene["route_valid"]).nonzero(as_tuple=True)
    path = RoutePath(states[batch, agent], world.scene["route_points"][batch, agent, candidate])
    on = (path.d.abs() < match_distance) & (path.turned.abs() < torch.pi * match_angle / 180)
    batch, agent, candidate = batch[on], agent[on], candidate[on]
    straight = seen.clone()
    straight[batch, agent] = False
    lost_batch, lost_agent = straight.nonzero(as_tuple=True)
    path = RoutePath(states[batch, agent], world.scene["route_points"][batch, agent, candidate])
    poses = torch.cat(
        [
            path.at(ahead(states[batch, agent, 3], steps, dt, speed_factors, acceleration).flatten(1)),
            straight_on(
                states[lost_batch, lost_agent],
                ahead(states[lost_batch, lost_agent, 3], steps, dt, speed_factors, acceleration).flatten(1),
            ),
        ]
    )
    batch, agent = torch.cat([batch, lost_batch]), torch.cat([agent, lost_agent])
    count = len(speed_factors)
    return Prediction(
        poses.view(-1, steps + 1, 3),
        world.scene["size"][batch, agent].repeat_interleave(count, 0),
        batch.repeat_interleave(count),
    )


def ahead(speed: Tensor, steps: int, dt: float, factors: tuple[float, ...], acceleration: float) -> Tensor:
    """Metres [J, F, steps + 1] driven from speed [J] while it approaches each factor times speed."""
    aims = speed[:, None, None] * speed.new_tensor(factors)[:, None]
    change = acceleration * dt * torch.arange(1, steps + 1, device=speed.device, dtype=speed.dtype)
    start = speed[:, None, None]
    future = torch.where(aims < start, torch.maximum(aims, start - change), torch.minimum(aims, start + change))
    return torch.nn.functional.pad((future * dt).cumsum(-1), (1, 0))


def straight_on(state: Tensor, distance: Tensor) -> Tensor:
    """Poses [J, K, 3] at distance [J, K] along the heading of state [J, 4]."""
    heading = state[:, 2:3]
    way = torch.stack([heading.cos(), heading.sin()], -1) * distance[..., None]
    return torch.cat([state[:, None, :2] + way, heading[..., None].expand(*distance.shape, 1)], -1)


CERTAIN = 1e-6  # 1 - p of a pair in contact: p = 1 would make all colliding profiles equal
CHUNK = 16384  # pairs of poses at a time, to fit the processor's cache
NEGLIGIBLE = 1e-4  # pairs with a smaller p are omitted


def collision_hazard(ego: Tensor, ego_size: Tensor, others: Prediction, slope: float, growth: float) -> Tensor:
    """-log(1 - P) [B, C] of profiles ego [B, C, T, 3]; ego_size [B, 2].

    P = 1 - prod over agents and times of (1 - p), p = 1 - tanh(d w_t) for the smallest distance d between the circles
    of the two boxes, w_t = slope + growth t (t = 0..T-1), and p = 1 where d < 0.
    """
    batch, count, times, _ = ego.shape
    weight = slope + growth * torch.arange(times, device=ego.device, dtype=ego.dtype)
    hazard = ego.new_zeros(batch * count)
    centre = ego[others.scene, :, :, :2].transpose(1, 2)  # [J, T, C, 2]
    apart = _squared(centre, others.poses[:, :, None, :2])
    reach = (ego_size[others.scene].norm(dim=-1) + others.size.norm(dim=-1))[:, None] / 2
    cut = reach + _distance_of(NEGLIGIBLE) / weight  # [J, T]
    other, time, profile = (apart < cut.square()[..., None]).nonzero(as_tuple=True)
    scene = others.scene[other]
    for part in torch.arange(len(other), device=ego.device).split(CHUNK):
        j, t, c, b = other[part], time[part], profile[part], scene[part]
        gap = circle_gap(ego[b, c, t], ego_size[b], others.poses[j, t], others.size[j])
        safe = torch.tanh(gap.clamp(min=0) * weight[t]).clamp(min=CERTAIN)
        hazard.index_add_(0, b * count + c, -safe.log())
    return hazard.view(batch, count)


def _squared(first: Tensor, second: Tensor) -> Tensor:
    """Squared distance [...] of points [..., 2]; per axis, as reducing a last axis of two is slow."""
    return (first[..., 0] - second[..., 0]).square() + (first[..., 1] - second[..., 1]).square()


def _distance_of(probability: float) -> float:
    """The d w at which 1 - tanh(d w) = `probability`."""
    return torch.atanh(torch.tensor(1 - probability, dtype=torch.float64)).item()


def circles(pose: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Centres [..., 5, 2] and radii [..., 5] of five circles in a box: one of radius width / 2 at the centre, four of
    radius width / 4 in the corners."""
    length, width = size.unbind(-1)
    along, across = (length - width) / 2 + width / 4, width / 4
    x = torch.stack([torch.zeros_like(along), along, along, -along, -along], -1)
    y = torch.stack([torch.zeros_like(across), across, -across, across, -across], -1)
    cos, sin = pose[..., 2:3].cos(), pose[..., 2:3].sin()
    centre = torch.stack([pose[..., 0:1] + cos * x - sin * y, pose[..., 1:2] + sin * x + cos * y], -1)
    return centre, torch.stack([width / 2, *[width / 4] * 4], -1)


def circle_gap(first: Tensor, first_size: Tensor, second: Tensor, second_size: Tensor) -> Tensor:
    """Smallest distance [...] m between the circles of two boxes; negative where circles overlap."""
    a, ra = circles(first, first_size)
    b, rb = circles(second, second_size)
    apart = _squared(a[..., :, None, :], b[..., None, :, :]).sqrt()
    return (apart - ra[..., :, None] - rb[..., None, :]).flatten(-2).amin(-1)


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
