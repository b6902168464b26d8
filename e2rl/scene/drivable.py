"""The drivable area as a field: distance beyond its border, on a 1 m grid around the ego's recorded path."""

import numpy as np
from matplotlib.path import Path
from scipy.spatial import cKDTree

CELL = 1.0  # m
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's largest value
INSIDE = 1.0  # m: cells at least this deep inside one lane are not compared with others


def drivable_field(
    lines: list[np.ndarray], widths: np.ndarray, polygons: list[np.ndarray], center: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Field [cells, cells] float16 of m beyond the border (negative inside), and the centre [2] of its cell (0, 0).

    A point is off the road when it lies outside every polygon and farther than half the width + MARGIN from every lane
    centreline (lines: points every 1 m). Outside the field is exact to 0.1 m (the points' spacing, widths in steps of
    0.1 m); inside it is at most the depth, since each shape is taken by itself.
    """
    origin = center - (cells - 1) / 2 * CELL
    axis = np.arange(cells) * CELL
    grid = np.stack(np.meshgrid(origin[0] + axis, origin[1] + axis, indexing="ij"), -1).reshape(-1, 2)
    field = np.full(len(grid), FAR)
    if lines:
        # One search per width, the widest first: the nearest line is not always the one whose border is nearest.
        width = np.round(np.repeat(widths, [len(line) for line in lines]), 1)
        points = np.concatenate(lines)
        for each in np.unique(width)[::-1]:
            reach, own = each / 2 + MARGIN, points[width == each]
            unsettled = np.flatnonzero(_within(grid, own, FAR + reach) & (field > -INSIDE))
            distance = cKDTree(own).query(grid[unsettled], distance_upper_bound=FAR + reach)[0]
            field[unsettled] = np.minimum(field[unsettled], distance - reach)
    for ring in polygons:
        near = np.flatnonzero(_within(grid, ring, FAR))
        if len(near):
            inside = Path(ring).contains_points(grid[near])
            border = _border_distance(ring, grid[near])
            field[near] = np.minimum(field[near], np.where(inside, -border, border))
    return field.reshape(cells, cells).astype(np.float16), origin


def _within(grid: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Which grid points [Q, 2] lie within `reach` m of the bounding box of points [P, 2]."""
    return (grid >= points.min(0) - reach).all(1) & (grid <= points.max(0) + reach).all(1)


def _border_distance(ring: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance [Q] of points [Q, 2] from a closed ring: to the two segments that meet at its nearest dense vertex."""
    dense = _dense(ring)
    index = cKDTree(dense).query(points)[1]
    best = np.full(len(points), np.inf)
    for a, b in ((dense[index - 1], dense[index]), (dense[index], dense[(index + 1) % len(dense)])):
        along = b - a
        t = ((points - a) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
        best = np.minimum(best, np.linalg.norm(points - a - np.clip(t, 0, 1)[:, None] * along, axis=1))
    return best


def _dense(ring: np.ndarray) -> np.ndarray:
    """Points at most 0.5 m apart along a closed ring."""
    closed = np.concatenate([ring, ring[:1]])
    sides = []
    for a, b in zip(closed[:-1], closed[1:], strict=True):
        sides.append(np.linspace(a, b, max(int(np.ceil(np.linalg.norm(b - a) / 0.5)), 1), endpoint=False))
    return np.concatenate(sides)
