"""Which roads and junctions stand for a lane graph, for formats whose roads meet in
junctions (OpenDRIVE, CommonRoad).

Lanes that follow each other without a fork or a merge are a chain. A chain from a fork
to a merge, such as a turn drawn in two pieces, is one connecting road. Where lanes fork
or merge into each other directly, a piece of them is cut off and connects the rest.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import networkx as nx

from e2rl.scenes.paths import arc_length
from e2rl.scenes.recording import Lane

CUT = 5.0  # m that are cut off a lane to connect it
MOST_CUT = 0.25  # of a lane's length, at each end
LONGEST = 60.0  # m: longer chains are roads of their own

Link = tuple[str, str]
Chain = tuple[str, ...]


class Span(NamedTuple):
    """A part of a lane, from `begin` to `end` m along it."""

    lane: str
    begin: float
    end: float


@dataclass
class RoadPlan:
    """Roads and how they are linked.

    Attributes:
        roads: the spans of each road, in driving direction.
        plain: pairs of roads of which one follows the other, and no further road does.
        connecting: by connecting road the road before it and the road after it.
        junctions: the connecting roads of each junction.
    """

    roads: dict[str, list[Span]] = field(default_factory=dict)
    plain: list[Link] = field(default_factory=list)
    connecting: dict[str, Link] = field(default_factory=dict)
    junctions: list[list[str]] = field(default_factory=list)


def road_plan(lanes: dict[str, Lane]) -> RoadPlan:
    """Returns the plan in which every link of the lane graph is a way from road to
    road.

    Args:
        lanes: by id, whose exits are ids of them.
    """
    graph = lane_digraph(lanes)
    chains = chains_of(graph)
    chain_of = {name: chain for chain in chains for name in chain}
    links = [
        (chain_of[a], chain_of[b]) for a, b in graph.edges if is_junction(graph, a, b=b)
    ]
    length = {name: float(arc_length(lane.points)[-1]) for name, lane in lanes.items()}
    short = [
        chain for chain in chains if sum(length[name] for name in chain) <= LONGEST
    ]
    through = through_chains(graph, chain_of, links=links, short=short)
    heads, tails = cut_ends(graph, links, through=through, length=length)
    plan = RoadPlan()
    first, last = {}, {}  # roads of a chain
    for chain in chains:
        spans = [Span(name, 0.0, end=length[name]) for name in chain]
        if chain in through:
            (before,) = graph.predecessors(chain[0])
            (after,) = graph.successors(chain[-1])
            plan.roads[chain[0]] = spans
            plan.connecting[chain[0]] = (before, after)
            continue
        if chain in heads:
            spans[0] = spans[0]._replace(begin=heads[chain].end)
        if chain in tails:
            spans[-1] = spans[-1]._replace(end=tails[chain].begin)
        roads = [span.lane for span in spans if span.begin < span.end]
        plan.roads |= {span.lane: [span] for span in spans if span.begin < span.end}
        plan.plain += zip(roads, roads[1:], strict=False)
        first[chain], last[chain] = roads[0], roads[-1]
        if graph.has_edge(chain[-1], chain[0]) and not is_junction(
            graph, chain[-1], b=chain[0]
        ):  # a ring
            plan.plain.append((chain[-1], chain[0]))
    for name, (before, after) in plan.connecting.items():
        plan.connecting[name] = (last[chain_of[before]], first[chain_of[after]])
    for before, after in links:
        if before not in through and after not in through:
            spans = [
                ends[chain]
                for ends, chain in ((tails, before), (heads, after))
                if chain in ends
            ]
            name = (
                spans[0].lane
                if spans[0].lane not in plan.roads
                else f"{before[-1]} to {after[0]}"
            )
            plan.roads[name] = spans
            plan.connecting[name] = (last[before], first[after])
    plan.junctions = junctions_of(plan.connecting)
    return plan


def lane_digraph(lanes: dict[str, Lane]) -> nx.DiGraph:
    """Returns the lanes and their exits."""
    graph = nx.DiGraph()
    graph.add_nodes_from(lanes)
    graph.add_edges_from(
        (name, other) for name, lane in lanes.items() for other in lane.exits
    )
    return graph


def is_junction(graph: nx.DiGraph, a: str, b: str) -> bool:
    """Returns whether the link from a to b is one of several at an end."""
    return graph.out_degree(a) > 1 or graph.in_degree(b) > 1


def chains_of(graph: nx.DiGraph) -> list[Chain]:
    """Returns the lanes in chains, each as long as it can be; a ring without fork or
    merge is one, too."""
    alone = nx.DiGraph()
    alone.add_nodes_from(graph)
    alone.add_edges_from(
        (a, b) for a, b in graph.edges if not is_junction(graph, a, b=b)
    )
    chains = []
    for part in nx.weakly_connected_components(alone):
        first = next(
            (name for name in alone if name in part and not alone.in_degree(name)), None
        )
        if first is None:  # a ring
            first = next(name for name in alone if name in part)
        chains.append(tuple(_walk(alone, first)))
    return chains


def _walk(alone: nx.DiGraph, first: str) -> Iterator[str]:
    name: str | None = first
    while name is not None:
        yield name
        name = next(alone.successors(name), None)
        if name == first:
            return


def through_chains(
    graph: nx.DiGraph,
    chain_of: dict[str, Chain],
    links: list[tuple[Chain, Chain]],
    short: list[Chain],
) -> set[Chain]:
    """Returns those `short` chains that are connecting roads as they are: from a lane
    that forks to one that merges.

    The lane before such a chain and the one after it stay whole at that end. So where
    these two are linked directly, and neither could be cut, the chains from the one
    before are no connecting roads.
    """
    through = {
        chain
        for chain in short
        if graph.in_degree(chain[0]) == 1 == graph.out_degree(chain[-1])
        and is_junction(graph, next(graph.predecessors(chain[0])), b=chain[0])
        and is_junction(graph, chain[-1], b=next(graph.successors(chain[-1])))
    }
    while True:
        whole_tails = {
            chain_of[next(graph.predecessors(chain[0]))] for chain in through
        }
        whole_heads = {chain_of[next(graph.successors(chain[-1]))] for chain in through}
        clashing = {
            before
            for before, after in links
            if before in whole_tails and after in whole_heads
        }
        undone = {
            chain
            for chain in through
            if chain_of[next(graph.predecessors(chain[0]))] in clashing
        }
        if not undone:
            return through
        through -= undone


def cut_ends(
    graph: nx.DiGraph,
    links: list[tuple[Chain, Chain]],
    through: set[Chain],
    length: dict[str, float],
) -> tuple[dict[Chain, Span], dict[Chain, Span]]:
    """Returns the heads and the tails that are cut off chains, so that each link but
    those of `through` has a piece.

    A chain that leads to one lane loses its tail; of any other link the next chain
    loses its head, or, where that has to stay whole, the chain before its tail. A piece
    that serves one link is the whole lane where the chain has more.

    Args:
        graph: the lanes and their exits.
        links: the pairs of chains that meet in junctions.
        through: the chains that are connecting roads as they are.
        length: m, by lane.
    """
    whole_heads = {after for before, after in links if before in through}
    heads: dict[Chain, Span] = {}
    tails: dict[Chain, Span] = {}
    pairs = [
        (before, after)
        for before, after in links
        if before not in through and after not in through
    ]
    cut_tails = {
        pair: graph.out_degree(pair[0][-1]) == 1 or pair[1] in whole_heads
        for pair in pairs
    }
    for _, after in (pair for pair in pairs if not cut_tails[pair]):
        lane = after[0]
        whole = (
            len(after) > 1 and graph.in_degree(lane) == 1 and length[lane] <= LONGEST
        )
        heads[after] = Span(
            lane, 0.0, end=length[lane] if whole else min(CUT, MOST_CUT * length[lane])
        )
    for before, _ in (pair for pair in pairs if cut_tails[pair]):
        lane = before[-1]
        rest = len(before) - (
            before in heads and heads[before].end == length[before[0]]
        )
        whole = rest > 1 and graph.out_degree(lane) == 1 and length[lane] <= LONGEST
        piece = length[lane] if whole else min(CUT, MOST_CUT * length[lane])
        tails[before] = Span(lane, length[lane] - piece, end=length[lane])
    return heads, tails


def junctions_of(connecting: dict[str, Link]) -> list[list[str]]:
    """Returns the connecting roads of each junction: those that share an end with each
    other."""
    graph = nx.Graph()
    for road, (before, after) in connecting.items():
        graph.add_edges_from(
            [(("road", road), ("end", before)), (("road", road), ("start", after))]
        )
    parts = nx.connected_components(graph)
    return sorted(
        sorted(name for kind, name in part if kind == "road") for part in parts
    )
