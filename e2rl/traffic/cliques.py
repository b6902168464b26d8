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
    matrix = np.frombuffer(adjacency, np.uint8).reshape(nodes, nodes)
    graph = networkx.Graph(np.argwhere(np.triu(matrix, 1)).tolist())
    return tuple(tuple(sorted(clique)) for clique in networkx.find_cliques(graph))


def cliques_in(adjacency: np.ndarray) -> list[Clique]:
    """Maximal cliques of size >= 2 of a graph [V, V] of bytes."""
    nodes = np.flatnonzero(adjacency.any(-1))
    matrix = adjacency[np.ix_(nodes, nodes)]
    cliques = maximal_cliques(matrix.tobytes(), len(nodes))
    return [tuple(int(nodes[i]) for i in clique) for clique in cliques]


def weight_of(clique: Clique, weight: np.ndarray) -> float:
    """Total weight [V, V] of a clique's pairs."""
    return fsum(weight[i, j] for k, i in enumerate(clique) for j in clique[k + 1 :])
