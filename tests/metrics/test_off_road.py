"""Off the road against shapely on random maps, and the rule's own corner cases."""

import numpy as np
import pytest
import torch

from e2rl.metrics.geometry import candidates
from e2rl.metrics.off_road import inside_polygon, near_lane, off_road_columns
from tests.metrics.random_rollouts import random_map
from tests.metrics.test_contact import course, row

shapely = pytest.importorskip("shapely")


def doubles(rollouts, seed):
    road = random_map(rollouts, 60.0, torch.Generator().manual_seed(seed))
    return {key: value.double() if value.is_floating_point() else value for key, value in road.items()}


def random_points(count, rollouts, seed):
    draw = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (draw[:, :2] - 0.5) * 200, (draw[:, 2] * rollouts).long()


def parts(road, name, rollout, minimum):
    index = road[f"{name}_index"][rollout]
    lists = [road[f"{name}_points"][rollout][index == line].numpy() for line in index[index >= 0].unique()]
    return [
        (line, points)
        for line, points in zip(index[index >= 0].unique().tolist(), lists, strict=True)
        if len(points) >= minimum
    ]


def test_distance_to_lanes_is_shapely_s():
    road, (points, rollout) = doubles(4, 1), random_points(6000, 4, 2)
    near = near_lane(points, rollout, road["lane_points"], road["lane_index"], road["lane_width"]).numpy()
    for index in range(4):
        chosen = (rollout == index).numpy()
        expected = np.zeros(chosen.sum(), bool)
        for line, lane in parts(road, "lane", index, 2):
            reach = road["lane_width"][index, line].item() / 2 + 1.0
            where = shapely.points(points[chosen].numpy())
            expected |= shapely.distance(shapely.LineString(lane), where) <= reach
        np.testing.assert_array_equal(near[chosen], expected)
        assert 0.05 < expected.mean() < 0.95


def test_inside_overlapping_polygons_is_shapely_s():
    road, (points, rollout) = doubles(5, 3), random_points(6000, 5, 4)
    inside = inside_polygon(points, rollout, road["drivable_points"], road["drivable_index"]).numpy()
    for index in range(5):
        chosen = (rollout == index).numpy()
        where = shapely.points(points[chosen].numpy())
        expected = np.zeros(chosen.sum(), bool)
        for _, ring in parts(road, "drivable", index, 3):
            expected |= shapely.contains(shapely.Polygon(ring), where)
        np.testing.assert_array_equal(inside[chosen], expected)


def test_a_closed_ring_and_an_open_one_are_the_same():
    square = torch.tensor([[0.0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], dtype=torch.float64)[None]
    points, rollout = (
        torch.tensor([[5.0, 5], [-1, 5], [11, 11]], dtype=torch.float64),
        torch.zeros(3, dtype=torch.int64),
    )
    index = torch.zeros(1, 5, dtype=torch.int64)
    opened = index.clone()
    opened[0, 4] = -1
    for ring in (index, opened):
        assert inside_polygon(points, rollout, square, ring).tolist() == [True, False, False]


def test_a_vehicle_off_the_road_at_the_start_is_left_out():
    ego, stays = course(0, 0, 0, 10), course(50, 0, 0, 10)
    parked, leaves = course(0, 40, 0, 0), course(100, 0, 0.5, 10)
    result = row(ego, stays, parked)
    assert (result["aor_step"], result["aor_any"], result["aor_left_out"]) == (0, 0, 1)
    result = row(ego, stays, leaves)
    expected = (leaves[0][1:, 1].abs() > 3.0).double().mean().item() / 2
    assert result["aor_step"] == pytest.approx(expected) and result["aor_any"] == 1
    only_parked = row(ego, parked)
    assert np.isnan(only_parked["aor_step"]) and only_parked["aor_vehicle_steps"] == 0


def test_the_ego_leaves_the_road_or_not_and_is_unknown_where_it_starts_beside_it():
    other = course(50, 0, 0, 10)
    leaves, stays, beside = course(0, 0, 0.5, 10), course(0, 0, 0, 10), course(0, 40, 0, 10)
    assert (row(leaves, other)["ego_off_road"], row(stays, other)["ego_off_road"]) == (1, 0)
    assert np.isnan(row(beside, other)["ego_off_road"])


def rollouts_on(road, states, valid):
    """A batch of traffic at states [B, T+1, N, 4] throughout."""
    stop = torch.full((len(states),), states.shape[1] - 1)
    return {"states": states, "valid": valid, "traffic": valid[:, 0], "stop": stop, **road}


def test_without_a_map_nothing_is_known():
    road = doubles(1, 5)
    road["lane_index"], road["drivable_index"] = road["lane_index"] * 0 - 1, road["drivable_index"] * 0 - 1
    states, valid = torch.zeros(1, 81, 3, 4, dtype=torch.float64), torch.ones(1, 81, 3, dtype=torch.bool)
    result = off_road_columns(rollouts_on(road, states, valid))
    assert result["aor_step"].isnan().all() and result["aor_any"].isnan().all()


def test_every_point_in_an_item_s_bounds_is_a_candidate_exactly_once():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(300, 2, generator=generator) * 50
    low = torch.rand(80, 2, generator=generator) * 60 - 5
    high = low + torch.rand(80, 2, generator=generator) * 20
    groups = torch.randint(3, (300,), generator=generator), torch.randint(3, (80,), generator=generator)
    found = list(
        zip(*(part.tolist() for part in candidates(points, groups[0], low, high, groups[1], 4.0)), strict=True)
    )
    inside = ((points[:, None] >= low) & (points[:, None] <= high)).all(-1) & (groups[0][:, None] == groups[1])
    assert len(found) == len(set(found))
    assert {tuple(pair) for pair in inside.nonzero().tolist()} <= set(found)
