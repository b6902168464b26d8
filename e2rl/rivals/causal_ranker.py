"""CCDiff's ranker (Lin et al. 2025): vehicles that stand in the heaviest cliques of the recent past's risk graphs."""

from math import fsum

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.recording import DT
from e2rl.synthesizer.motion import direction, smallest
from e2rl.synthesizer.topology import maximal_cliques

FAR = 20.0  # s: times to contact are cut there
EDGE = 0.5  # risk from which on a pair is an edge
SMALLEST = 3  # vehicles in a clique that counts
TOP = 3  # cliques a step that count
NODES = 24  # vehicles nearest to the ego that a graph may have: enumeration is exponential at worst


def recent_states(scene: TensorDictBase) -> Tensor:
    """States [B, V, T, 4] of the second before the start, the start last; speed from differences of position."""
    past = scene["past"].flip(2)  # [B, V, 10, 3] in the start's frame
    start = scene["start"][:, : past.shape[1], None]
    ahead = direction(start[..., 2])
    left = torch.stack([-ahead[..., 1], ahead[..., 0]], -1)
    xy = start[..., :2] + past[..., :1] * ahead + past[..., 1:2] * left
    xy = torch.cat([xy, start[..., :2]], 2)
    heading = torch.cat([start[..., 2] + past[..., 2], start[..., 2]], 2)
    speed = xy.diff(dim=2).norm(dim=-1) / DT
    speed = torch.cat([speed[..., :1], speed], 2)
    return torch.cat([xy, heading[..., None], speed[..., None]], -1)


def risk(states: Tensor, size: Tensor) -> Tensor:
    """Risk [..., V, V] in [0, 1] of pairs of states [..., V, 4], size [..., V, 2]: (FAR - t) / FAR.

    t is the larger of the times after which the gaps along x and along y are closed: 0 where they overlap on the axis,
    FAR where they open.
    """
    along = direction(states[..., 2])
    extent = (along.abs() * size[..., :1] + along.flip(-1).abs() * size[..., 1:]) / 2
    velocity = states[..., 3:] * along
    offset = states[..., None, :, :2] - states[..., :, None, :2]
    closing = -(velocity[..., None, :, :] - velocity[..., :, None, :]) * offset.sign()
    gap = offset.abs() - extent[..., None, :, :] - extent[..., :, None, :]
    time = torch.where(closing > 0, gap / closing.clamp(min=1e-6), FAR).where(gap > 0, 0.0)
    return (FAR - time.amax(-1).clamp(0, FAR)) / FAR


def ranked(scene: TensorDictBase, count: int, draw: Tensor) -> Tensor:
    """Bool [B, V]: the `count` vehicles, parked ones and the ego apart, that stand in the most of the TOP cliques of
    each step; draw [B, V] in [0, 1) orders equals and those in none."""
    states = recent_states(scene)
    vehicles = states.shape[1]
    there = scene["valid"][:, :vehicles] & ~scene["parked"][:, :vehicles]
    distance = (states[:, :, -1, :2] - states[:, :1, -1, :2]).norm(dim=-1)
    nodes = smallest(there, distance, NODES)
    states = states.transpose(1, 2)
    weight = risk(states, scene["size"][:, None, :vehicles].expand(*states.shape[:-1], 2))
    edges = (weight > EDGE) & nodes[:, None, :, None] & nodes[:, None, None]
    edges = edges & ~torch.eye(vehicles, dtype=torch.bool, device=edges.device)
    host = edges.to(torch.uint8).cpu().numpy(), weight.cpu().numpy()
    found = [[_top_cliques(*graph) for graph in zip(*steps, strict=True)] for steps in zip(*host, strict=True)]
    score = torch.zeros(len(states), vehicles)
    for row, steps in zip(score, found, strict=True):
        for clique in (clique for step in steps for clique in step):
            row[list(clique)] += 1
    there = there & (torch.arange(vehicles, device=there.device) > 0)
    return smallest(there, draw - score.to(draw.device), count)


def _top_cliques(adjacency: np.ndarray, weight: np.ndarray) -> list[tuple[int, ...]]:
    """The maximal cliques of SMALLEST or more of greatest total weight; adjacency, weight [V, V]."""
    nodes = np.flatnonzero(adjacency.any(-1))
    if len(nodes) < SMALLEST:
        return []
    found = maximal_cliques(np.ascontiguousarray(adjacency[np.ix_(nodes, nodes)]).tobytes(), len(nodes))
    large = [tuple(int(nodes[i]) for i in clique) for clique in found if len(clique) >= SMALLEST]

    def rank(clique: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        return -round(fsum(weight[i, j] for k, i in enumerate(clique) for j in clique[k + 1 :]), 6), clique

    return sorted(large, key=rank)[:TOP]
