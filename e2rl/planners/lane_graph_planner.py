"""The lane-graph planner of STRIVE (Rempe et al. 2022) on the mission route.

It samples speed profiles along the mission, predicts the other agents on every matched
route at several speeds, and drives the longest profile whose probability of collision
(of five-circle boxes) is below `max_risk`. Vectorised over scenes, profiles, agents and
routes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath, RoutePath, look_up
from e2rl.run.fused import fused
from e2rl.run.settings import configured, setting
from e2rl.scenes.recording import DT
from e2rl.sim.world import World

PLAN_DT = 0.2  # s between nodes of a profile
HALVES = (12, 13)  # nodes towards the first and the second speed target: 5 s in all
EARLIER = 0.01  # weight of the mean distance: breaks ties of profiles that halt at one point in favour of the earliest
INTERACTION_DISTANCE = 70.0  # m from the ego, others farther away are not looked at
MATCH_DISTANCE, MATCH_ANGLE = (
    2.0,
    20.0,
)  # m, degrees between a vehicle and a route that it is on


@dataclass
class Prediction:
    """J predicted trajectories of all scenes: poses [J, T, 3] from now on, size [J, 2],
    scene [J] int64."""

    poses: Tensor
    size: Tensor
    scene: Tensor


def predict(
    world: World, speed_factors: Sequence[float], acceleration: float
) -> Prediction:
    """The Prediction of the agents within INTERACTION_DISTANCE of the ego, sum(HALVES)
    steps of PLAN_DT.

    A vehicle follows each matched route candidate (nearer than MATCH_DISTANCE, heading
    within MATCH_ANGLE), or its heading without a match; other agents keep their
    heading. Each agent is predicted at each speed factor times its speed, approached at
    `acceleration` m/s^2.
    """
    states = world.states
    vehicles = world.scene["route_log"].shape[1]
    seen = world.valid & (
        (states[..., :2] - states[:, :1, :2]).norm(dim=-1) < INTERACTION_DISTANCE
    )
    seen[:, 0] = False
    batch, agent, candidate = (
        seen[:, :vehicles, None] & world.scene["route_valid"]
    ).nonzero(as_tuple=True)
    on = matched(
        RoutePath(
            states[batch, agent], world.scene["route_points"][batch, agent, candidate]
        )
    )
    batch = batch[on]
    agent = agent[on]
    candidate = candidate[on]
    straight = seen.clone()
    straight[batch, agent] = False
    rest_batch, rest_agent = straight.nonzero(as_tuple=True)
    path = RoutePath(
        states[batch, agent], world.scene["route_points"][batch, agent, candidate]
    )
    rest = states[rest_batch, rest_agent]
    on_route = path.at(
        ahead(
            states[batch, agent, 3], speed_factors, acceleration=acceleration
        ).flatten(1)
    )
    poses = torch.cat(
        [
            on_route,
            straight_on(
                rest,
                ahead(rest[:, 3], speed_factors, acceleration=acceleration).flatten(1),
            ),
        ]
    )
    batch = torch.cat([batch, rest_batch])
    agent = torch.cat([agent, rest_agent])
    count = len(speed_factors)
    size = world.scene["size"][batch, agent].repeat_interleave(count, 0)
    return Prediction(
        poses.view(-1, sum(HALVES) + 1, 3), size, scene=batch.repeat_interleave(count)
    )


def matched(path: RoutePath) -> Tensor:
    """Bool [...]: the vehicle is on its route, near it and along it."""
    return (path.d.abs() < MATCH_DISTANCE) & (
        path.turned.abs() < torch.pi * MATCH_ANGLE / 180
    )


def ahead(speed: Tensor, factors: Sequence[float], acceleration: float) -> Tensor:
    """Metres [J, F, sum(HALVES) + 1] driven from speed [J] while it approaches each
    factor times speed."""
    steps = sum(HALVES)
    aims = speed[:, None, None] * speed.new_tensor(factors)[:, None]
    change = (
        acceleration
        * PLAN_DT
        * torch.arange(1, steps + 1, device=speed.device, dtype=speed.dtype)
    )
    start = speed[:, None, None]
    future = torch.where(
        aims < start,
        torch.maximum(aims, start - change),
        torch.minimum(aims, start + change),
    )
    return torch.nn.functional.pad((future * PLAN_DT).cumsum(-1), (1, 0))


def straight_on(state: Tensor, distance: Tensor) -> Tensor:
    """Poses [J, K, 3] at distance [J, K] m along the heading of state [J, 4]."""
    heading = state[:, 2:3]
    moved = torch.stack([heading.cos(), heading.sin()], -1) * distance[..., None]
    return torch.cat(
        [state[:, None, :2] + moved, heading[..., None].expand(*distance.shape, 1)], -1
    )


CERTAIN = (
    1e-6  # 1 - p of a pair in contact: p = 1 would make all colliding profiles equal
)
CHUNK = 16384  # pairs of poses at a time, to fit the processor's cache
NEGLIGIBLE = 1e-4  # pairs with a smaller p are omitted


def collision_hazard(
    ego: Tensor, ego_size: Tensor, others: Prediction, slope: float, growth: float
) -> Tensor:
    """-log(1 - P) [B, C] of profiles ego [B, C, T, 3]; ego_size [B, 2].

    P = 1 - prod over agents and times of (1 - p), p = 1 - tanh(d w_t) for the smallest
    distance d between the circles of the two boxes, w_t = slope + growth t (t =
    0..T-1), and p = 1 where d < 0.
    """
    batch, count, times, _ = ego.shape
    weight = slope + growth * torch.arange(times, device=ego.device, dtype=ego.dtype)
    reach = (ego_size[others.scene].norm(dim=-1) + others.size.norm(dim=-1))[
        :, None
    ] / 2
    cut = reach + math.atanh(1 - NEGLIGIBLE) / weight  # [J, T]
    centre = ego[..., :2]
    at = others.poses[..., :2]
    low, high = (
        bound(1)[others.scene] for bound in (centre.amin, centre.amax)
    )  # [J, T, 2], of all profiles
    beside = torch.maximum(low - at, at - high).clamp(min=0)
    j, t = (_squared(beside, torch.zeros_like(beside)) < cut.square()).nonzero(
        as_tuple=True
    )
    near = profiles_near(ego, others.poses, cut, j, t, others.scene[j])
    pair, profile = near.nonzero(as_tuple=True)
    pairs = torch.stack([j[pair], t[pair], profile, others.scene[j[pair]]])
    hazard = ego.new_zeros(batch * count)
    poses = ego.flatten(0, 2)
    other_poses = others.poses.flatten(0, 1)
    for j, t, c, b in pairs.split(CHUNK, 1):
        row = b * count + c
        mine = poses.index_select(0, row * times + t)
        its = other_poses.index_select(0, j * times + t)
        sizes = ego_size.index_select(0, b), others.size.index_select(0, j)
        hazard.index_add_(
            0, row, hazard_of(mine, sizes[0], its, sizes[1], weight.index_select(0, t))
        )
    return hazard.view(batch, count)


@fused("B C T 3!", "J T 3!", "J T", "S:int64", "S:int64", "S:int64")
def profiles_near(
    ego: Tensor, other: Tensor, cut: Tensor, j: Tensor, t: Tensor, b: Tensor
) -> Tensor:
    """1 where profiles [S, C] of scenes b are within the cut of others j at times t,
    else 0."""
    apart = _squared(ego[..., :2][b, :, t], other[..., :2][j, t][:, None])
    return torch.where(apart < cut[j, t].square()[:, None], 1.0, 0.0)


@fused("Q 3", "Q 2", "Q 3", "Q 2", "Q")
def hazard_of(
    ego: Tensor, ego_size: Tensor, other: Tensor, size: Tensor, weight: Tensor
) -> Tensor:
    """-log(1 - p) [Q] of pairs of boxes."""
    gap = circle_gap(ego, ego_size, second=other, second_size=size)
    return -torch.tanh(gap.clamp(min=0) * weight).clamp(min=CERTAIN).log()


def _squared(first: Tensor, second: Tensor) -> Tensor:
    """Squared distance [...] of points [..., 2]; per axis, as reducing a last axis of
    two is slow."""
    return (first[..., 0] - second[..., 0]).square() + (
        first[..., 1] - second[..., 1]
    ).square()


def circles(pose: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and radii [5, ...] of five circles in a box: one of radius width / 2 at the
    centre, four of radius width / 4 in the corners."""
    length, width = (value.expand(pose.shape[:-1]) for value in size.unbind(-1))
    along = (length - width) / 2 + width / 4
    across = width / 4
    x = torch.stack([torch.zeros_like(along), along, along, -along, -along])
    y = torch.stack([torch.zeros_like(across), across, -across, across, -across])
    cos = pose[..., 2].cos()
    sin = pose[..., 2].sin()
    radius = torch.stack([width / 2, *[width / 4] * 4])
    return pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y, radius


def circle_gap(
    first: Tensor, first_size: Tensor, second: Tensor, second_size: Tensor
) -> Tensor:
    """Smallest distance [...] m between the circles of two boxes; negative where
    circles overlap."""
    first, second = torch.broadcast_tensors(first[..., :3], second[..., :3])
    (ax, ay, ra), (bx, by, rb) = (
        circles(first, first_size),
        circles(second, second_size),
    )
    apart = ((ax[:, None] - bx).square() + (ay[:, None] - by).square()).sqrt()
    return (apart - ra[:, None] - rb).flatten(0, 1).amin(0)


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
        driven = torch.nn.functional.pad(
            ((speed[..., 1:] + speed[..., :-1]) / 2 * PLAN_DT).cumsum(-1), (1, 0)
        )
        poses = path.at(path.ahead(driven.transpose(0, 1))).transpose(0, 1)
        others = predict(
            world,
            self.predicted_speeds,
            acceleration=self.predicted_acceleration * self.max_acceleration,
        )
        hazard = collision_hazard(
            poses,
            world.scene["size"][:, 0],
            others=others,
            slope=self.risk_slope,
            growth=self.risk_growth,
        )
        distance = driven[..., -1] + EARLIER * driven.mean(-1)
        best = self.choose(hazard, distance, matched=matched(path))
        chosen = speed[torch.arange(len(best), device=best.device), best]
        return path.drive(upsample(chosen))

    def profiles(self, world: World, path: MissionPath) -> Tensor:
        """Speeds [B, C, 26] every PLAN_DT s of the C = speeds^2 profiles.

        Each half of the horizon has a target speed, evenly spaced over the range that
        max_acceleration reaches from the speed at its start. The path's speed caps
        apply as far as braking at max_acceleration attains them.
        """
        first, second = HALVES
        start = world.states[:, 0, 3]
        slope = self.max_acceleration * PLAN_DT
        caps = path.speed_caps(self.max_speed)
        top = caps.amax(1).clamp(min=0).sqrt()
        one = approach(
            start[:, None],
            targets(start, top, reach=first * slope, count=self.speeds),
            slope=slope,
            steps=first,
        )
        begin = one[..., -1]
        aims = targets(begin, top[:, None], reach=second * slope, count=self.speeds)
        two = approach(begin[..., None], aims, slope=slope, steps=second)
        one = one[:, :, None].expand(-1, -1, self.speeds, -1)
        wanted = torch.cat(
            [start[:, None, None, None].expand(*one.shape[:3], 1), one, two], -1
        ).flatten(1, 2)
        return capped(wanted, caps, slope=slope)

    def choose(self, hazard: Tensor, driven: Tensor, matched: Tensor) -> Tensor:
        """Profile [B] by hazard [B, C] = -log(1 - probability of collision) and
        distance [B, C]: the longest below max_risk (the shortest for an ego off its
        route with agents around), if none the least hazardous, or with
        `brake_if_unsafe` the shortest.

        The hazard adds up over the time in contact, so the least hazardous of profiles
        that all end in a contact is often the fastest.
        """
        allowed = hazard < -math.log1p(-self.max_risk)
        longest = matched | (hazard == 0).all(1)
        score = torch.where(longest[:, None], driven, -driven).masked_fill(
            ~allowed, -torch.inf
        )
        unsafe = driven.argmin(1) if self.brake_if_unsafe else hazard.argmin(1)
        return torch.where(allowed.any(1), score.argmax(1), unsafe)


def targets(start: Tensor, top: Tensor, reach: float, count: int) -> Tensor:
    """Target speeds [..., count], evenly from max(0, start - reach) to min(top, start +
    reach); start, top [...]."""
    low = (start - reach).clamp(min=0)
    high = torch.minimum(top, start + reach)
    fraction = torch.linspace(0, 1, count, device=start.device, dtype=start.dtype)
    return low[..., None] + fraction * (high - low)[..., None]


def approach(start: Tensor, aims: Tensor, slope: float, steps: int) -> Tensor:
    """Speeds [..., steps] moving from start [...] to aims [...] by at most `slope` a
    step, then holding."""
    moved = slope * torch.arange(1, steps + 1, device=start.device, dtype=start.dtype)
    change = aims - start
    return start[..., None] + change.sign()[..., None] * torch.minimum(
        change.abs()[..., None], moved
    )


def capped(wanted: Tensor, caps: Tensor, slope: float) -> Tensor:
    """Speeds [B, C, 26] that follow wanted [B, C, 26] under the squared caps [B, K] of
    the path, braking by at most `slope` a node.

    The caps depend on the distance driven so far, so this loops over the 26 nodes, for
    all profiles at once.
    """
    speed = wanted[..., 0]
    speeds = [speed]
    driven = torch.zeros_like(speed)
    for node in wanted.unbind(-1)[1:]:
        allowed = look_up(caps, driven + speed * PLAN_DT)
        after = torch.minimum(
            node, torch.maximum(allowed, (speed - slope).clamp(min=0))
        )
        driven = driven + (speed + after) / 2 * PLAN_DT
        speed = after
        speeds.append(speed)
    return torch.stack(speeds, -1)


def upsample(speed: Tensor) -> Tensor:
    """Speeds [..., PLAN_STEPS + 1] every DT, linear between nodes [..., 26] every
    PLAN_DT."""
    tick = torch.arange(PLAN_STEPS + 1, device=speed.device) * (DT / PLAN_DT)
    low = tick.floor().long().clamp(max=speed.shape[-1] - 2)
    fraction = tick - low
    return speed[..., low] * (1 - fraction) + speed[..., low + 1] * fraction
