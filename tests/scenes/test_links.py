"""Links and neighbours of lanes: kept where a vehicle can drive them, inferred by the
end of a lane, adjacent."""

import numpy as np
import pytest

from e2rl.scenes import links
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.links import drivable_exits
from e2rl.scenes.recording import Lane


def flat(
    begin,
    end,
    height: float | None = None,
    **more,
) -> Lane:
    """A straight lane at one height."""
    return Lane(
        np.array([begin, end], float),
        heights=None if height is None else np.full(2, height),
        **more,
    )


def pieces(exits: dict[str, list[str]], count: int = 5) -> dict[str, Lane]:
    """A road of two lanes towards +x, each cut into pieces of 40 m."""
    return {
        f"{row}_{k}": flat(
            [40 * k, 3.5 * row],
            [40 * k + 40, 3.5 * row],
            exits=exits.get(f"{row}_{k}", []),
        )
        for row in range(2)
        for k in range(count)
    }


def test_connectivity_is_inferred_from_geometry_and_heights():
    followers, _ = drivable_exits(
        {
            "a": flat([0, 0], [50, 0], height=5.0),
            "b": flat([50.5, 0.3], [90, 0], height=5.5),
            "back": flat([50, 0], [0, 0], height=5.0),
            "bridge": flat([50, 0], [100, 10], height=12.0),
            "far": flat([54, 0], [90, 0], height=5.0),
            "side": flat([50, 0], [50, 50], height=5.0),
        }
    )
    assert followers["a"] == ["b"]
    assert followers["bridge"] == []
    assert followers["back"] == []
    no_heights, _ = drivable_exits(
        {
            "a": Lane(np.array([[0.0, 0], [50, 0]])),
            "b": flat([50, 0], [90, 0], height=40.0),
        }
    )
    assert no_heights["a"] == ["b"]
    doubled = {
        "a": Lane(np.array([[0.0, 5], [0, 50], [0, 50]])),
        "b": Lane(np.array([[0.0, 50], [0, 50], [0, 90]])),
    }
    assert drivable_exits(doubled)[0] == {"a": ["b"], "b": []}


def test_lanes_that_begin_together_do_not_follow_each_other_however_short():
    short = {
        "in": flat([-40, 0], [0, 0]),
        "a": flat([0, 0], [1, 0.1]),
        "b": flat([0, 0], [1, -0.1]),
    }
    assert drivable_exits(short)[0] == {"in": ["a", "b"], "a": [], "b": []}


CONNECTED = {(f"{row}_{k}", f"{row}_{k + 1}") for row in range(2) for k in range(4)}


@pytest.mark.parametrize(
    ("exits", "repairs"),
    [
        ({}, {links.INFERRED: 8}),
        ({"1_4": ["gone"]}, {links.ABSENT: 1, links.INFERRED: 8}),
        ({"1_0": ["1_0"]}, {links.ITSELF: 1, links.INFERRED: 8}),
        ({"1_0": ["1_1", "1_1"]}, {links.INFERRED: 7}),
        ({"0_4": ["0_0"]}, {links.UNDRIVABLE: 1, links.INFERRED: 8}),
        (
            {
                f"{row}_{k}": [f"0_{k + 1}", f"1_{k + 1}"]
                for row in range(2)
                for k in range(4)
            },
            {links.UNDRIVABLE: 8},
        ),
    ],
    ids=[
        "none",
        "dangling",
        "itself",
        "one",
        "160 m behind",
        "every lane of the next road",
    ],
)
def test_a_map_with_bad_or_missing_links_is_connected_as_its_geometry_is(
    exits, repairs
):
    graph = LaneGraph(pieces(exits))
    assert set(graph.graph.edges) == CONNECTED
    assert graph.repairs == repairs


def test_a_lane_with_a_recorded_link_gets_no_other():
    """Where a map is connected, a lane that merely begins nearby is none of the
    successors."""
    lanes = pieces(
        {f"{row}_{k}": [f"{row}_{k + 1}"] for row in range(2) for k in range(4)}
    )
    lanes["drive"] = flat([41, 0.3], [60, 5])
    graph = LaneGraph(lanes)
    assert set(graph.graph.edges) == CONNECTED
    assert not graph.repairs


@pytest.mark.parametrize(
    ("begin", "end", "height", "drivable"),
    [
        ([40, 0], [80, 0], 0, True),
        ([44, 0.5], [80, 0], 0, True),
        ([37, -0.5], [80, 0], 0, True),
        ([40, 0], [70, 25], 0, True),  # 40 degrees
        ([40, 0], [40, 40], 0, False),
        ([40, 0], [0, 0.5], 0, False),
        ([40, 3.5], [80, 3.5], 0, False),
        ([55, 0], [95, 0], 0, False),
        ([20, 0], [60, 0], 0, False),
        ([40, 0], [80, 0], 6, False),  # on the bridge above
    ],
)
def test_a_link_is_kept_where_a_vehicle_can_drive_it(
    begin,
    end,
    height,
    drivable,
):
    lanes = {
        "a": flat(
            [0, 0],
            [40, 0],
            height=0.0,
            exits=["b"],
        ),
        "b": flat(begin, end, height=float(height)),
    }
    graph = LaneGraph(lanes)
    assert list(graph.graph.edges) == [("a", "b")] * drivable
    assert graph.repairs == ({} if drivable else {links.UNDRIVABLE: 1})


def test_the_neighbour_is_the_adjacent_lane_in_whatever_order_they_are_named():
    y = {"right": -3.5, "own": 0.0, "left": 3.5, "far": 7.0}
    lanes = {name: flat([0, at], [100, at]) for name, at in y.items()}
    lanes["oncoming"] = flat([100, 3.0], [0, 3.0])
    lanes["own"].left, lanes["own"].right = (
        ["oncoming", "far", "left", "right"],
        ["far", "right"],
    )
    lanes["left"].left = ["gone", "far"]
    lanes["right"].left = ["far"]  # 10.5 m away, with two lanes between
    graph = LaneGraph(lanes)
    assert (graph.lanes["own"].left, graph.lanes["own"].right) == (["left"], ["right"])
    assert graph.lanes["left"].left == ["far"]
    assert graph.lanes["right"].left == []
    assert graph.repairs[links.NOT_ADJACENT] == 3
