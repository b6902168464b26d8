"""Topological bifurcation (Sec. IV-A1): the vehicles that a reference rollout couples
with the ego.

Pairs are weighted by their time to collision (eq. ttc_weight), the maximal cliques of
each step's risk graph are ranked by mean weight, and members of the top cliques score
over time (eq. temporal_scoring). Only maximal cliques compete: the best pair of a
clique never weighs less than the whole, so ranking all cliques would leave pairs only.
"""

from dataclasses import dataclass
from math import fsum
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from e2rl.run.config import configured, setting
from e2rl.traffic.cliques import Clique, cliques_in, weight_of
from e2rl.traffic.motion import smallest

STRIDE = 5  # steps between the graphs (0.5 s)
RISK_SECONDS = 8.0  # s; no contact within it at constant velocity is no risk
# Vehicles nearest to the ego that a graph may have: enumeration is exponential at worst.
NODES = 24
# Edges from the ego within which a clique must have a member (or the ego): a far queue is
# no candidate.
HOPS = 2


@configured("synthesizer/e2", "topology")
@dataclass(frozen=True)
class TopologySettings:
    """Settings of the bifurcation analysis; conf/synthesizer/e2.yaml explains each."""

    clearance: float = setting(low=0)
    tau_max: float = setting()
    beta: float = setting(low=1e-3)
    edge_threshold: float = setting(low=1e-6, high=1 - 1e-6)
    max_clique: int = setting(low=2)
    top_cliques: int = setting(low=1)
    candidates: int = setting(low=0)


@dataclass(frozen=True)
class TopologyResult:
    """score [B, V]: f_i of eq. (temporal_scoring), the ego's own included; candidates
    [B, V] bool: S_top, never the ego; weights [B, T', V, V]: pair risks at the steps
    [T'] int64 analysed; cliques[b][t']: the top cliques of a step, each a tuple of
    vehicle indices.
    """

    score: Tensor
    candidates: Tensor
    weights: Tensor
    steps: Tensor
    cliques: list[list[list[Clique]]]


def _overlap_interval(
    offset: Tensor,
    closing: Tensor,
    extent: Tensor,
) -> tuple[Tensor, Tensor]:
    """Times during which |offset + closing t| <= extent; (inf, -inf) for never."""
    still = closing.abs() < 1e-6  # then the projections overlap always or never
    inverse = 1 / torch.where(still, 1.0, closing)
    middle = -offset * inverse
    half = extent * inverse.abs()
    half = torch.where(
        still,
        torch.where(offset.abs() <= extent, torch.inf, -torch.inf),
        half,
    )
    return middle - half, middle + half


def time_to_collision(
    states: Tensor,
    size: Tensor,
    horizon: float = RISK_SECONDS,
) -> Tensor:
    """Time [s] to the first contact of oriented boxes at constant velocity and heading:
    states [..., N, 4], size [..., N, 2] -> [..., N, N].

    Separating axis theorem in closed form: the boxes touch while their projections on
    all four face normals overlap. 0 where they overlap now (and for i = j), inf without
    contact within `horizon` s. Exactly symmetric.
    """
    cos = states[..., 2].cos()
    sin = states[..., 2].sin()
    speed = states[..., 3]
    motion = (states[..., 0], states[..., 1], cos * speed, sin * speed)
    dx, dy, dvx, dvy = (value[..., None, :] - value[..., :, None] for value in motion)
    ci = cos[..., :, None]
    si = sin[..., :, None]
    cj = cos[..., None, :]
    sj = sin[..., None, :]
    turn_cos = (ci * cj + si * sj).abs()
    turn_sin = (ci * sj - si * cj).abs()
    half = size / 2
    li, wi = half[..., :, None, :].unbind(-1)
    lj, wj = half[..., None, :, :].unbind(-1)
    along = _overlap_interval(
        ci * dx + si * dy,
        ci * dvx + si * dvy,
        extent=li + turn_cos * lj + turn_sin * wj,
    )
    across = _overlap_interval(
        ci * dy - si * dx,
        ci * dvy - si * dvx,
        extent=wi + turn_sin * lj + turn_cos * wj,
    )
    begin = torch.maximum(along[0], across[0])  # on the normals of box i
    end = torch.minimum(along[1], across[1])
    begin = torch.maximum(begin, begin.transpose(-1, -2))
    end = torch.minimum(end, end.transpose(-1, -2))
    first = begin.clamp(min=0)
    touch = (begin <= end) & (end >= 0) & (first <= horizon)
    return torch.where(touch, first, torch.inf)


def pair_weights(
    states: Tensor,
    valid: Tensor,
    size: Tensor,
    settings: TopologySettings,
) -> Tensor:
    """Returns risk weights [..., N, N] of eq. (ttc_weight_t), 0 on the diagonal.

    Args:
        states: [..., N, 4].
        valid: [..., N] bool.
        size: [..., N, 2] m.
        settings: of the analysis.
    """
    ttc = time_to_collision(states, size + settings.clearance)
    weight = torch.sigmoid((settings.tau_max - ttc) / settings.beta)
    both = valid[..., :, None] & valid[..., None, :]
    itself = torch.eye(both.shape[-1], dtype=torch.bool, device=both.device)
    return weight * (both & ~itself)


def _within_hops(adjacency: Tensor, hops: int) -> Tensor:
    """Nodes [..., V] bool within `hops` edges of the ego (node 0)."""
    near = torch.zeros(adjacency.shape[:-1], dtype=torch.bool, device=adjacency.device)
    near[..., 0] = True
    for _ in range(hops):
        near = near | (adjacency & near[..., None, :]).any(-1)
    return near


class _Graph(NamedTuple):
    """Risk graphs [...]: adjacency and weights [..., V, V]; relevant nodes [..., V]
    bool; distance [..., V] of each vehicle to the ego in m."""

    adjacency: np.ndarray
    relevant: np.ndarray
    weight: np.ndarray
    distance: np.ndarray

    def at(self, scene: int, step: int) -> "_Graph":
        """The graph of one step of a scene."""
        return _Graph(*(value[scene, step] for value in self))


def _trim(clique: Clique, graph: _Graph, limit: int) -> Clique:
    """The `limit` members of a clique with the largest total weight inside it; the ego
    always stays."""
    if len(clique) <= limit:
        return clique
    weight = graph.weight
    total = {i: round(fsum(weight[i, j] for j in clique), 6) for i in clique}
    ranked = sorted(clique, key=lambda i: (i != 0, -total[i], graph.distance[i], i))
    return tuple(sorted(ranked[:limit]))


def _top_cliques(graph: _Graph, settings: TopologySettings) -> list[Clique]:
    """The cliques of largest mean weight in a graph that have a relevant node; ties by
    distance, then index."""

    def rank(clique: Clique) -> tuple[float, float, Clique]:
        size = len(clique)
        mean = weight_of(clique, graph.weight) / (size * (size - 1) / 2)
        distance = fsum(graph.distance[i] for i in clique) / size
        return -round(mean, 6), distance, clique

    cliques = cliques_in(graph.adjacency)
    trimmed = {_trim(clique, graph, limit=settings.max_clique) for clique in cliques}
    relevant = (clique for clique in trimmed if graph.relevant[list(clique)].any())
    return sorted(relevant, key=rank)[: settings.top_cliques]


def topological_candidates(
    states: Tensor,
    valid: Tensor,
    size: Tensor,
    settings: TopologySettings,
) -> TopologyResult:
    """Returns the candidates S_top of a reference rollout (Sec. IV-A1, eqs. ttc_weight
    and temporal_scoring). Every STRIDE-th step is analysed and counts once.

    Args:
        states: [B, T, V, 4]; row 0 is the ego, which is a node of the graphs but never
            a candidate.
        valid: [B, T, V] bool.
        size: [B, V, 2] m.
        settings: of the analysis.
    """
    steps = torch.arange(0, states.shape[1], STRIDE, device=states.device)
    states = states[:, steps].detach()
    valid = valid[:, steps]
    weights = pair_weights(
        states,
        valid,
        size=size[:, None].expand(*states.shape[:-1], 2),
        settings=settings,
    )
    distance = (states[..., :2] - states[..., :1, :2]).norm(dim=-1)
    distance = distance.masked_fill(~valid | ~valid[..., :1], torch.inf)
    nodes = smallest(valid, distance, count=NODES)
    adjacency = (
        (weights >= settings.edge_threshold) & nodes[..., :, None] & nodes[..., None, :]
    )
    # Only cliques with a member within HOPS of the ego count; all their members lie
    # within one hop more.
    relevant = _within_hops(adjacency, HOPS)
    nodes = _within_hops(adjacency, HOPS + 1)
    adjacency = adjacency & nodes[..., :, None] & nodes[..., None, :]
    graphs = _Graph(
        adjacency=adjacency.to(torch.uint8).cpu().numpy(),
        relevant=relevant.cpu().numpy(),
        weight=weights.cpu().numpy(),
        distance=distance.cpu().numpy(),
    )
    cliques = [
        [_top_cliques(graphs.at(scene, step), settings) for step in range(len(steps))]
        for scene in range(len(states))
    ]
    score = torch.zeros(states.shape[0], states.shape[2])
    for row, scene in zip(score, cliques, strict=True):
        for clique in (clique for step in scene for clique in step):
            row[list(clique)] += 1
    score = score.to(states.device)
    # The vehicles of largest positive score; ties by least distance to the ego, then by
    # index.
    scored = valid[:, 0] & (score > 0)
    scored[:, 0] = False
    tie = distance.amin(1).argsort(dim=-1, stable=True).argsort(-1)
    candidates = smallest(
        scored,
        tie - score * score.shape[1],
        count=settings.candidates,
    )
    return TopologyResult(
        score,
        candidates,
        weights=weights,
        steps=steps,
        cliques=cliques,
    )
