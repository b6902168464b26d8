"""Which roads and junctions stand for a lane graph, for formats whose roads meet in
junctions (OpenDRIVE, CommonRoad).

Lanes that follow each other without a fork or a merge are a chain. A chain from a fork
to a merge, such as a turn drawn in two pieces, is one connecting road. Where lanes fork
or merge into each other directly, a piece of them is cut off and connects the rest.
"""

from dataclasses import dataclass, field
from itertools import pairwise
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
    graph = LaneChains(lanes)
    through = graph.through_chains()
    links = [
        (before, after)
        for before, after in graph.links
        if before not in through and after not in through
    ]
    heads, tails = graph.cut_ends(links, through)
    plan = RoadPlan()
    first: dict[Chain, str] = {}  # roads of a chain
    last: dict[Chain, str] = {}
    for chain in graph.chains:
        spans = [Span(name, 0.0, end=graph.length[name]) for name in chain]
        if chain in through:
            plan.roads[chain[0]] = spans
            plan.connecting[chain[0]] = (graph.before(chain), graph.after(chain))
            continue
        if chain in heads:
            spans[0] = spans[0]._replace(begin=heads[chain].end)
        if chain in tails:
            spans[-1] = spans[-1]._replace(end=tails[chain].begin)
        spans = [span for span in spans if span.begin < span.end]
        plan.roads |= {span.lane: [span] for span in spans}
        plan.plain += [(span.lane, other.lane) for span, other in pairwise(spans)]
        first[chain] = spans[0].lane
        last[chain] = spans[-1].lane
        end = chain[-1]
        start = chain[0]
        ring = graph.lanes.has_edge(end, start)
        if ring and not graph.is_junction(end, start):
            plan.plain.append((end, start))
    for name, (before, after) in plan.connecting.items():
        chain_before = graph.chain_of[before]
        chain_after = graph.chain_of[after]
        plan.connecting[name] = (last[chain_before], first[chain_after])
    for chain_before, chain_after in links:
        spans = [tails[chain_before]] if chain_before in tails else []
        spans += [heads[chain_after]] if chain_after in heads else []
        name = spans[0].lane
        if name in plan.roads:
            name = f"{chain_before[-1]} to {chain_after[0]}"
        plan.roads[name] = spans
        plan.connecting[name] = (last[chain_before], first[chain_after])
    plan.junctions = junctions_of(plan.connecting)
    return plan


def lane_digraph(lanes: dict[str, Lane]) -> nx.DiGraph:
    """Returns the lanes and their exits."""
    return nx.DiGraph({name: lane.exits for name, lane in lanes.items()})


class LaneChains:
    """A lane graph and its chains, each as long as it can be; a ring without fork or
    merge is one, too. `links` are the pairs of chains that meet in junctions, `length`
    is in m by lane."""

    def __init__(self, lanes: dict[str, Lane]) -> None:
        self.lanes = lane_digraph(lanes)
        self.length = {
            name: float(arc_length(lane.points)[-1]) for name, lane in lanes.items()
        }
        alone = nx.DiGraph()
        alone.add_nodes_from(self.lanes)
        alone.add_edges_from(
            (before, after)
            for before, after in self.lanes.edges
            if not self.is_junction(before, after)
        )
        self.chains: list[Chain] = []
        for part in nx.weakly_connected_components(alone):
            names = [name for name in alone if name in part]
            first = min(names, key=alone.in_degree)  # of a ring any
            self.chains.append(tuple(nx.dfs_preorder_nodes(alone, first)))
        self.chain_of = {name: chain for chain in self.chains for name in chain}
        self.links = [
            (self.chain_of[before], self.chain_of[after])
            for before, after in self.lanes.edges
            if self.is_junction(before, after)
        ]

    def is_junction(self, before: str, after: str) -> bool:
        """Whether the link is one of several at an end."""
        return self.lanes.out_degree(before) > 1 or self.lanes.in_degree(after) > 1

    def before(self, chain: Chain) -> str:
        """The first lane that leads to a chain."""
        return next(self.lanes.predecessors(chain[0]))

    def after(self, chain: Chain) -> str:
        """The first lane that a chain leads to."""
        return next(self.lanes.successors(chain[-1]))

    def through_chains(self) -> set[Chain]:
        """Those chains, none too long, that are connecting roads as they are: from a
        lane that forks to one that merges.

        The lane before such a chain and the one after it stay whole at that end. So
        where these two are linked directly, and neither could be cut, the chains from
        the one before are no connecting roads.
        """
        through = {
            chain
            for chain in self.chains
            if sum(self.length[name] for name in chain) <= LONGEST
            and self.lanes.in_degree(chain[0]) == 1 == self.lanes.out_degree(chain[-1])
            and self.is_junction(self.before(chain), chain[0])
            and self.is_junction(chain[-1], self.after(chain))
        }
        while True:
            whole_tails = {self.chain_of[self.before(chain)] for chain in through}
            whole_heads = {self.chain_of[self.after(chain)] for chain in through}
            clashing = {
                before
                for before, after in self.links
                if before in whole_tails and after in whole_heads
            }
            undone = {
                chain
                for chain in through
                if self.chain_of[self.before(chain)] in clashing
            }
            if not undone:
                return through
            through -= undone

    def cut_ends(
        self,
        links: list[tuple[Chain, Chain]],
        through: set[Chain],
    ) -> tuple[dict[Chain, Span], dict[Chain, Span]]:
        """The heads and the tails that are cut off chains, so that each of `links` has
        a piece; `through` are connecting roads as they are.

        A chain that leads to one lane loses its tail; of any other link the next chain
        loses its head, or, where that has to stay whole, the chain before its tail. A
        piece that serves one link is the whole lane where the chain has more.
        """
        whole_heads = {after for before, after in self.links if before in through}
        tailed = [
            self.lanes.out_degree(before[-1]) == 1 or after in whole_heads
            for before, after in links
        ]
        heads: dict[Chain, Span] = {}
        tails: dict[Chain, Span] = {}
        for (_, after), tail in zip(links, tailed, strict=True):
            if not tail:
                alone = len(after) > 1 and self.lanes.in_degree(after[0]) == 1
                heads[after] = Span(after[0], 0.0, end=self.cut(after[0], alone))
        for (before, _), tail in zip(links, tailed, strict=True):
            if tail:
                lane = before[-1]
                whole_head = (
                    before in heads and heads[before].end == self.length[before[0]]
                )
                alone = (
                    len(before) - whole_head > 1 and self.lanes.out_degree(lane) == 1
                )
                end = self.length[lane]
                tails[before] = Span(lane, end - self.cut(lane, alone), end=end)
        return heads, tails

    def cut(self, lane: str, alone: bool) -> float:
        """Length [m] of a lane's piece; alone: it serves one link."""
        length = self.length[lane]
        return length if alone and length <= LONGEST else min(CUT, MOST_CUT * length)


def junctions_of(connecting: dict[str, Link]) -> list[list[str]]:
    """Returns the connecting roads of each junction: those that share an end with each
    other."""
    graph = nx.Graph()
    for road, (before, after) in connecting.items():
        graph.add_edge(("road", road), ("end", before))
        graph.add_edge(("road", road), ("start", after))
    return sorted(
        sorted(name for kind, name in part if kind == "road")
        for part in nx.connected_components(graph)
    )
