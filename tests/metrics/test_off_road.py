"""Off the road against shapely on random maps, and the rule's own corner cases."""

import numpy as np
import pytest
import torch

from e2rl.metrics.off_road import Points, Segments, in_seam, inside_polygon, near_lane
from tests.metrics.random_rollouts import random_map
from tests.metrics.test_contact import course, row

shapely = pytest.importorskip("shapely")


def doubles(rollouts, seed):
    road = random_map(rollouts, 60.0, generator=torch.Generator().manual_seed(seed))
    return {
        key: value.double() if value.is_floating_point() else value
        for key, value in road.items()
    }


def random_points(count, rollouts, seed):
    draw = torch.rand(
        count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return (draw[:, :2] - 0.5) * 200, (draw[:, 2] * rollouts).long()


def parts(road, name, rollout, minimum):
    index = road[f"{name}_index"][rollout]
    lists = [
        road[f"{name}_points"][rollout][index == line].numpy()
        for line in index[index >= 0].unique()
    ]
    return [
        (line, points)
        for line, points in zip(index[index >= 0].unique().tolist(), lists, strict=True)
        if len(points) >= minimum
    ]


def test_distance_to_lanes_is_shapely_s():
    road = doubles(4, 1)
    points, rollout = random_points(6000, 4, seed=2)
    near = near_lane(Points(points, rollout), road).numpy()
    for index in range(4):
        chosen = (rollout == index).numpy()
        expected = np.zeros(chosen.sum(), bool)
        for line, lane in parts(road, "lane", rollout=index, minimum=2):
            reach = road["lane_width"][index, line].item() / 2 + 1.0
            where = shapely.points(points[chosen].numpy())
            expected |= shapely.distance(shapely.LineString(lane), where) <= reach
        np.testing.assert_array_equal(near[chosen], expected)
        assert 0.05 < expected.mean() < 0.95


def test_inside_overlapping_polygons_is_shapely_s():
    road = doubles(5, 3)
    points, rollout = random_points(6000, 5, seed=4)
    polygons = Segments.polygons(road)
    inside = inside_polygon(Points(points, rollout), polygons).numpy()
    for index in range(5):
        chosen = (rollout == index).numpy()
        where = shapely.points(points[chosen].numpy())
        expected = np.zeros(chosen.sum(), bool)
        for _, ring in parts(road, "drivable", rollout=index, minimum=3):
            expected |= shapely.contains(shapely.Polygon(ring), where)
        np.testing.assert_array_equal(inside[chosen], expected)


def test_a_vehicle_off_the_road_at_the_start_is_left_out():
    ego = course(0, 0, heading=0, speed=10)
    stays = course(50, 0, heading=0, speed=10)
    parked = course(0, 40, heading=0, speed=0)
    leaves = course(100, 0, heading=0.5, speed=10)
    result = row(ego, stays, parked)
    assert (result["aor_step"], result["aor_any"], result["aor_left_out"]) == (0, 0, 1)
    result = row(ego, stays, leaves)
    expected = (leaves[0][1:, 1].abs() > 3.0).double().mean().item() / 2
    assert result["aor_step"] == pytest.approx(expected)
    assert result["aor_any"] == 1
    only_parked = row(ego, parked)
    assert np.isnan(only_parked["aor_step"])
    assert only_parked["aor_vehicle_steps"] == 0


def test_the_ego_leaves_the_road_or_not_and_is_unknown_where_it_starts_beside_it():
    other = course(50, 0, heading=0, speed=10)
    leaves = course(0, 0, heading=0.5, speed=10)
    stays = course(0, 0, heading=0, speed=10)
    beside = course(0, 40, heading=0, speed=10)
    assert (row(leaves, other)["ego_off_road"], row(stays, other)["ego_off_road"]) == (
        1,
        0,
    )
    assert np.isnan(row(beside, other)["ego_off_road"])


@pytest.mark.parametrize(
    ("gap", "on"), [(0.0, True), (1e-6, True), (0.05, True), (0.3, True), (1.0, False)]
)
def test_a_seam_between_polygons_is_theirs_and_an_outer_border_is_none(gap, on):
    square = torch.tensor(
        [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]], dtype=torch.float64
    )
    polygons = torch.cat([square, square + torch.tensor([10.0 + gap, 0.0])])[None]
    index = torch.arange(2).repeat_interleave(4)[None]
    points = torch.tensor(
        [[10.0 + gap / 2, 5.0], [-0.1, 5.0], [5.0, 10.1]], dtype=torch.float64
    )
    assert in_seam(
        Points(points, torch.zeros(3, dtype=torch.long)),
        Segments.of(polygons, index, closed=True),
    ).tolist() == [on, False, False]
