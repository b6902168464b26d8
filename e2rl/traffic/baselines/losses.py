"""Terms of the baselines' losses, of plans at SAMPLED_STEPS.

A motion has fields [S, B, V, T]: S samples of B scenes; states are its [S, B, V, T, 4]
with the ego's known motion in row 0. Every term is one value per vehicle, [S, B, V], in
which all others are detached.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from e2rl.metrics.geometry import velocity
from e2rl.prior.lane_relative import LaneState
from e2rl.scenes.boxes import corners, to_frame
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import closest_approach_cost
from e2rl.traffic.baselines.view import View
from e2rl.traffic.motion import direction
from e2rl.traffic.potentials import STRIDE

DISCOUNT = 0.9  # CTG's, a step of DT
DISKS = 2  # CTG's, a vehicle
MAX_OFF_ROAD = 5.0  # m
PairCost = Callable[
    [Tensor, Tensor, Tensor, Tensor], Tensor
]  # states, size, other's states, size -> [P, T]


def discounts(states: Tensor) -> Tensor:
    """CTG's weights [T] of the moments of states [..., T, 4], which sum to 1."""
    moment = STRIDE * torch.arange(1, states.shape[-2] + 1, device=states.device)
    weight = DISCOUNT**moment
    return weight / weight.sum()


def pair_term(
    states: Tensor,
    view: View,
    cost: PairCost,
    reach: float,
    weights: Tensor,
    left_out: Tensor | None = None,
) -> Tensor:
    """Sum over the others of a cost that is 0 where two vehicles are farther than
    `reach` m apart.

    weights [T] of the moments; left_out [B, V, V] bool: pairs (i, j) that cost i
    nothing. Only near pairs are computed.
    """
    size = view.size
    radius = view.size.norm(dim=-1) / 2
    xy = states[..., :2].detach().transpose(2, 3)
    gap = torch.cdist(xy, xy).amin(2) - radius[:, :, None] - radius[:, None]
    counts = view.valid[:, :, None] & view.valid[:, None]
    counts = counts & ~torch.eye(
        counts.shape[-1], dtype=torch.bool, device=counts.device
    )
    counts = counts if left_out is None else counts & ~left_out
    sample, scene, own, other = ((gap < reach) & counts).nonzero(as_tuple=True)
    mine = (sample, scene, own)
    them = (sample, scene, other)
    value = cost(
        states[mine], size[scene, own], states.detach()[them], size[scene, other]
    )
    return torch.zeros_like(states[..., 0, 0]).index_put(
        mine, (value * weights).sum(-1), accumulate=True
    )


def disk_gap(
    states: Tensor, size: Tensor, other: Tensor, other_size: Tensor
) -> tuple[Tensor, Tensor]:
    """Least distance [P, T] between the centres of the DISKS of two vehicles, and the
    sum [P, 1] of their radii.

    states, other [P, T, 4]; sizes [P, 2]. Disks are as wide as the vehicle and lie from
    bumper to bumper.
    """

    def centres(pose: Tensor, box: Tensor) -> Tensor:
        along = torch.linspace(-0.5, 0.5, DISKS, device=pose.device)
        shift = (box[:, 0] - box[:, 1]).clamp(min=0)[:, None, None, None] * along[
            :, None
        ]
        return pose[..., None, :2] + shift * direction(pose[..., 2])[..., None, :]

    between = (
        centres(states, size)[..., :, None, :]
        - centres(other, other_size)[..., None, :, :]
    )
    squared = between.square().sum(-1).flatten(-2).amin(-1)
    return (squared + 1e-6).sqrt(), (size[:, 1:] + other_size[:, 1:]) / 2


def disk_overlap(margin: float) -> PairCost:
    """CTG's collision cost: 1 - d / R below R, the radii and `margin` m (Zhong et al.
    2023)."""

    def cost(*pair: Tensor) -> Tensor:
        distance, radii = disk_gap(*pair)
        return (1 - distance / (radii + margin)).clamp(min=0)

    return cost


def gaussian_overlap(
    states: Tensor, size: Tensor, other: Tensor, other_size: Tensor
) -> Tensor:
    """Safe-Sim's collision cost: a Gaussian of 1 m round the own box at the other's
    centre; flat inside the box."""
    gap = (to_frame(other[..., :2], states).abs() - size[:, None] / 2).clamp(min=0)
    return 10 * torch.exp(-0.5 * (gap.square().sum(-1) - 1.5**2))


def off_road_term(states: Tensor, view: View, weights: Tensor) -> Tensor:
    """Metres beyond the drivable border, mean over a box's corners, over its diagonal."""
    points = corners(states, view.size[:, :, None])  # [S, B, V, T, 4, 2]
    by_scene = points.transpose(0, 1).contiguous()
    beyond = off_road(
        by_scene, view.scene["field"], origin=view.scene["field_origin"]
    ).transpose(0, 1)
    cost = beyond.clamp(0, MAX_OFF_ROAD).mean(-1) / view.size.norm(dim=-1)[..., None]
    return (cost * weights).sum(-1)


def ego_distance(states: Tensor) -> Tensor:
    """Distance [S, B, V, T] to the ego, centre to centre."""
    return ((states[..., :2] - states[:, :, :1, :, :2]).square().sum(-1) + 1e-6).sqrt()


def approach_term(states: Tensor, temperature: float) -> Tensor:
    """Soft minimum over time of the distance to the ego [m]."""
    distance = ego_distance(states)
    return temperature * (
        math.log(distance.shape[-1]) - torch.logsumexp(-distance / temperature, -1)
    )


def ttc_term(states: Tensor) -> Tensor:
    """Minus the time-to-collision cost with the ego, mean over time (Safe-Sim, with the
    closest point of approach)."""
    moving = velocity(states)
    return -closest_approach_cost(
        states[:, :, :1, :, :2] - states[..., :2], moving[:, :, :1] - moving
    ).mean(-1)


def off_route_term(motion: LaneState, view: View) -> Tensor:
    """Metres off the centreline beyond 1 m, fivefold beyond 2.5 m, mean over time; 0
    without a lane."""
    beyond = (motion.d.abs() - 1.0).clamp(min=0)
    cost = (beyond + 4 * (beyond - 1.5).clamp(min=0)).clamp(max=100.0)
    return cost.mean(-1) * view.routed.has_lane


def comfort_term(motion: LaneState, low: float, high: float, jerk: float) -> Tensor:
    """Squared excess of acceleration over [low, high] m/s^2 and of |jerk| over `jerk`
    m/s^3, mean over time."""
    excess = (motion.a - high).clamp(min=0).square() + (low - motion.a).clamp(
        min=0
    ).square()
    rough = (motion.a.diff(dim=-1).abs() / (STRIDE * DT) - jerk).clamp(min=0)
    return excess.mean(-1) + rough.square().mean(-1)


def speeding_term(motion: LaneState, view: View) -> Tensor:
    """m/s above the highest limit of the route (the present speed, if higher), mean
    over time."""
    limit = view.routed.limit.amax(-1)
    allowed = torch.where(
        limit > 0, torch.maximum(limit, view.states[..., 3]), torch.inf
    )
    return (motion.v - allowed[..., None]).clamp(min=0).mean(-1)
