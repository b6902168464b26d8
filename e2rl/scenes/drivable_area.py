"""Look-up of the drivable field: metres beyond the border of the drivable area (docs/method.md, section 1).

The drivable area as a field: distance beyond its border, on a 1 m grid around the ego's recorded path.
"""

import numpy as np
import torch
from matplotlib.path import Path
from scipy.spatial import cKDTree
from torch import Tensor

CELL = 1.0  # m
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's largest value
INSIDE = 1.0  # m: cells at least this deep inside one lane are not compared with others
TILE = 8  # cells, the side of the squares that are searched first


def drivable_field(
    lines: list[np.ndarray], widths: np.ndarray, polygons: list[np.ndarray], center: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Field [cells, cells] float16 of m beyond the border (negative inside), and the centre [2] of its cell (0, 0).

    A point is off the road when it lies outside every polygon and farther than half the width + MARGIN from every lane
    centreline (lines: points every 1 m). Outside the field is exact to 0.1 m (the points' spacing, widths in steps of
    0.1 m); inside it is at most the depth, since each shape is taken by itself.
    """
    origin = center - (cells - 1) / 2 * CELL
    x, y = origin[:, None] + np.arange(cells) * CELL
    field = np.full((cells, cells), FAR)
    if lines:
        # One search per width, the widest first: the nearest line is not always the one whose border is nearest.
        width = np.round(np.repeat(widths, [len(line) for line in lines]), 1)
        points = np.concatenate(lines)
        for each in np.unique(width)[::-1]:
            _lower(field, x, y, points[width == each], each / 2 + MARGIN)
    for ring in polygons:
        rows, columns = _near(x, y, ring, FAR)
        near = np.stack(np.meshgrid(x[rows], y[columns], indexing="ij"), -1)
        if near.size:
            cell = near.reshape(-1, 2)
            border = _border_distance(ring, cell)
            signed = np.where(Path(ring).contains_points(cell), -border, border).reshape(near.shape[:2])
            field[rows, columns] = np.minimum(field[rows, columns], signed)
    return field.astype(np.float16), origin


def _near(x: np.ndarray, y: np.ndarray, points: np.ndarray, reach: float) -> tuple[slice, slice]:
    """The cells, at x [G] and y [G], within `reach` m of the bounding box of points [P, 2]."""
    low, high = points.min(0) - reach, points.max(0) + reach
    return (
        slice(np.searchsorted(x, low[0], "left"), np.searchsorted(x, high[0], "right")),
        slice(np.searchsorted(y, low[1], "left"), np.searchsorted(y, high[1], "right")),
    )


def _lower(field: np.ndarray, x: np.ndarray, y: np.ndarray, points: np.ndarray, reach: float) -> None:
    """Lower the field [G, G] of cells at x [G], y [G] to the distance from points [P, 2] less `reach`, where that is
    less; in place, without the cells that are at least INSIDE already.

    The distance from a tile's middle bounds that of its cells, so cells which cannot change are not searched.
    """
    rows, columns = _near(x, y, points, FAR + reach)
    part, x, y = field[rows, columns], x[rows], y[columns]
    if not part.size:
        return
    tree = cKDTree(points, compact_nodes=False, balanced_tree=False)
    middle, radius = (TILE - 1) / 2 * CELL, (TILE - 1) / 2 * CELL * np.sqrt(2) + 1e-6
    tiles = np.stack(np.meshgrid(x[::TILE] + middle, y[::TILE] + middle, indexing="ij"), -1)
    least = tree.query(tiles, distance_upper_bound=FAR + reach + radius)[0] - radius - reach
    least = least.repeat(TILE, 0).repeat(TILE, 1)[: len(x), : len(y)]
    i, j = ((part > -INSIDE) & (least < part)).nonzero()
    distance = tree.query(np.stack([x[i], y[j]], -1), distance_upper_bound=FAR + reach)[0]
    part[i, j] = np.minimum(part[i, j], distance - reach)


def _border_distance(ring: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance [Q] of points [Q, 2] from a closed ring: to the two segments that meet at its nearest dense vertex."""
    closed = np.concatenate([ring, ring[:1]])
    sides = []  # of points at most 0.5 m apart
    for a, b in zip(closed[:-1], closed[1:], strict=True):
        sides.append(np.linspace(a, b, max(int(np.ceil(np.linalg.norm(b - a) / 0.5)), 1), endpoint=False))
    dense = np.concatenate(sides)
    index = cKDTree(dense).query(points)[1]
    best = np.full(len(points), np.inf)
    for a, b in ((dense[index - 1], dense[index]), (dense[index], dense[(index + 1) % len(dense)])):
        along = b - a
        t = ((points - a) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
        best = np.minimum(best, np.linalg.norm(points - a - np.clip(t, 0, 1)[:, None] * along, axis=1))
    return best


def off_road(points: Tensor, field: Tensor, origin: Tensor, row: Tensor | None = None) -> Tensor:
    """Metres [B, ...] that points [B, ..., 2] lie beyond the drivable border; negative inside.

    field [B, G, G]: value at cells of CELL m, first index along x; origin [B, 2]: centre of cell (0, 0). Bilinear
    between cell centres, FAR outside the grid. row [B] int64: which rows of larger field and origin the points are on;
    default: each its own. Differentiable in the points; the cost does not depend on them.
    """
    batch, cells = points.shape[0], field.shape[-1]
    origin = origin if row is None else origin[row]
    cell = (points - origin.view(batch, *[1] * (points.ndim - 2), 2)) / CELL
    outside = ((cell < 0) | (cell > cells - 1)).any(-1)
    low = cell.detach().floor().clamp(0, cells - 2)
    share = (cell - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long()
    four = index[..., None] + torch.arange(2, device=index.device) * cells  # rows x and x + 1 of the cell
    four = four[..., None] + torch.arange(2, device=index.device)
    if row is None:
        value = field.flatten(1).gather(1, four.view(batch, -1))
    else:  # without a copy of the fields
        value = field.flatten().take(four.view(batch, -1) + row[:, None] * cells**2)
    value = value.view(four.shape).to(points.dtype)
    sx, sy = share[..., 0], share[..., 1:]
    value = (1 - sy) * value[..., 0] + sy * value[..., 1]
    return ((1 - sx) * value[..., 0] + sx * value[..., 1]).masked_fill(outside, FAR)


def off_road_at(x: Tensor, y: Tensor, field: Tensor, origin: Tensor) -> Tensor:
    """`off_road` of points x, y [B, K], apart as compiled code wants them."""
    cells, values = field.shape[-1], field.flatten(1)
    x, y = ((value - origin[:, axis, None]) / CELL for axis, value in enumerate((x, y)))
    outside = (torch.minimum(x, y) < 0) | (torch.maximum(x, y) > cells - 1)
    low_x, low_y = (value.floor().clamp(0, cells - 2) for value in (x, y))
    index, sx, sy = (low_x * cells + low_y).long(), (x - low_x).clamp(0, 1), (y - low_y).clamp(0, 1)
    first, second, third, fourth = (
        values.gather(1, index + row * cells + column).to(x.dtype) for row in (0, 1) for column in (0, 1)
    )
    return torch.lerp(torch.lerp(first, second, sy), torch.lerp(third, fourth, sy), sx).masked_fill(outside, FAR)
