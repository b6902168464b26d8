"""Importance kernels (docs/method.md, section 9): plans in the prior's own coordinates
that the attack may be drawn to.

A kernel shifts one vehicle's plan away from the prior's mean: another acceleration,
another place across the lane. Each costs about delta^T C^-1 delta / 2 nats, C the
covariance of the prior's samples, and is worth what `foresee` makes of it. Those worth
the most, less what they cost, become joint samples; of these the best is driven. What a
kernel moved is booked as path KL, step by step, and the choice among samples as a code
length (`choice_nats`).
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import (
    BEND_SCALE,
    HORIZON,
    KNOTS,
    OFFSET_SCALE,
    SIZE,
    LaneState,
)
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.fused import fused
from e2rl.run.settings import configured, setting
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.lane_graph import against_lanes, packed
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate, project
from e2rl.sim.world import World
from e2rl.traffic.e2.anchoring import Anchor
from e2rl.traffic.e2.foresight import Foresight, foresee
from e2rl.traffic.motion import smallest

# Standard deviations of x over 12 samples of a Waymo prior (48 scenes, DPM-Solver++),
# and the correlation of knots that are neighbours. They set how a pull is spread over x
# and over the noise levels; what it costs is booked exactly.
SPREAD = (0.85, 0.53, 0.51, 0.51, 0.52, 0.54, 0.57, 0.60, 0.63, 0.71, 1.02, 0.89)
CORRELATION = 0.57
ACCELERATIONS = (
    -3.0,
    -2.0,
    -1.2,
    -0.6,
    0.0,
    0.6,
    1.2,
    2.0,
)  # m/s^2, from the prior's mean
ONSET = (
    0.4,
    0.8,
)  # of such an acceleration at the first knots: a jump is what drivers do not do
OFFSETS = (
    0.8,
    1.6,
    2.5,
    3.5,
    4.5,
)  # m, to either side of it, after the lateral horizon
EARLY = 0.5  # of the way across that half of the kernels have come sooner, at half of the horizon
REACH, ASIDE, NEAREST = (
    60.0,
    10.0,
    10,
)  # m from the ego, m from its way, of vehicles that have kernels; how many
STIRS = 1.0  # m/s that such a vehicle reaches within its expected plan
MAX_LATERAL = 4.0  # m/s^2
APART = 6.0  # nats between two kernels of a vehicle that are drawn
BUMP = 2.2  # m between centres, nearer than which a plan touches somebody else
DRAWN = 0.1  # weight of all drawn samples of a scene together in the price of a choice; the plain one has the rest
CHECKED = 12  # plans of a vehicle that are looked at for driving against the lanes


@configured("synthesizer/e2", "kernels")
@dataclass(frozen=True)
class KernelSettings:
    """Settings of the kernels; conf/synthesizer/e2.yaml explains each."""

    samples: int = setting(low=1)
    gain: float = setting(low=0)
    pull: float = setting(low=0)


@dataclass(frozen=True)
class Kernels:
    """Goals x [B, N, SIZE] of N kernels, best first, and the vehicle [B, N] that each
    moves, -1 for none; of so many vehicles."""

    goal: Tensor
    vehicle: Tensor
    vehicles: int


@cache
def covariance(device: torch.device) -> Tensor:
    """C [SIZE, SIZE]: knots are correlated like an AR(1) sequence, lateral knots with
    nothing."""
    std = torch.tensor(SPREAD, device=device)
    lag = torch.arange(SIZE, device=device)
    decay = CORRELATION ** (lag[:, None] - lag).abs()
    knots = (lag < KNOTS)[:, None] & (lag < KNOTS)
    return std[:, None] * torch.where(knots | (lag[:, None] == lag), decay, 0.0) * std


@cache
def _axes(device: torch.device) -> tuple[Tensor, Tensor]:
    values, vectors = torch.linalg.eigh(covariance(device))
    return values, vectors


@cache
def shifts(device: torch.device) -> Tensor:
    """The kernels' displacements [O, SIZE] of x; the first is none."""
    sides = [
        (0.0, 0.0),
        *(
            (sign * side, early)
            for side in OFFSETS
            for sign in (1, -1)
            for early in (0.0, EARLY)
        ),
    ]
    moves = torch.tensor(
        [(a, *side) for side in sides for a in sorted(ACCELERATIONS, key=abs)],
        device=device,
    )
    bend = moves[:, 1:2] * moves[:, 2:] / (2 * BEND_SCALE)
    ramp = torch.tensor(ONSET, device=device)
    ramp = torch.nn.functional.pad(ramp, (0, KNOTS - len(ramp)), value=1.0)
    return torch.cat([moves[:, :1] * ramp, bend, moves[:, 1:2] / OFFSET_SCALE], 1)


def nats(shift: Tensor) -> Tensor:
    """What displacements [..., SIZE] of x cost, delta^T C^-1 delta / 2 [...]."""
    values, vectors = _axes(shift.device)
    return ((shift @ vectors).square() / values).sum(-1) / 2


def pulled(
    x0: Tensor, goal: Tensor, strength: Tensor, level: Tensor, schedule: NoiseSchedule
) -> Tensor:
    """Clean estimates x0 [..., SIZE] at a noise level under the potential strength (x -
    goal)^T C^-1 (x - goal) / 2.

    Where the prior's law is a Gaussian of covariance C this is the exact posterior
    mean: with P = (C^-1 + alpha^2 / sigma^2)^-1, x0 + P (P + C / strength)^-1 (goal -
    x0). strength 0 is the prior.
    """
    values, vectors = _axes(x0.device)
    ratio = (schedule.alpha(level) / schedule.sigma(level)) ** 2
    weight = strength / (strength + 1 + values * ratio)
    return x0 + ((goal - x0) @ vectors * weight) @ vectors.T


def sideways(
    anchor: Anchor, world: World, lane: LaneState, route: Tensor, off_lane: Tensor
) -> Tensor:
    """Nats [B, V] of the interceptions off_lane [B, V] of an anchor: of the two lateral
    knots that fit them on the lanes that they leave, candidates route [B, V], under
    N(0, C). lane [B, V]: the present states, on whatever they follow.

    An estimate, not a bound: the prior's law beside a lane is not known, only around
    it.
    """
    at = off_lane.nonzero(as_tuple=True)
    points = world.scene["route_points"][(*at, route.clamp(min=0)[at])]
    path = anchor.off_lane_path[at]
    nats = lateral_nats(
        world.states[at],
        lane.map(lambda value: value[at]),
        points,
        path,
        anchor.knots[at],
    )
    return torch.zeros_like(lane.s).index_put(at, nats)


@fused("Q 4", "Q", "Q P 2!", "Q P 2!", f"Q {KNOTS}")
def lateral_nats(
    states: Tensor, lane: LaneState, points: Tensor, path: Tensor, knots: Tensor
) -> Tensor:
    """`sideways` [Q] of vehicles that leave lanes points [Q, P, 2] for a path [Q, P,
    2]."""
    now = lane_relative.locate(
        states, lane.a, yaw_rate=lane.kappa * lane.v, points=points
    )
    speed, travelled = lane_relative.speeds(now, knots)
    start = project(states[:, None, :2], path)[0]
    xy, heading, _ = interpolate(path, start + travelled)
    s, d, _ = project(xy, points, hint=now.s[..., None] + travelled)
    track = LaneState.from_states(
        torch.cat([xy, heading[..., None], speed[..., None]], -1), s, d=d
    )
    x = lane_relative.fit(track, None, state=now)[0]
    variance = torch.tensor(SPREAD[KNOTS:], device=x.device).square()
    return (x[..., KNOTS:].square() / (2 * variance)).sum(-1)


@dataclass(frozen=True)
class KernelAttack:
    """G vehicles whose plans are valued: scene row [G] and vehicle [G] int64; world:
    the B scenes now; ego_plan [B, H, 4]: the ego's expected states; plan [B, V, H, 4]:
    everybody's; since, settled [G]: see `foresee`."""

    row: Tensor
    vehicle: Tensor
    world: World
    ego_plan: Tensor
    plan: Tensor
    since: Tensor
    settled: Tensor

    @classmethod
    def of(
        cls,
        world: World,
        active: Tensor,
        ego_plan: Tensor,
        plan: Tensor,
        since: Tensor,
        settled: Tensor,
    ) -> "KernelAttack":
        """Of the NEAREST active [B, V] vehicles that move, within REACH of the ego and
        ASIDE of its path."""
        gap = (world.states[:, : active.shape[1], :2] - world.states[:, :1, :2]).norm(
            dim=-1
        )
        way = ego_plan[:, None, 4::5, :2]
        points = plan[..., 4::5, :2]
        aside = (
            torch.cdist(points, way.expand(*points.shape[:2], -1, -1))
            .flatten(2)
            .amin(-1)
        )
        near = (
            active & (gap < REACH) & (aside < ASIDE) & (plan[..., 3].amax(-1) > STIRS)
        )
        row, vehicle = smallest(near, gap, count=NEAREST).nonzero(as_tuple=True)
        return cls(
            row,
            vehicle,
            world,
            ego_plan,
            plan,
            since[row, vehicle],
            settled[row, vehicle],
        )

    def foresight(self, tracks: Tensor, rows: Tensor | None = None) -> Foresight:
        """Of plans [G, O, H, 4]; rows [C]: of those of the vehicles whose they are."""
        row, vehicle, since, settled = (
            value if rows is None else value[rows]
            for value in (self.row, self.vehicle, self.since, self.settled)
        )
        size = self.world.scene["size"]
        states = self.world.states
        now = states[row, vehicle, None, None].expand(*tracks.shape[:2], 1, 4)
        path = torch.cat([states[:, :1], self.ego_plan[:, :HORIZON]], 1)[row]
        return foresee(
            path,
            size[row, 0],
            tracks=torch.cat([now, tracks], 2),
            sizes=size[row, vehicle],
            since=since,
            settled=settled,
        )

    def impossible(self, tracks: Tensor, lateral: Tensor, time: Tensor) -> Tensor:
        """Bool [G, O]: plans [G, O, H, 4] that leave the road, turn too sharply
        (lateral [G, O] m/s^2) or touch others before they meet the ego at `time` [G,
        O]."""
        field = self.world.scene["field"], self.world.scene["field_origin"]
        points = tracks[..., 4::5, :2]  # [G, O, 10, 2]
        beyond = (
            off_road(points.flatten(1, 2), *field, self.row)
            .view(points.shape[:-1])
            .amax(-1)
        )
        now = self.world.states[self.row, self.vehicle, :2]
        allowed = off_road(now[:, None], *field, self.row).clamp(min=-0.3)
        gap = torch.cdist(
            points.transpose(1, 2), self.plan[self.row, :, 4::5, :2].transpose(1, 2)
        )  # [G, 10, O, V]
        counts = self.world.valid[self.row, : gap.shape[-1]].clone()
        counts[:, 0] = counts[torch.arange(len(self.row)), self.vehicle] = False
        nearest = gap.masked_fill(~counts[:, None, None], torch.inf).amin(-1)
        moment = (
            5 * DT * torch.arange(1, nearest.shape[1] + 1, device=gap.device)[:, None]
        )
        bumps = (
            (nearest < BUMP)
            & (moment <= time[:, None].clamp(max=HORIZON * DT) + 5 * DT)
        ).any(1)
        return (beyond > allowed) | (lateral > MAX_LATERAL) | bumps

    def against(self, tracks: Tensor, time: Tensor, plans: Tensor) -> Tensor:
        """Bool [G, K]: plans [G, K] of tracks [G, O, H, 4] that meet the ego, or half a
        second before, against the lanes."""
        at = (time.clamp(max=HORIZON * DT) / DT).long().clamp(1, HORIZON).gather(
            1, plans
        ) - 1
        tracks = tracks.gather(
            1, plans[..., None, None].expand(*plans.shape, *tracks.shape[2:])
        )
        at = torch.stack([(at - 5).clamp(min=0), at], -1)
        pose = tracks.gather(2, at[..., None].expand(*at.shape, 4)).flatten(1, 2)
        scene, of = self.row.unique(return_inverse=True)
        own = of == torch.arange(len(scene), device=of.device)[:, None]  # [S, G]
        place, there = packed(own)
        place = torch.where(there, place, place[:, :1])
        every = pose[place].flatten(1, 2)
        points = self.world.scene["lane_points"][scene]
        line = self.world.scene["lane_index"][scene]
        found = against_lanes(
            points, line, xy=every[..., :2], heading=every[..., 2, None]
        ).view(*place.shape, -1)
        wrong = torch.zeros(pose.shape[:2], dtype=torch.bool, device=pose.device)
        wrong[place[there]] = found[there]
        return wrong.view(at.shape).any(-1)


def propose_kernels(
    attack: KernelAttack,
    lane: LaneState,
    points: Tensor,
    mean: Tensor,
    gain: Tensor,
    count: int,
) -> Kernels:
    """The `count` kernels of highest value: gain [B] nats times their worth, less what
    they cost.

    lane: states [B, V] on routes points [B, V, P, 2]; mean [B, V, SIZE]: the prior's.
    Those that gain nothing are none.
    """
    table = shifts(mean.device)
    at = (attack.row, attack.vehicle)
    if not len(attack.row):
        nobody = gain.new_full((len(mean), count), -1, dtype=torch.int64)
        return Kernels(
            mean.new_zeros(len(mean), count, SIZE), nobody, vehicles=mean.shape[1]
        )
    x = mean[at][:, None] + table
    start = lane.map(lambda value: value[at][:, None].expand(x.shape[:2]))
    motion = lane_relative.decode_options(x, start, points[at])
    tracks = motion.states()
    seen = attack.foresight(tracks)
    lateral = (motion.v**2 * motion.kappa.abs()).amax(-1)
    value = gain[attack.row, None] * seen.worth - nats(table)
    value = value.masked_fill(attack.impossible(tracks, lateral, seen.time), -torch.inf)
    best = value.topk(min(CHECKED, value.shape[-1]), -1)
    lawful = best.values.masked_fill(
        attack.against(tracks, seen.time, best.indices), -torch.inf
    )
    value = torch.full_like(value, -torch.inf).scatter(1, best.indices, lawful)
    of_scene = mean.new_full((*mean.shape[:2], len(table)), -torch.inf).index_put(
        at, value
    )  # [B, V, O]
    goals = []
    vehicles = []
    row = torch.arange(len(mean), device=mean.device)
    for _ in range(count):
        top, pick = of_scene.flatten(1).max(1)
        vehicle = pick // len(table)
        option = pick % len(table)
        goals.append(mean[row, vehicle] + table[option])
        vehicles.append(torch.where(top > 0, vehicle, -1))
        alike = nats(table - table[option][:, None]) < APART  # [B, O]
        mine = torch.nn.functional.one_hot(vehicle, mean.shape[1]).bool()
        of_scene = of_scene.masked_fill(mine[..., None] & alike[:, None], -torch.inf)
    return Kernels(
        torch.stack(goals, 1), torch.stack(vehicles, 1), vehicles=mean.shape[1]
    )


def tries(kernels: Kernels, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The joint samples of a replan: one plain one of each of B scenes, then one for
    each kernel of scenes rows [R].

    Returns:
        scenes [C] int64, goals [C, V, SIZE] and who is drawn [C, V] bool.
    """
    batch, count, _ = kernels.goal.shape
    first = torch.arange(batch, device=rows.device)
    scenes = torch.cat([first, rows.repeat_interleave(count)])
    vehicle = torch.cat([torch.full_like(first, -1), kernels.vehicle[rows].flatten()])
    drawn = vehicle[:, None] == torch.arange(kernels.vehicles, device=rows.device)
    goal = torch.cat(
        [torch.zeros_like(kernels.goal[:, 0]), kernels.goal[rows].flatten(0, 1)]
    )
    return scenes, goal[:, None].expand(-1, kernels.vehicles, -1), drawn


def best_try(value: Tensor, rows: Tensor, batch: int) -> Tensor:
    """Which [B] of the samples [C] of `tries` is worth the most in each scene, of their
    value [C]; ties: the first."""
    count = (len(value) - batch) // max(len(rows), 1)
    place = torch.arange(batch, device=rows.device)[:, None].repeat(1, count + 1)
    place[rows, 1:] = torch.arange(batch, len(value), device=rows.device).view(
        len(rows), count
    )
    return place.gather(1, value[place].argmax(1, keepdim=True))[:, 0]


def choice_nats(rows: Tensor, batch: int, count: int) -> Tensor:
    """Nats [C] of taking each of the samples of `tries`: -log of its weight among the
    plain one and `count` drawn ones; 0 in those of the B = `batch` scenes that have no
    choice, which are not in rows [R].

    Let r be the law of what is taken, m the sample that it is. r(x, m) <= q_m(x), so
    KL(r, p) <= E[log q_m/p - log w_m] for any weights w that sum to 1.
    """
    plain = torch.zeros(batch, device=rows.device).index_fill(
        0, rows, -math.log1p(-DRAWN)
    )
    taken = plain.new_full((len(rows) * count,), math.log(count / DRAWN))
    return torch.cat([plain, taken])
