"""Maximal cliques of small graphs of vehicles, by networkx, and their weights."""

from functools import lru_cache
from math import fsum

import networkx
import numpy as np

Clique = tuple[int, ...]  # indices of its members, ascending


@lru_cache(maxsize=8192)
def maximal_cliques(adjacency: bytes, nodes: int) -> tuple[Clique, ...]:
    """Maximal cliques of size >= 2 of the graph whose nodes x nodes matrix of bytes is
    `adjacency` (rows in order)."""
    edges = np.argwhere(
        np.triu(np.frombuffer(adjacency, np.uint8).reshape(nodes, nodes), 1)
    )
    return tuple(
        tuple(sorted(clique))
        for clique in networkx.find_cliques(networkx.Graph(edges.tolist()))
    )


def cliques_in(adjacency: np.ndarray) -> list[Clique]:
    """Maximal cliques of size >= 2 of a graph [V, V] of bytes."""
    nodes = np.flatnonzero(adjacency.any(-1))
    found = maximal_cliques(
        np.ascontiguousarray(adjacency[np.ix_(nodes, nodes)]).tobytes(), len(nodes)
    )
    return [tuple(int(nodes[i]) for i in clique) for clique in found]


def weight_of(clique: Clique, weight: np.ndarray) -> float:
    """Total weight [V, V] of a clique's pairs."""
    return fsum(weight[i, j] for k, i in enumerate(clique) for j in clique[k + 1 :])
