"""Terms of the baselines' losses, of plans at SAMPLED_STEPS.

A motion has fields [S, B, V, T]: S samples of B scenes; states are its [S, B, V, T, 4]
with the ego's known motion in row 0. Every term is one value per vehicle, [S, B, V], in
which all others are detached.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.metrics.geometry import velocity
from e2rl.prior.lane_relative import LaneState
from e2rl.scenes.boxes import corners, to_frame, unit_vectors
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import closest_approach_cost
from e2rl.traffic.baselines.view import View
from e2rl.traffic.potentials import STRIDE

DISCOUNT = 0.9  # CTG's, a step of DT
DISKS = 2  # CTG's, a vehicle
MAX_OFF_ROAD = 5.0  # m
GAUSSIAN_REACH = 3.0  # m beyond which Safe-Sim's Gaussian of 1 m is below 0.4


@dataclass
class Pairs:
    """P pairs of a vehicle and another at T moments: states [P, T, 4] and sizes [P,
    2]."""

    states: Tensor
    size: Tensor
    other: Tensor
    other_size: Tensor


def discounts(states: Tensor) -> Tensor:
    """CTG's weights [T] of the moments of states [..., T, 4], which sum to 1."""
    moment = STRIDE * torch.arange(1, states.shape[-2] + 1, device=states.device)
    weight = DISCOUNT**moment
    return weight / weight.sum()


def even(states: Tensor) -> Tensor:
    """Equal weights [T] of the moments of states [..., T, 4], which sum to 1."""
    return states.new_full(states.shape[-2:-1], 1 / states.shape[-2])


def pair_term(
    states: Tensor,
    view: View,
    *,
    cost: Callable[[Pairs], Tensor],
    reach: float,
    weights: Tensor,
    left_out: Tensor | None = None,
) -> Tensor:
    """Returns the sum over the others of a cost. Only near pairs are computed.

    Args:
        states: [S, B, V, T, 4].
        view: of B scenes.
        cost: [P, T] of Pairs, 0 where they are farther apart than `reach`.
        reach: m.
        weights: [T], of the moments.
        left_out: [B, V, V] bool, pairs (i, j) that cost i nothing.
    """
    size = view.size
    radius = size.norm(dim=-1) / 2
    xy = states[..., :2].detach().transpose(2, 3)
    gap = torch.cdist(xy, xy).amin(2) - radius[:, :, None] - radius[:, None]
    counts = view.valid[:, :, None] & view.valid[:, None]
    itself = torch.eye(counts.shape[-1], dtype=torch.bool, device=counts.device)
    counts = counts & ~itself
    counts = counts if left_out is None else counts & ~left_out
    sample, scene, first, second = ((gap < reach) & counts).nonzero(as_tuple=True)
    vehicle = (sample, scene, first)
    pairs = Pairs(
        states[vehicle],
        size[scene, first],
        other=states.detach()[sample, scene, second],
        other_size=size[scene, second],
    )
    value = (cost(pairs) * weights).sum(-1)
    total = torch.zeros_like(states[..., 0, 0])
    return total.index_put(vehicle, value, accumulate=True)


def overlap_term(
    states: Tensor,
    view: View,
    *,
    margin: float,
    weights: Tensor,
    left_out: Tensor | None = None,
) -> Tensor:
    """Returns the `pair_term` of CTG's collision cost, 1 - d / R below R, the radii and
    a margin (Zhong et al. 2023).

    Args:
        states: [S, B, V, T, 4].
        view: of B scenes.
        margin: m.
        weights: [T], of the moments.
        left_out: [B, V, V] bool, pairs (i, j) that cost i nothing.
    """

    def cost(pairs: Pairs) -> Tensor:
        distance, radii = disk_gap(pairs)
        return (1 - distance / (radii + margin)).clamp(min=0)

    return pair_term(
        states,
        view,
        cost=cost,
        reach=margin,
        weights=weights,
        left_out=left_out,
    )


def disk_gap(pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Least distance [P, T] between the centres of the DISKS of two vehicles, and the
    sum [P, 1] of their radii. Disks are as wide as the vehicle and lie from bumper to
    bumper."""

    def centres(pose: Tensor, box: Tensor) -> Tensor:
        along = torch.linspace(-0.5, 0.5, DISKS, device=pose.device)[:, None]
        length = (box[:, 0] - box[:, 1]).clamp(min=0)[:, None, None, None]
        ahead = unit_vectors(pose[..., 2])[..., None, :]
        return pose[..., None, :2] + length * along * ahead

    first = centres(pairs.states, pairs.size)[..., :, None, :]
    second = centres(pairs.other, pairs.other_size)[..., None, :, :]
    squared = (first - second).square().sum(-1).flatten(-2).amin(-1)
    radii = (pairs.size[:, 1:] + pairs.other_size[:, 1:]) / 2
    return (squared + 1e-6).sqrt(), radii


def gaussian_overlap(pairs: Pairs) -> Tensor:
    """Safe-Sim's collision cost [P, T]: a Gaussian of 1 m round the own box at the
    other's centre; flat inside the box."""
    offset = to_frame(pairs.other[..., :2], pairs.states).abs()
    gap = (offset - pairs.size[:, None] / 2).clamp(min=0)
    return 10 * torch.exp(-0.5 * (gap.square().sum(-1) - 1.5**2))


def off_road_term(
    states: Tensor,
    view: View,
    weights: Tensor,
) -> Tensor:
    """Metres beyond the drivable border, mean over a box's corners, over its diagonal."""
    points = corners(states, view.size[:, :, None])  # [S, B, V, T, 4, 2]
    by_scene = points.transpose(0, 1).contiguous()
    field = view.scene["field"]
    beyond = off_road(
        by_scene,
        field,
        origin=view.scene["field_origin"],
    )
    distance = beyond.transpose(0, 1).clamp(0, MAX_OFF_ROAD).mean(-1)
    cost = distance / view.size.norm(dim=-1)[..., None]
    return (cost * weights).sum(-1)


def ego_distance(states: Tensor) -> Tensor:
    """Distance [S, B, V, T] to the ego, centre to centre."""
    offset = states[..., :2] - states[:, :, :1, :, :2]
    return (offset.square().sum(-1) + 1e-6).sqrt()


def approach_term(states: Tensor, temperature: float) -> Tensor:
    """Soft minimum over time of the distance to the ego [m]."""
    distance = ego_distance(states)
    count = math.log(distance.shape[-1])
    return temperature * (count - torch.logsumexp(-distance / temperature, -1))


def ttc_term(states: Tensor) -> Tensor:
    """Minus the time-to-collision cost with the ego, mean over time (Safe-Sim, with the
    closest point of approach)."""
    moving = velocity(states)
    offset = states[:, :, :1, :, :2] - states[..., :2]
    return -closest_approach_cost(offset, moving[:, :, :1] - moving).mean(-1)


def off_route_term(motion: LaneState, view: View) -> Tensor:
    """Metres off the centreline beyond 1 m, fivefold beyond 2.5 m, mean over time; 0
    without a lane."""
    beyond = (motion.d.abs() - 1.0).clamp(min=0)
    cost = (beyond + 4 * (beyond - 1.5).clamp(min=0)).clamp(max=100.0)
    return cost.mean(-1) * view.routed.has_lane


def comfort_term(
    motion: LaneState,
    *,
    low: float,
    high: float,
    jerk: float,
) -> Tensor:
    """Returns the squared excess of acceleration over [low, high] and of |jerk| over
    `jerk`, mean over time.

    Args:
        motion: fields [S, B, V, T].
        low: m/s^2.
        high: m/s^2.
        jerk: m/s^3.
    """
    above = (motion.a - high).clamp(min=0).square()
    below = (low - motion.a).clamp(min=0).square()
    rough = (motion.a.diff(dim=-1).abs() / (STRIDE * DT) - jerk).clamp(min=0)
    return (above + below).mean(-1) + rough.square().mean(-1)


def speeding_term(motion: LaneState, view: View) -> Tensor:
    """m/s above the highest limit of the route (the present speed, if higher), mean
    over time."""
    limit = view.routed.limit.amax(-1)
    highest = torch.maximum(limit, view.states[..., 3])
    allowed = torch.where(limit > 0, highest, torch.inf)
    return (motion.v - allowed[..., None]).clamp(min=0).mean(-1)
