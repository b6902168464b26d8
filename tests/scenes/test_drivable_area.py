"""The drivable field against shapely: exact near the border from outside, right about inside everywhere."""

import numpy as np
import pytest
from shapely import contains_xy, distance, points
from shapely.geometry import LineString, Polygon
from shapely.ops import unary_union

from e2rl.scenes.drivable_area import FAR, MARGIN, drivable_field
from e2rl.scenes.paths import resample


def bent(seed: int) -> np.ndarray:
    """A wandering line [P, 2] of about 100 m through the grid's middle."""
    generator = np.random.default_rng(seed)
    heading = generator.uniform(0, 2 * np.pi) + np.cumsum(generator.normal(0, 0.15, 25))
    line = np.cumsum(4 * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    return line - line.mean(0) + generator.uniform(-15, 15, 2)


def compare(lines, widths, rings, cells: int = 121) -> None:
    dense = [resample(line, 1.0) for line in lines]
    field, origin = drivable_field(dense, np.array(widths), rings, np.array([3.3, -2.7]), cells)
    axis = np.arange(cells)
    x, y = (grid.ravel() for grid in np.meshgrid(origin[0] + axis, origin[1] + axis, indexing="ij"))
    shapes = [LineString(line).buffer(w / 2 + MARGIN, quad_segs=64) for line, w in zip(dense, widths, strict=True)]
    area = unary_union(shapes + [Polygon(ring) for ring in rings])
    beyond = distance(points(x, y), area)
    inside, depth = contains_xy(area, x, y), distance(points(x, y), area.boundary)
    found = field.astype(float).ravel()
    near = ~inside & (beyond < 5)
    assert near.sum() > 100 and inside.sum() > 100
    assert np.abs(found - beyond)[near].max() < 0.15
    assert (found[inside & (depth > 0.15)] < 0).all() and (found[inside] > -depth[inside] - 0.15).all()
    assert (found[~inside & (beyond > 0.15)] > 0).all() and found.max() <= FAR
    assert (found[beyond > FAR + 0.2] == FAR).all()


@pytest.mark.parametrize("seed", range(3))
def test_lanes_of_different_widths(seed):
    generator = np.random.default_rng(seed)
    compare([bent(seed), bent(seed + 10), bent(seed + 20)], generator.uniform(2.5, 6.0, 3), [])


def test_a_wide_lane_beside_a_narrow_one_counts():
    compare([np.array([[-50.0, 0], [50, 0]]), np.array([[-50.0, 2.0], [50, 2.0]])], [2.5, 6.0], [])


@pytest.mark.parametrize("seed", range(3))
def test_polygons_and_lanes_together(seed):
    angle = np.sort(np.random.default_rng(seed).uniform(0, 2 * np.pi, 9))
    star = 25 * np.stack([np.cos(angle), np.sin(angle)], 1)
    notched = np.array([[10.0, 10], [45, 10], [45, 40], [30, 40], [28, 20], [26, 40], [10, 40]])
    compare([bent(seed)], [3.7], [star - [20, 20], notched])
    compare([], [], [star, notched])


def test_nothing_is_drivable_on_an_empty_map():
    field, origin = drivable_field([], np.zeros(0), [], np.zeros(2), 11)
    assert (field == FAR).all() and origin.tolist() == [-5.0, -5.0]
