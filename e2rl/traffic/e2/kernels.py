"""Importance kernels (docs/method.md, section 9): plans in the prior's own coordinates that the attack may be drawn to.

A kernel shifts one vehicle's plan away from the prior's mean: another acceleration, another place across the lane. Each
costs about delta^T C^-1 delta / 2 nats, C the covariance of the prior's samples, and is worth what `foresee` makes of
it. Those worth the most, less what they cost, become joint samples; of these the best is driven. What a kernel moved is
booked as path KL, step by step, and the choice among M samples as log M.
"""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import BEND_SCALE, HORIZON, KNOTS, OFFSET_SCALE, SIZE, LaneState
from e2rl.prior.prior import Context
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.settings import configured, setting
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate, project
from e2rl.sim.world import World
from e2rl.traffic.e2.anchoring import Anchor
from e2rl.traffic.e2.foresight import Foresight, foresee
from e2rl.traffic.e2.motion import smallest, take

# Standard deviations of x over 12 samples of a Waymo prior (200 scenes, DPM-Solver++), and the correlation of knots
# that are neighbours. They set how a pull is spread over x and over the noise levels; what it costs is booked exactly.
SPREAD = (0.85, 0.53, 0.51, 0.51, 0.52, 0.54, 0.57, 0.60, 0.63, 0.71, 1.02, 0.89)
CORRELATION = 0.57
ACCELERATIONS = (-3.0, -2.0, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0)  # m/s^2, from the prior's mean
OFFSETS = (0.8, 1.6, 2.5, 3.5, 4.5)  # m, to either side of it, after the lateral horizon
EARLY = 0.5  # of the way across that half of the kernels have come sooner, at half of the horizon
REACH, NEAREST = 60.0, 10  # m: vehicles that have kernels, and how many
STIRS = 1.0  # m/s that such a vehicle reaches within its expected plan
MAX_LATERAL = 4.0  # m/s^2
APART = 6.0  # nats between two kernels of a vehicle that are drawn
BUMP = 2.2  # m between centres, nearer than which a plan touches somebody else
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
    """Goals x [B, N, SIZE] of N kernels, best first, and the vehicle [B, N] that each moves, -1 for none."""

    goal: Tensor
    vehicle: Tensor


@cache
def covariance(device: torch.device) -> Tensor:
    """C [SIZE, SIZE]: knots are correlated like an AR(1) sequence, lateral knots with nothing."""
    std, lag = torch.tensor(SPREAD, device=device), torch.arange(SIZE, device=device)
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
    sides = [(0.0, 0.0), *((sign * side, early) for side in OFFSETS for sign in (1, -1) for early in (0.0, EARLY))]
    moves = torch.tensor([(a, *side) for side in sides for a in sorted(ACCELERATIONS, key=abs)], device=device)
    bend = moves[:, 1:2] * moves[:, 2:] / (2 * BEND_SCALE)
    return torch.cat([moves[:, :1].expand(-1, KNOTS), bend, moves[:, 1:2] / OFFSET_SCALE], 1)


def nats(shift: Tensor) -> Tensor:
    """What displacements [..., SIZE] of x cost, delta^T C^-1 delta / 2 [...]."""
    values, vectors = _axes(shift.device)
    return ((shift @ vectors).square() / values).sum(-1) / 2


def pulled(x0: Tensor, goal: Tensor, strength: Tensor, level: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Clean estimates x0 [..., SIZE] at a noise level under the potential strength (x - goal)^T C^-1 (x - goal) / 2.

    Where the prior's law is a Gaussian of covariance C this is the exact posterior mean: with P = (C^-1 + alpha^2 /
    sigma^2)^-1, x0 + P (P + C / strength)^-1 (goal - x0). strength 0 is the prior.
    """
    values, vectors = _axes(x0.device)
    ratio = (schedule.alpha(level) / schedule.sigma(level)) ** 2
    weight = strength / (strength + 1 + values * ratio)
    return x0 + ((goal - x0) @ vectors * weight) @ vectors.T


def sideways(anchor: Anchor, world: World, lane: LaneState, points: Tensor) -> Tensor:
    """Nats [B, V] of the interceptions of an anchor: of the two lateral knots that fit them on the lanes points [B, V,
    P, 2] that they leave, under N(0, C). lane [B, V]: the present states, on whatever they follow.

    An estimate, not a bound: the prior's law beside a lane is not known, only around it.
    """
    states = world.states[:, : points.shape[1]]
    now = lane_relative.locate(states, lane.a, lane.kappa * lane.v, points)
    speed, travelled = lane_relative.speeds(now, anchor.knots)
    start = project(states[:, :, None, :2], anchor.off_lane_path)[0]
    xy, heading, _ = interpolate(anchor.off_lane_path, start + travelled)
    s, d, _ = project(xy, points, now.s[..., None] + travelled)
    track = LaneState.from_states(torch.cat([xy, heading[..., None], speed[..., None]], -1), s, d)
    x = lane_relative.fit(track, torch.ones_like(speed), now)[0]
    variance = torch.tensor(SPREAD[KNOTS:], device=x.device).square()
    return (x[..., KNOTS:].square() / (2 * variance)).sum(-1)


def watched(world: World, context: Context, plan: Tensor, exempt: Tensor) -> Tensor:
    """Bool [B, V]: the NEAREST vehicles within REACH of the ego that move, by plan [B, V, H, 4], and are not exempt."""
    gap = (world.states[:, : exempt.shape[1], :2] - world.states[:, :1, :2]).norm(dim=-1)
    return smallest(context.active & ~exempt & (gap < REACH) & (plan[..., 3].amax(-1) > STIRS), gap, NEAREST)


@dataclass(frozen=True)
class Attack:
    """What plans of vehicles index [B, M] (there: bool) are valued by: the scenes now, the ego's expected states
    ego_plan [B, H, 4], what everybody is expected to do, plan [B, V, H, 4], and `since`, `settled` of `foresee`."""

    world: World
    ego_plan: Tensor
    plan: Tensor
    index: Tensor
    there: Tensor
    since: Tensor
    settled: Tensor

    def foresight(self, tracks: Tensor) -> Foresight:
        """Of plans [B, M, O, H, 4]."""
        world = self.world
        size, states = world.scene["size"], world.states
        now = take(states, self.index)[:, :, None, None].expand(*tracks.shape[:3], 1, 4)
        path = torch.cat([states[:, :1], self.ego_plan[:, :HORIZON]], 1)
        known = take(size, self.index), take(self.since, self.index), take(self.settled, self.index)
        return foresee(path, size[:, 0], torch.cat([now, tracks], 3), *known)

    def impossible(self, tracks: Tensor, lateral: Tensor, time: Tensor) -> Tensor:
        """Bool [B, M, O]: plans [B, M, O, H, 4] that leave the road, turn too sharply (lateral [B, M, O] m/s^2) or touch
        somebody else before they meet the ego at `time` [B, M, O]."""
        field = self.world.scene["field"], self.world.scene["field_origin"]
        points = tracks[..., 4::5, :2]  # [B, M, O, 10, 2]
        beyond = off_road(points.flatten(1, 3), *field).view(points.shape[:-1]).amax(-1)
        allowed = off_road(take(self.world.states, self.index)[..., :2], *field).clamp(min=-0.3)
        batch, count, options, moments, _ = points.shape
        others = self.plan[:, :, 4::5, :2].transpose(1, 2)
        gap = torch.cdist(points.permute(0, 3, 1, 2, 4).flatten(2, 3), others).view(batch, moments, count, options, -1)
        counts = self.world.valid[:, None, : gap.shape[-1]].expand(-1, count, -1).clone()
        counts[..., 0] = False
        counts &= ~torch.nn.functional.one_hot(self.index, gap.shape[-1]).bool()
        nearest = gap.masked_fill(~counts[:, None, :, None], torch.inf).amin(-1)
        moment = 5 * DT * torch.arange(1, moments + 1, device=gap.device)[:, None, None, None]
        before = moment <= time.clamp(max=HORIZON * DT) + 5 * DT
        bumps = ((nearest < BUMP).transpose(0, 1) & before).any(0)
        return (beyond > allowed[..., None]) | (lateral > MAX_LATERAL) | bumps

    def against(self, tracks: Tensor, time: Tensor, plans: Tensor) -> Tensor:
        """Bool [B, M, K]: plans [B, M, K] of tracks [B, M, O, H, 4] that meet the ego, or half a second before, against
        the lanes."""
        at = (time.clamp(max=HORIZON * DT) / DT).long().clamp(1, HORIZON).gather(2, plans) - 1
        tracks = tracks.gather(2, plans[..., None, None].expand(*plans.shape, *tracks.shape[3:]))
        at = torch.stack([(at - 5).clamp(min=0), at], -1)
        pose = tracks.gather(3, at[..., None].expand(*at.shape, 4)).flatten(1, 3)
        lanes = self.world.scene["lane_points"], self.world.scene["lane_index"]
        return against_lanes(*lanes, pose[..., :2], pose[..., 2, None])[..., 0].view(at.shape).any(-1)


def propose_kernels(
    attack: Attack, lane: LaneState, points: Tensor, mean: Tensor, gain: Tensor, count: int
) -> Kernels:
    """The `count` kernels of highest value: gain [B] nats times their worth, less what they cost.

    lane: states [B, V] on routes points [B, V, P, 2]; mean [B, V, SIZE]: the prior's. Those that gain nothing are none.
    """
    index, table = attack.index, shifts(mean.device)
    x = take(mean, index)[:, :, None] + table

    def of_options(value: Tensor) -> Tensor:
        return take(value, index)[:, :, None].expand(*x.shape[:3], *value.shape[2:]).flatten(0, 2)

    motion = lane_relative.decode(x.flatten(0, 2), lane.map(of_options), of_options(points))
    tracks = motion.states().view(*x.shape[:3], HORIZON, 4)
    seen = attack.foresight(tracks)
    lateral = (motion.v**2 * motion.kappa.abs()).amax(-1).view(x.shape[:3])
    value = gain[:, None, None] * seen.worth - nats(table)
    value = value.masked_fill(attack.impossible(tracks, lateral, seen.time) | ~attack.there[..., None], -torch.inf)
    best = value.topk(min(CHECKED, value.shape[-1]), -1)
    lawful = best.values.masked_fill(attack.against(tracks, seen.time, best.indices), -torch.inf)
    value = torch.full_like(value, -torch.inf).scatter(2, best.indices, lawful)
    goals, vehicles, slots = [], [], torch.arange(index.shape[1], device=index.device)
    row = torch.arange(len(index), device=index.device)
    for _ in range(count):
        top, at = value.flatten(1).max(1)
        slot, option = at // len(table), at % len(table)
        goals.append(x[row, slot, option])
        vehicles.append(torch.where(top > 0, index[row, slot], -1))
        alike = (nats(table - table[option][:, None]) < APART)[:, None] & (slots == slot[:, None])[..., None]
        value = value.masked_fill(alike, -torch.inf)
    return Kernels(torch.stack(goals, 1), torch.stack(vehicles, 1))
