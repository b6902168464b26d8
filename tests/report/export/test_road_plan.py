"""Roads and junctions of a lane graph: every link is a way, every lane is covered,
every end has one partner."""

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from e2rl.report.export.road_plan import CUT, LONGEST, RoadPlan, road_plan
from e2rl.scenes.recording import Lane


def graph(length: float = 30.0, **exits: str) -> dict[str, Lane]:
    points = np.array([[0.0, 0.0], [length, 0.0]])
    return {name: Lane(points, exits=list(others)) for name, others in exits.items()}


def steps(plan: RoadPlan) -> set[tuple]:
    """(span, span) that follow each other, within a road or from road to road."""
    pairs = [
        pair
        for spans in plan.roads.values()
        for pair in zip(spans, spans[1:], strict=False)
    ]
    links = list(plan.plain)
    for name, (before, after) in plan.connecting.items():
        links += [(before, name), (name, after)]
    return set(pairs) | {(plan.roads[a][-1], plan.roads[b][0]) for a, b in links}


def test_a_crossing_s_connectors_are_one_junction():
    plan = road_plan(graph(a="xy", b="z", x="c", y="d", z="d", c="", d="e", e=""))
    assert plan.connecting == {"x": ("a", "c"), "y": ("a", "d"), "z": ("b", "d")}
    assert plan.plain == [("d", "e")]
    assert plan.junctions == [["x", "y", "z"]]


def test_a_turn_in_two_pieces_is_one_connecting_road():
    plan = road_plan(graph(a="xt", b="s", t="u", x="c", u="d", s="d", c="", d=""))
    assert [span.lane for span in plan.roads["t"]] == ["t", "u"]
    assert plan.connecting["t"] == ("a", "d")
    assert plan.junctions == [["s", "t", "x"]]


def test_lanes_that_fork_or_merge_directly_are_cut():
    plan = road_plan(graph(a="bc", b="d", c="d", d=""))
    assert plan.connecting == {"b": ("a", "d"), "c": ("a", "d")}  # whole lanes connect
    plan = road_plan(graph(length=2 * LONGEST, a="bc", b="d", c="d", d=""))
    assert plan.connecting == {
        "a to b": ("a", "b"),
        "a to c": ("a", "c"),
        "b to d": ("b", "d"),
        "c to d": ("c", "d"),
    }
    (core,) = plan.roads["b"]
    assert (core.begin, core.end) == (CUT, 2 * LONGEST - CUT)


@settings(max_examples=300, deadline=None)
@given(
    st.sets(
        st.tuples(st.sampled_from("abcdefgh"), st.sampled_from("abcdefgh")), max_size=16
    ),
    st.sampled_from([0.5, 30.0, 500.0]),
)
def test_every_link_is_a_way_and_every_end_has_at_most_one_partner(pairs, length):
    lanes = graph(
        length,
        **{
            name: "".join(b for a, b in sorted(pairs) if a == name)
            for name in "abcdefgh"
        },
    )
    plan = road_plan(lanes)
    between = set()
    within = Counter()
    for first, second in steps(plan):
        if first.end == length and second.begin == 0:
            between.add((first.lane, second.lane))
        else:  # a piece and the rest of its lane
            assert first.lane == second.lane
            assert first.end == second.begin
    assert between == pairs
    for span in {span for spans in plan.roads.values() for span in spans}:
        assert span.begin < span.end
        within[span.lane] += span.end - span.begin
    assert all(abs(within[name] - length) < 1e-9 for name in lanes)
    junction_of = {
        name: index for index, names in enumerate(plan.junctions) for name in names
    }
    assert set(junction_of) == set(plan.connecting)
    for name in plan.roads:
        into = {
            junction_of[road]
            for road, (before, _) in plan.connecting.items()
            if before == name
        }
        out_of = {
            junction_of[road]
            for road, (_, after) in plan.connecting.items()
            if after == name
        }
        assert len(into) + sum(a == name for a, _ in plan.plain) <= 1
        assert len(out_of) + sum(b == name for _, b in plan.plain) <= 1
        assert not (name in plan.connecting and (into or out_of))
