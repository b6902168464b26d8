"""Route candidates on a road that forks: every branch once, from where the vehicle is,
to where the map ends."""

import math

import numpy as np
import pytest
import torch
from shapely.geometry import LineString, Point

from e2rl.scenes.lane_graph import LaneGraph, against_lanes
from e2rl.scenes.log_route import MARGIN, route_from_log
from e2rl.scenes.recording import Lane
from e2rl.scenes.route import SPACING

ARC = np.linspace(-np.pi / 2, 0, 16)
LEFT = np.concatenate(
    [np.stack([100 + 20 * np.cos(ARC), 20 + 20 * np.sin(ARC)], 1), [[120.0, 320.0]]]
)


def lanes(**more) -> dict[str, Lane]:
    """`in` along x = 0..100; `on` straight to 400 and `left`, an arc of 20 m radius up
    to y = 320, both after it."""
    return {
        "in": Lane(
            np.array([[0.0, 0], [50, 0], [100, 0]]),
            3.5,
            speed_limit=14.0,
            exits=["on", "left"],
        ),
        "on": Lane(np.array([[100.0, 0], [400, 0]]), 3.5, speed_limit=20.0),
        "left": Lane(LEFT, 3.5, speed_limit=10.0),
        **more,
    }


def ways(
    graph: LaneGraph,
    x: float,
    speed: float = 8.0,
    y: float = 0.0,
    heading: float = 0.0,
) -> list[tuple]:
    """Lanes of the candidates of a vehicle."""
    routes = graph.candidates(np.array([x, y, heading, speed]), 6, vertices=150)
    return [tuple(name for name, _ in route.lanes) for route in routes]


@pytest.mark.parametrize("x", [40.0, 60.0, 95.0])
def test_every_branch_is_a_candidate_from_anywhere_on_the_lane(x):
    assert ways(LaneGraph(lanes()), x) == [("in", "on"), ("in", "left")]


def test_a_route_follows_its_lanes_and_ends_where_the_map_does():
    graph = LaneGraph(lanes())
    on, left = graph.candidates(np.array([60.0, 0.5, 0.05, 8.0]), 6, vertices=150)
    assert on.vehicle_s == left.vehicle_s == 20.0
    assert on.length == 298.0
    assert not on.open
    assert np.allclose(on.points[:, 1], 0, atol=1e-6)
    assert np.allclose(np.diff(on.points[:, 0]), SPACING, atol=1e-6)
    true = LineString([(40, 0), (100, 0), *LEFT])
    inside = left.points[: int(left.length / SPACING) + 1]
    assert max(true.distance(Point(point)) for point in inside) < 0.25
    assert [name for name, _ in left.lanes] == ["in", "left"]
    assert abs(left.lanes[1][1] - 60.0) < 0.5
    assert on.limit[10] == 14.0
    assert on.limit[40] == 20.0
    assert left.limit[40] == 10.0
    late = graph.candidates(np.array([250.0, 0.0, 0.0, 8.0]), 6, vertices=150)
    assert len(late) == 1
    assert late[0].open
    assert abs(late[0].length - 170.0) < 0.5
    assert np.allclose(
        late[0].points[-1], [230 + 298, 0], atol=1e-6
    )  # beyond the end it goes on straight


def test_the_map_does_not_end_where_a_long_lane_began_far_behind():
    long = {
        "a": Lane(np.array([[-400.0, 0], [0, 0]]), exits=["b"]),
        "b": Lane(np.array([[0.0, 0], [400, 0]]), exits=[]),
    }
    (route,) = LaneGraph(long).candidates(
        np.array([-5.0, 0.0, 0.0, 8.0]), 6, vertices=150
    )
    assert not route.open
    assert route.length == 298.0


def test_twice_the_same_way_is_one_candidate_and_neighbours_are_more():
    twin = lanes(
        again=Lane(np.array([[0.0, 0.3], [100, 0.3]]), exits=["on"]),
        beside=Lane(np.array([[0.0, 3.5], [400, 3.5]])),
    )
    assert ways(LaneGraph(twin), 60.0) == [("in", "on"), ("in", "left"), ("beside",)]
    assert ways(LaneGraph(twin), 60.0, heading=np.pi) == []
    assert ways(LaneGraph(twin), 60.0, y=-30.0) == []


def test_a_roundabout_is_left_and_a_ring_does_not_end():
    quarter = [np.linspace(k * np.pi / 2, (k + 1) * np.pi / 2, 20) for k in range(4)]
    ring = {
        f"r{k}": Lane(
            np.stack([15 * np.cos(a), 15 * np.sin(a)], 1), exits=[f"r{(k + 1) % 4}"]
        )
        for k, a in enumerate(quarter)
    }
    (route,) = LaneGraph(ring).candidates(
        np.array([15.0, 0.5, np.pi / 2, 5.0]), 6, vertices=150
    )
    assert not route.open
    assert np.abs(np.linalg.norm(route.points[:-8], axis=1) - 15).max() < 0.3
    ring["r1"].exits.append("out")
    ring["out"] = Lane(np.array([[-15.0, 0], [-16, -20], [-16, -320]]))
    ends = [
        way[-1]
        for way in ways(
            LaneGraph(ring),
            15.0,
            y=0.5,
            heading=np.pi / 2,
            speed=5.0,
        )
    ]
    assert ends == ["out", "out"] or ends == ["out"]


def test_a_lane_that_begins_before_the_last_one_ends_does_not_turn_the_route_back():
    overlapping = {
        "a": Lane(np.array([[0.0, 0], [100, 0]]), exits=["b"]),
        "b": Lane(np.array([[96.0, 0.3], [400, 0.3]])),
    }
    (route,) = LaneGraph(overlapping).candidates(
        np.array([60.0, 0.0, 0.0, 8.0]), 1, vertices=150
    )
    assert (np.diff(route.points[:, 0]) > 1.5).all()
    assert np.abs(np.diff(route.points[:, 1])).max() < 0.3


def lane_change() -> np.ndarray:
    """A track [81, 4] at 5 m/s from y = 0 to y = 3.5 between x = 20 and x = 60."""
    x = 20 + 0.5 * np.arange(81)
    y = 3.5 * (1 - np.cos(np.pi * (x - 20) / 40)) / 2
    return np.stack(
        [x, y, np.arctan2(np.gradient(y), np.gradient(x)), np.full(81, 5.0)], -1
    )


def test_a_recorded_way_goes_on_along_the_lane_at_its_end():
    graph = LaneGraph(
        lanes(
            beside=Lane(np.array([[0.0, 3.5], [100, 3.5], [200, 3.5]]), speed_limit=9.0)
        )
    )
    route = route_from_log(graph, lane_change(), vertices=150)
    line = LineString(route.points)
    assert route.vehicle_s == 20.0
    assert max(line.distance(Point(point)) for point in lane_change()[:, :2]) < 0.1
    assert route.open
    assert abs(route.length - 200.0) < 3.0
    assert np.allclose(route.points[60:, 1], 3.5, atol=1e-3)
    assert [name for name, _ in route.lanes] == ["in", "beside"]
    assert route.limit[5] == 14.0
    assert route.limit[60] == 9.0


def test_a_recorded_way_off_the_map_ends_soon_after_the_recording():
    track = lane_change() + [0, 100, 0, 0]
    route = route_from_log(LaneGraph(lanes()), track, vertices=150)
    way = np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1).sum()
    assert route.open
    assert abs(route.length - (20 + way + MARGIN)) < 0.5
    assert route.lanes == []
    standing = np.tile([5.0, 100.0, 0.3, 0.0], (81, 1))
    route = route_from_log(LaneGraph(lanes()), standing, vertices=150)
    assert route.open
    assert abs(route.length - 30.0) < 1e-6
    assert np.isfinite(route.points).all()
    assert np.allclose(route.points[10], [5, 100], atol=0.01)


X = torch.arange(0.0, 40.0, 2.0)
ROAD = torch.cat(
    [torch.stack([X, 0 * X], -1), torch.stack([X.flip(0), 0 * X + 3.5], -1)]
)[None]
LANE = torch.arange(2).repeat_interleave(len(X))[None]
AHEAD = torch.tensor([[[0.0, math.pi, math.pi / 2]]])


def against(y):
    return against_lanes(
        ROAD,
        LANE,
        xy=torch.tensor([[[20.0, y]]]),
        heading=AHEAD,
    )[0, 0].tolist()


def test_a_vehicle_is_against_the_lanes_where_none_runs_with_it():
    assert against(0.0) == [False, True, False]
    assert against(3.5) == [True, False, False]
    assert (
        against(1.75) == against(-9.0) == [False, False, False]
    )  # between two lanes, or off them
    assert against(1.9) == [
        True,
        False,
        False,
    ]  # nearer to the other lane, though still within reach of its own


def test_a_lane_that_crosses_is_no_lane_to_drive_along():
    slope = torch.tensor([[[20.0, 3.5]]]) + torch.linspace(-10, 10, 21)[
        None, :, None
    ] * torch.tensor([1.0, 1.0])
    points = torch.cat([ROAD, slope], 1)
    lane = torch.cat([LANE, torch.full((1, 21), 2)], 1)
    assert against_lanes(
        points,
        lane,
        xy=torch.tensor([[[20.0, 3.4]]]),
        heading=AHEAD,
    )[0, 0].tolist() == [True, False, False]


def test_the_gap_between_two_lanes_in_the_list_is_no_lane():
    far = ROAD.clone()
    far[:, len(X) :, 1] = 100.0  # the list jumps from (38, 0) to (38, 100)
    middle = against_lanes(
        far,
        LANE,
        xy=torch.tensor([[[38.0, 50.0]]]),
        heading=torch.tensor([[[-math.pi / 2]]]),
    )
    assert not middle.any()


def test_nobody_drives_against_anything_where_nobody_is():
    none = torch.zeros(0, 3, 2), torch.zeros(0, 3, 4)
    assert against_lanes(ROAD[:0], LANE[:0], *none).shape == (0, 3, 4)
