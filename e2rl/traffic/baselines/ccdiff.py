"""CCDiff (Lin et al. 2025): a clique ranker on the recent past, guidance of those that
it finds, all others replay.

The ranker finds the vehicles that stand in the heaviest cliques of the recent past's
risk graphs.
"""

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.baselines.baseline import BaselineState, replay_others
from e2rl.traffic.baselines.guidance import MeanGuided
from e2rl.traffic.baselines.losses import (
    discounts,
    even,
    off_road_term,
    overlap_term,
)
from e2rl.traffic.baselines.view import View
from e2rl.traffic.cliques import cliques_in, weight_of
from e2rl.traffic.grouping import noise_of
from e2rl.traffic.motion import smallest
from e2rl.traffic.nominal import React
from e2rl.traffic.traffic import TrafficPlan

FAR = 20.0  # s: times to contact are cut there
EDGE = 0.5  # risk from which on a pair is an edge
SMALLEST = 3  # vehicles in a clique that counts
TOP = 3  # cliques a step that count
NODES = (
    24  # vehicles nearest to the ego in a graph: enumeration is exponential at worst
)
TIES = 900  # number of the draw that orders vehicles of equal rank


@dataclass
class CCDiffState(BaselineState):
    """top [B, V] bool: the vehicles that the ranker found, which the prior drives; all
    of a scene without strength."""

    top: Tensor


@configured("synthesizer/ccdiff")
@dataclass(eq=False, repr=False)
class CCDiff(MeanGuided):
    """Posterior-mean guidance by attraction to the ego and by the map, of the
    `controlled` top vehicles only."""

    controlled: int = setting(low=1)
    collision: float = setting()
    margin: float = setting(low=0)
    off_road: float = setting()

    tuned = {"gain": (0.1, 40.0, "log"), "step_size": (0.03, 3.0, "log")}

    def reset(
        self,
        scenes: TensorDictBase,
        seed: Tensor,
        eta: Tensor,
    ) -> CCDiffState:
        """Returns states of scenes [B] with their top vehicles, whose routes are the
        prior's; others' are recorded."""
        state = super().reset(scenes, seed, eta)
        draw = noise_of(
            state.seed,
            torch.full_like(state.seed, TIES),
            shape=tuple(state.adversary.shape[1:]),
            uniform=True,
        )
        top = ranked(scenes, self.controlled, draw=draw)
        top = top | (self.strength(state) <= 0)[:, None]
        logged = scenes["route_log"].clone()
        logged[:, 0] = -1  # nobody's but the ego's own business
        sampled = top | (logged < 0)
        route = torch.where(sampled, state.routed.route, logged)
        routed, lane = self.prior.start(scenes, route)
        started = vars(state) | {"routed": routed, "lane": lane}
        return CCDiffState(**started, top=top)

    def replan(
        self,
        state: CCDiffState,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[CCDiffState, TrafficPlan]:
        """Returns states and plans (`Traffic.replan`); who is not among the top
        replays."""
        state, plan = super().replan(state, world, ego_plan, react)
        return replay_others(
            state,
            plan,
            world=world,
            driven=state.top,
        )

    def attackers(self, state: CCDiffState, view: View) -> Tensor:
        """The top vehicles."""
        return state.top & view.active

    def loss(self, motion: LaneState, view: View) -> Tensor:
        """Minus the collision cost with the ego, and metres off the road."""
        states = view.with_ego(motion)
        others = torch.ones_like(view.routed.conflict)
        others[:, :, 0] = False
        collision = overlap_term(
            states,
            view,
            margin=self.margin,
            weights=even(states),
            left_out=others,
        )
        off_road = off_road_term(states, view, weights=discounts(states))
        return self.off_road * off_road - self.collision * collision


def recent_states(scene: TensorDictBase) -> Tensor:
    """States [B, V, T, 4] of the second before the start, the start last; speed from
    differences of position."""
    past = scene["past"].flip(2)  # [B, V, 10, 3] in the start's frame
    start = scene["start"][:, : past.shape[1], None]
    ahead = unit_vectors(start[..., 2])
    left = torch.stack([-ahead[..., 1], ahead[..., 0]], -1)
    xy = start[..., :2] + past[..., :1] * ahead + past[..., 1:2] * left
    xy = torch.cat([xy, start[..., :2]], 2)
    heading = torch.cat([start[..., 2] + past[..., 2], start[..., 2]], 2)
    speed = xy.diff(dim=2).norm(dim=-1) / DT
    speed = torch.cat([speed[..., :1], speed], 2)
    return torch.cat([xy, heading[..., None], speed[..., None]], -1)


def risk(states: Tensor, size: Tensor) -> Tensor:
    """Risk [..., V, V] in [0, 1] of pairs of states [..., V, 4], size [..., V, 2]: (FAR
    - t) / FAR.

    t is the larger of the times after which the gaps along x and along y are closed: 0
    where they overlap on the axis, FAR where they open.
    """
    along = unit_vectors(states[..., 2])
    extent = (along.abs() * size[..., :1] + along.flip(-1).abs() * size[..., 1:]) / 2
    velocity = states[..., 3:] * along
    offset = states[..., None, :, :2] - states[..., :, None, :2]
    closing = -(velocity[..., None, :, :] - velocity[..., :, None, :]) * offset.sign()
    gap = offset.abs() - extent[..., None, :, :] - extent[..., :, None, :]
    time = torch.where(closing > 0, gap / closing.clamp(min=1e-6), FAR)
    time = time.where(gap > 0, 0.0)
    return (FAR - time.amax(-1).clamp(0, FAR)) / FAR


def ranked(
    scene: TensorDictBase,
    count: int,
    draw: Tensor,
) -> Tensor:
    """Bool [B, V]: the `count` vehicles, parked ones and the ego apart, that stand in
    the most of the TOP cliques of each step; draw [B, V] in [0, 1) orders equals and
    those in none."""
    states = recent_states(scene)
    vehicles = states.shape[1]
    moving = scene["valid"][:, :vehicles] & ~scene["parked"][:, :vehicles]
    distance = (states[:, :, -1, :2] - states[:, :1, -1, :2]).norm(dim=-1)
    nodes = smallest(moving, distance, count=NODES)
    states = states.transpose(1, 2)
    size = scene["size"][:, None, :vehicles].expand(*states.shape[:-1], 2)
    weight = risk(states, size)
    edges = (weight > EDGE) & nodes[:, None, :, None] & nodes[:, None, None]
    edges = edges & ~torch.eye(vehicles, dtype=torch.bool, device=edges.device)
    adjacency = edges.to(torch.uint8).cpu().numpy()
    weights = weight.cpu().numpy()
    score = torch.zeros(len(states), vehicles)
    for scene_row, step in np.ndindex(adjacency.shape[:2]):
        for clique in top_cliques(adjacency[scene_row, step], weights[scene_row, step]):
            score[scene_row, list(clique)] += 1
    moving[:, 0] = False
    return smallest(
        moving,
        draw - score.to(draw.device),
        count=count,
    )


def top_cliques(adjacency: np.ndarray, weight: np.ndarray) -> list[tuple[int, ...]]:
    """The maximal cliques of SMALLEST or more of greatest total weight; adjacency,
    weight [V, V]."""
    large = [clique for clique in cliques_in(adjacency) if len(clique) >= SMALLEST]
    return sorted(
        large, key=lambda clique: (-round(weight_of(clique, weight), 6), clique)
    )[:TOP]
