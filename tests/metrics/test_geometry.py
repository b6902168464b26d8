"""Areas and edge parts of oriented boxes against shapely and closed forms; pairs of
points and items against all pairs."""

import math

import numpy as np
import pytest
import torch

from e2rl.metrics import geometry
from e2rl.metrics.geometry import (
    edge_distances,
    edge_parts_inside,
    overlap_area,
    pair_overlap,
    pairs_where,
)
from e2rl.scenes.boxes import corners

shapely = pytest.importorskip("shapely")


def random_boxes(count, seed, spread=4.0):
    draw = torch.rand(
        count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    state = torch.stack(
        [draw[:, 0] * spread, draw[:, 1] * spread, draw[:, 2] * 7, draw[:, 3]], -1
    )
    return state, 0.3 + draw[:, 4:] * torch.tensor([6.0, 3.0], dtype=torch.float64)


def polygons(boxes):
    state, size = boxes
    return shapely.polygons(corners(state, size).numpy())


def test_overlap_area_is_shapely_s():
    first = random_boxes(4000, 1)
    second = random_boxes(4000, 2)
    expected = shapely.area(shapely.intersection(polygons(first), polygons(second)))
    state, size = first
    other, other_size = second
    area = overlap_area(state, size, second=other, second_size=other_size)
    assert (expected > 0).mean() > 0.4
    np.testing.assert_allclose(area, expected, atol=1e-9)
    apart = torch.zeros(4000, dtype=torch.bool)
    assert not pair_overlap(state, size, other, other_size, apart).any(), (
        "pairs that are not possible have no overlap"
    )
    np.testing.assert_allclose(
        pair_overlap(state, size, other, other_size, ~apart),
        np.where(expected > 1e-6, expected, 0),
        atol=1e-9,
    )


@pytest.mark.parametrize("turn", [0.0, 0.3, math.pi / 2, math.pi, 2.5])
def test_shared_and_collinear_edges_need_no_special_case(turn):
    size = torch.tensor([4.0, 2.0], dtype=torch.float64)
    state = torch.tensor([3.0, -1.0, turn, 0.0], dtype=torch.float64)
    forward = torch.tensor([math.cos(turn), math.sin(turn), 0, 0], dtype=torch.float64)
    for shift, expected in ((0.0, 8.0), (1.0, 6.0), (4.0, 0.0), (5.0, 0.0)):
        other = state + shift * forward
        assert overlap_area(
            state, size, second=other, second_size=size
        ).item() == pytest.approx(expected, abs=1e-9)
    assert overlap_area(
        state, size, second=state, second_size=size / 2
    ).item() == pytest.approx(2.0, abs=1e-9)


def test_edge_parts_are_shapely_s():
    first = random_boxes(600, 3)
    second = random_boxes(600, 4)
    state, size = first
    centre, other_size = second
    parts = edge_parts_inside(state, size, other=centre, other_size=other_size)
    corner = corners(state, size).numpy()
    other = polygons(second)
    point = shapely.points(centre[:, :2].numpy())
    away = edge_distances(state, size, centre[:, :2])
    for edge in range(4):
        line = shapely.linestrings(corner[:, [edge, (edge + 1) % 4]])
        np.testing.assert_allclose(
            parts[:, edge], shapely.length(shapely.intersection(line, other)), atol=1e-9
        )
        np.testing.assert_allclose(
            away[:, edge], shapely.distance(line, point), atol=1e-9
        )


@pytest.mark.parametrize("at_once", [1, 7, 10_000])
def test_pairs_are_those_of_all_points_and_items(monkeypatch, at_once):
    monkeypatch.setattr(geometry, "PART", at_once)
    generator = torch.Generator().manual_seed(5)
    points = 40 * torch.rand(60, 2, generator=generator)
    group = torch.randint(3, (60,), generator=generator)
    low = 40 * torch.rand(50, 2, generator=generator)
    high = low + 9 * torch.rand(50, 2, generator=generator)
    item_group = torch.randint(3, (50,), generator=generator)

    def within(point, item):
        inside = (points[point] >= low[item]) & (points[point] <= high[item])
        return inside.all(-1)

    pairs = pairs_where(
        within,
        points,
        group,
        low=low,
        high=high,
        item_group=item_group,
        cell=4.0,
    )
    inside = (points[:, None] >= low) & (points[:, None] <= high)
    expected = inside.all(-1) & (group[:, None] == item_group)
    assert expected.sum() > 10
    found = torch.zeros_like(expected)
    found[pairs] = True
    assert len(pairs[0]) == expected.sum()
    assert torch.equal(found, expected)
