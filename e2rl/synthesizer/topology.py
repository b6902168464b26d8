"""Who is entangled with the ego: risk graphs of a reference rollout, their cliques and a score over time (Sec. IV-A1).

Batched over scenes and steps up to the adjacency; cliques are enumerated on the host by networkx.

Only maximal cliques compete. Ranked by mean weight, a clique always has a pair that weighs at least as much, so listing
sub-cliques would leave nothing but pairs; ranked by sum, a maximal clique outweighs its own sub-cliques, which would
fill the top places with the same vehicles again. A sub-clique enters only in the place of a maximal clique that is
larger than `max_clique` (a queue, a pile of parked cars): its heaviest members, the ego kept.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import fsum

import networkx
import numpy as np
import torch
from torch import Tensor

from e2rl.errors import InputError


@dataclass(frozen=True)
class TopologySettings:
    """Settings of the bifurcation analysis; conf/synthesizer/e2.yaml explains each."""

    stride: int = 5
    horizon: float = 8.0
    clearance: float = 3.0
    tau_max: float = 3.0
    beta: float = 1.0
    edge_threshold: float = 0.1
    max_nodes: int = 24
    max_clique: int = 4
    clique_weight: str = "mean"
    ego_relevance: bool = True
    max_hops: int = 2
    top_cliques: int = 3
    candidates: int = 10

    def __post_init__(self):
        if self.clique_weight not in ("mean", "sum"):
            raise InputError(f"synthesizer.topology.clique_weight is {self.clique_weight!r}; choose mean or sum")
        if self.stride < 1 or self.beta <= 0 or self.clearance < 0 or not 0 < self.edge_threshold < 1:
            raise InputError(
                "synthesizer.topology needs stride >= 1, beta > 0, clearance >= 0 and edge_threshold "
                f"between 0 and 1; it has {self.stride}, {self.beta}, {self.clearance}, "
                f"{self.edge_threshold}"
            )
        if self.max_nodes < 2 or self.max_clique < 2:
            raise InputError(
                "synthesizer.topology.max_nodes and max_clique must be at least 2, the ego and another; "
                f"they are {self.max_nodes} and {self.max_clique}"
            )


@dataclass(frozen=True)
class TopologyResult:
    """score [B, V] f_i of eq. (temporal_scoring), the ego's own count included; candidates [B, V] bool S_top, never the
    ego; weights [B, T', V, V] pair risks at the steps looked at, steps [T'] int64; edges, cliques [B, T'] int64:
    numbers of graph edges and of cliques that competed; groups[b][t']: the top cliques, each a tuple of vehicle
    indices.
    """

    score: Tensor
    candidates: Tensor
    weights: Tensor
    steps: Tensor
    edges: Tensor
    cliques: Tensor
    groups: list[list[list[tuple[int, ...]]]]


def _axis_interval(states: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Times [..., N, N] between which boxes i and j overlap on both axes of box i; (inf, -inf) where they never do."""
    cos, sin = states[..., 2].cos(), states[..., 2].sin()
    vx, vy = cos * states[..., 3], sin * states[..., 3]
    x, y = states[..., 0], states[..., 1]
    dx, dy, dvx, dvy = (value[..., None, :] - value[..., :, None] for value in (x, y, vx, vy))
    ci, si = cos[..., :, None], sin[..., :, None]
    turn_cos = (ci * cos[..., None, :] + si * sin[..., None, :]).abs()
    turn_sin = (ci * sin[..., None, :] - si * cos[..., None, :]).abs()
    length, width = (size[..., k] / 2 for k in (0, 1))
    other_length, other_width = length[..., None, :], width[..., None, :]
    first = last = None
    for place, speed, extent in (
        (
            ci * dx + si * dy,
            ci * dvx + si * dvy,
            length[..., :, None] + turn_cos * other_length + turn_sin * other_width,
        ),
        (
            ci * dy - si * dx,
            ci * dvy - si * dvx,
            width[..., :, None] + turn_sin * other_length + turn_cos * other_width,
        ),
    ):
        still = speed.abs() < 1e-6  # then the projections overlap always or never
        inverse = 1 / torch.where(still, 1.0, speed)
        middle, spread = -place * inverse, extent * inverse.abs()
        spread = torch.where(still, torch.where(place.abs() <= extent, torch.inf, -torch.inf), spread)
        first = middle - spread if first is None else torch.maximum(first, middle - spread)
        last = middle + spread if last is None else torch.minimum(last, middle + spread)
    return first, last


def time_to_collision(states: Tensor, size: Tensor, horizon: float = 8.0) -> Tensor:
    """First contact of oriented boxes at constant velocity and heading, states [..., N, 4], size [..., N, 2] -> s
    [..., N, N].

    Separating axes in closed form: on each of the four box normals the projections overlap during one interval of time,
    and the boxes touch during the intersection of the four. 0 where they overlap now (and for i = j), inf where they do
    not touch within `horizon` s. Exactly symmetric.
    """
    entry, leave = _axis_interval(states, size)
    entry = torch.maximum(entry, entry.transpose(-1, -2))
    leave = torch.minimum(leave, leave.transpose(-1, -2))
    first = entry.clamp(min=0)
    return torch.where((entry <= leave) & (leave >= 0) & (first <= horizon), first, torch.inf)


def pair_weights(states: Tensor, valid: Tensor, size: Tensor, settings: TopologySettings) -> Tensor:
    """Risk weight of each pair, eq. (ttc_weight): states [..., N, 4], valid [..., N] -> [..., N, N], 0 on the
    diagonal.
    """
    ttc = time_to_collision(states, size + settings.clearance, settings.horizon)
    weight = torch.sigmoid((settings.tau_max - ttc) / settings.beta)
    both = valid[..., :, None] & valid[..., None, :]
    return weight * (both & ~torch.eye(both.shape[-1], dtype=torch.bool, device=both.device))


@lru_cache(maxsize=8192)
def maximal_cliques(adjacency: bytes, nodes: int) -> tuple[tuple[int, ...], ...]:
    """Maximal cliques of size >= 2 of the graph whose nodes x nodes matrix of bytes is `adjacency` (rows in order)."""
    edges = np.argwhere(np.triu(np.frombuffer(adjacency, np.uint8).reshape(nodes, nodes), 1))
    return tuple(tuple(sorted(clique)) for clique in networkx.find_cliques(networkx.Graph(edges.tolist())))


def _reachable(adjacency: Tensor, hops: int) -> Tensor:
    """Nodes [..., V] within `hops` edges of node 0."""
    near = torch.zeros(adjacency.shape[:-1], dtype=torch.bool, device=adjacency.device)
    near[..., 0] = True
    for _ in range(hops):
        near = near | (adjacency & near[..., None, :]).any(-1)
    return near


def _trim(clique: tuple[int, ...], weight: np.ndarray, far: np.ndarray, limit: int) -> tuple[int, ...]:
    """The `limit` members of a clique with the largest total weight inside it; the ego (0) always stays."""
    if len(clique) <= limit:
        return clique
    bond = {i: round(fsum(weight[i, j] for j in clique), 6) for i in clique}
    return tuple(sorted(sorted(clique, key=lambda i: (i != 0, -bond[i], far[i], i))[:limit]))


def _rank(cliques: set[tuple[int, ...]], weight: np.ndarray, far: np.ndarray, settings: TopologySettings):
    """The heaviest cliques first; equals by their members' mean distance to the ego, then by index."""

    def key(clique):
        size = len(clique)
        total = fsum(weight[i, j] for k, i in enumerate(clique) for j in clique[k + 1 :])
        if settings.clique_weight == "mean":
            total /= size * (size - 1) / 2
        return -round(total, 6), fsum(far[i] for i in clique) / size, clique

    return sorted(cliques, key=key)[: settings.top_cliques]


def _step_groups(adjacency, near, weight, far, settings) -> tuple[list[tuple[int, ...]], int]:
    """Top cliques of one graph [V, V] and the number that competed; near [V]: nodes that make a clique relevant."""
    nodes = np.flatnonzero(adjacency.any(-1))
    if len(nodes) < 2:
        return [], 0
    found = maximal_cliques(np.ascontiguousarray(adjacency[np.ix_(nodes, nodes)]).tobytes(), len(nodes))
    named = (_trim(tuple(int(nodes[i]) for i in clique), weight, far, settings.max_clique) for clique in found)
    relevant = {clique for clique in named if near[list(clique)].any()}
    return _rank(relevant, weight, far, settings), len(relevant)


def _select(score: Tensor, distance: Tensor, present: Tensor, count: int) -> Tensor:
    """The `count` vehicles of largest positive score, equals by distance, then by index; never the ego."""
    allowed = present & (score > 0)
    allowed[:, 0] = False
    order = distance.argsort(dim=-1, stable=True)
    ranked = score.masked_fill(~allowed, -1).gather(-1, order)
    order = order.gather(-1, ranked.argsort(dim=-1, descending=True, stable=True))
    rank = order.argsort(-1)
    return allowed & (rank < count)


def topological_candidates(states: Tensor, valid: Tensor, size: Tensor, settings: TopologySettings) -> TopologyResult:
    """Candidates S_top of a reference rollout (Sec. IV-A1, eqs. ttc_weight and temporal_scoring).

    states [B, T, V, 4], valid [B, T, V] bool, size [B, V, 2]; row 0 is the ego, which is a node of the graphs but
    never a candidate. Looks at every `stride`-th step; scores count those steps only.
    """
    steps = torch.arange(0, states.shape[1], settings.stride, device=states.device)
    states, valid = states[:, steps].detach(), valid[:, steps]
    weights = pair_weights(states, valid, size[:, None].expand(*states.shape[:-1], 2), settings)
    distance = (states[..., :2] - states[..., :1, :2]).norm(dim=-1)
    distance = distance.masked_fill(~valid | ~valid[..., :1], torch.inf)
    rank = distance.argsort(dim=-1, stable=True).argsort(-1)
    kept = (rank < settings.max_nodes) & valid
    adjacency = (weights >= settings.edge_threshold) & kept[..., :, None] & kept[..., None, :]
    edges = adjacency.sum((-1, -2)) // 2
    near = kept
    if settings.ego_relevance:  # members of a relevant clique lie at most one hop beyond its nearest one
        near = _reachable(adjacency, settings.max_hops)
        wide = _reachable(adjacency, settings.max_hops + 1)
        adjacency = adjacency & wide[..., :, None] & wide[..., None, :]
    host = [x.cpu().numpy() for x in (adjacency.to(torch.uint8), near, weights, distance)]
    score = torch.zeros(states.shape[0], states.shape[2])
    cliques = torch.zeros(states.shape[:2], dtype=torch.int64)
    groups = []
    for b in range(states.shape[0]):
        groups.append([])
        for t in range(states.shape[1]):
            top, cliques[b, t] = _step_groups(*(x[b, t] for x in host), settings)
            groups[b].append(top)
            for clique in top:
                score[b, list(clique)] += 1
    score = score.to(states.device)
    candidates = _select(score, distance.amin(1), valid[:, 0], settings.candidates)
    return TopologyResult(score, candidates, weights, steps, edges, cliques.to(states.device), groups)
