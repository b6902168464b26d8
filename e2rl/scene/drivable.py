"""The drivable area as a field: metres beyond its border, on a 1 m grid around the ego's way (design.md section 5)."""

import numpy as np
from matplotlib.path import Path
from scipy.spatial import cKDTree

CELL = 1.0  # m
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's cap


def drivable_field(
    lines: list[np.ndarray], widths: np.ndarray, polygons: list[np.ndarray], center: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Field [cells, cells] float16 and the centre [2] of its cell (0, 0).

    A point is off the road when it lies outside every polygon and farther than half the width + MARGIN from every lane
    centreline (lines: points every 1 m). The lane part is exact to the 1 m spacing of the points.
    """
    origin = center - (cells - 1) / 2 * CELL
    axis = np.arange(cells) * CELL
    grid = np.stack(np.meshgrid(origin[0] + axis, origin[1] + axis, indexing="ij"), -1).reshape(-1, 2)
    field = np.full(len(grid), FAR)
    if lines:
        reach = np.repeat(widths / 2 + MARGIN, [len(line) for line in lines])
        distance, index = cKDTree(np.concatenate(lines)).query(grid, k=4, distance_upper_bound=FAR + 4.0)
        reach = np.append(reach, 0.0)[index]
        field = np.minimum(field, np.where(np.isfinite(distance), distance - reach, FAR).min(1))
    for ring in polygons:
        low, high = ring.min(0) - FAR, ring.max(0) + FAR
        near = np.flatnonzero((grid >= low).all(1) & (grid <= high).all(1))
        if len(near):
            inside = Path(ring).contains_points(grid[near])
            border = cKDTree(_dense(ring)).query(grid[near])[0]
            field[near] = np.minimum(field[near], np.where(inside, -border, border))
    return field.reshape(cells, cells).astype(np.float16), origin


def _dense(ring: np.ndarray) -> np.ndarray:
    """Points at most 0.5 m apart along a closed ring."""
    closed = np.concatenate([ring, ring[:1]])
    parts = [np.linspace(a, b, max(int(np.linalg.norm(b - a) / 0.5), 1), endpoint=False)
             for a, b in zip(closed[:-1], closed[1:], strict=True)]
    return np.concatenate(parts)
