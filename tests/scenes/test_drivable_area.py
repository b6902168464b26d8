"""The drivable field against shapely: exact near the border from outside, right about
inside everywhere."""

import numpy as np
import pytest
import torch
from shapely import (
    contains_xy,
    distance,
    points,
)
from shapely.geometry import LineString, Polygon
from shapely.ops import unary_union

from e2rl.scenes.drivable_area import DrivableArea, off_road
from e2rl.scenes.lane_cover import FAR, MARGIN
from e2rl.scenes.paths import resample


def bent(seed: int) -> np.ndarray:
    """A wandering line [P, 2] of about 100 m through the grid's middle."""
    generator = np.random.default_rng(seed)
    heading = generator.uniform(0, 2 * np.pi) + np.cumsum(generator.normal(0, 0.15, 25))
    line = np.cumsum(4 * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    return line - line.mean(0) + generator.uniform(-15, 15, 2)


def compare(
    lines,
    widths,
    rings,
    cells: int = 121,
) -> None:
    dense = [resample(line, 1.0) for line in lines]
    field, origin = DrivableArea(dense, np.array(widths), polygons=rings).field(
        np.zeros(2), np.array([3.3, -2.7]), cells
    )
    axis = np.arange(cells)
    x, y = (
        grid.ravel()
        for grid in np.meshgrid(origin[0] + axis, origin[1] + axis, indexing="ij")
    )
    shapes = [
        LineString(line).buffer(w / 2 + MARGIN, quad_segs=64)
        for line, w in zip(dense, widths, strict=True)
    ]
    area = unary_union(shapes + [Polygon(ring) for ring in rings])
    beyond = distance(points(x, y), area)
    inside = contains_xy(area, x, y)
    depth = distance(points(x, y), area.boundary)
    values = field.astype(float).ravel()
    near = ~inside & (beyond < 5)
    assert near.sum() > 100
    assert inside.sum() > 100
    assert np.abs(values - beyond)[near].max() < 0.15
    assert (values[inside & (depth > 0.15)] < 0).all()
    assert (values[inside] > -depth[inside] - 0.15).all()
    assert (values[~inside & (beyond > 0.15)] > 0).all()
    assert values.max() <= FAR
    assert (values[beyond > FAR + 0.2] == FAR).all()


@pytest.mark.parametrize("seed", range(3))
def test_lanes_of_different_widths(seed):
    generator = np.random.default_rng(seed)
    compare(
        [bent(seed), bent(seed + 10), bent(seed + 20)],
        generator.uniform(2.5, 6.0, 3),
        rings=[],
    )


def test_a_wide_lane_beside_a_narrow_one_counts():
    compare(
        [np.array([[-50.0, 0], [50, 0]]), np.array([[-50.0, 2.0], [50, 2.0]])],
        [2.5, 6.0],
        rings=[],
    )


@pytest.mark.parametrize("seed", range(3))
def test_polygons_and_lanes_together(seed):
    angle = np.sort(np.random.default_rng(seed).uniform(0, 2 * np.pi, 9))
    star = 25 * np.stack([np.cos(angle), np.sin(angle)], 1)
    notched = np.array(
        [[10.0, 10], [45, 10], [45, 40], [30, 40], [28, 20], [26, 40], [10, 40]]
    )
    compare([bent(seed)], [3.7], rings=[star - [20, 20], notched])
    compare([], [], rings=[star, notched])


def test_bilinear_is_exact_on_planes():
    cells = torch.arange(20.0)
    plane = 0.1 * cells[:, None] - 0.2 * cells[None] + 1.0
    origin = torch.tensor([[-5.0, 3.0], [2.0, -1.0]])
    points = origin[:, None] + 19 * torch.rand(2, 50, 2)
    local = points - origin[:, None]
    expected = 0.1 * local[..., 0] - 0.2 * local[..., 1] + 1.0
    assert torch.allclose(
        off_road(points, plane.repeat(2, 1, 1), origin=origin), expected, atol=1e-5
    )


def test_outside_the_grid_is_far():
    points = torch.tensor([[[-0.1, 3.0], [3.0, 9.2], [9.0, 9.0]]])
    assert off_road(
        points, torch.zeros(1, 10, 10), origin=torch.zeros(1, 2)
    ).tolist() == [[FAR, FAR, 0.0]]


def test_points_may_name_the_row_of_their_field():
    torch.manual_seed(0)
    field = torch.randn(3, 12, 12).half()
    origin = torch.randn(3, 2)
    row = torch.tensor([2, 0, 2, 1])
    points = 12 * torch.rand(4, 7, 2)
    assert torch.equal(
        off_road(
            points,
            field,
            origin=origin,
            row=row,
        ),
        off_road(points, field[row], origin=origin[row]),
    )


@pytest.mark.parametrize("gap", [0.0, 1e-6, 0.05, 0.3])
def test_a_seam_between_polygons_is_inside_and_their_outer_border_stays(gap):
    """Wherever the seam lies on the grid."""
    for shift in (0.0, 0.25, 0.5):
        squares = [
            np.array([[x, -8.0], [x + 10 - gap, -8], [x + 10 - gap, 8], [x, 8]])
            + [gap / 2 + shift, 0.3]
            for x in (-20.0, -10.0, 0.0, 10.0)
        ]
        field, origin = DrivableArea([], np.zeros(0), polygons=squares).field(
            np.zeros(2), np.zeros(2), 61
        )
        x = torch.arange(-19.0, 19.0, 0.01)
        along = torch.stack([x, torch.zeros_like(x)], -1)
        assert (
            off_road(
                along[None],
                torch.tensor(field)[None],
                origin=torch.tensor(origin)[None].float(),
            )
            < 0
        ).all()
        outside = torch.stack([x, torch.full_like(x, 9.3)], -1)  # 1 m beyond
        beyond = off_road(
            outside[None],
            torch.tensor(field)[None],
            origin=torch.tensor(origin)[None].float(),
        )
        assert torch.allclose(beyond, torch.ones_like(beyond), atol=0.02)


def test_a_gap_wider_than_a_seam_stays_outside():
    squares = [
        np.array([[x, -8.0], [x + 8, -8], [x + 8, 8], [x, 8]]) for x in (-10.0, 2.0)
    ]
    field, origin = DrivableArea([], np.zeros(0), polygons=squares).field(
        np.zeros(2), np.zeros(2), 61
    )
    gap = torch.zeros(1, 1, 2)
    assert off_road(
        gap, torch.tensor(field)[None], origin=torch.tensor(origin)[None].float()
    ).item() == pytest.approx(2.0)
