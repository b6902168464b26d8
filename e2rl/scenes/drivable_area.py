"""The drivable area as a field, metres beyond its border on a 1 m grid, and its look-up
(docs/method.md, section 1)."""

import numpy as np
import torch
from matplotlib.path import Path
from scipy.spatial import cKDTree
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.lane_cover import CELL, FAR, RADIUS, TILE, LaneCover

DENSE = 0.5  # m at most between the points of a polygon's border
SEAM = 0.2  # m from the borders of two polygons within which what lies between them is theirs


class DrivableArea:
    """The drivable area of a log, of which scenes have fields.

    A point is off the road when it lies outside every polygon and farther than half the
    width + MARGIN from every lane centreline. Polygons that adjoin with a seam, as many
    maps draw them, are one: cells within SEAM of two are inside.
    """

    def __init__(
        self, lines: list[np.ndarray], widths: np.ndarray, polygons: list[np.ndarray]
    ) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m; polygons: [P, 2] each."""
        self.lanes = LaneCover(lines, widths)
        self.polygons = polygons

    def field(
        self, origin: np.ndarray, center: np.ndarray, cells: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Field [cells, cells] float16 of m beyond the border (negative inside) around
        center [2] m from the scene's origin [2], and the centre [2] of its cell (0, 0).

        Outside the field is exact to 0.1 m (the points' spacing, widths in steps of 0.1
        m); inside it is at most the depth, since each shape is taken by itself.
        """
        corner = center - (cells - 1) / 2 * CELL
        x, y = corner[:, None] + np.arange(cells) * CELL
        field = self.lanes.beyond(origin, corner, cells)
        near = np.zeros(field.shape, np.int16)  # polygons whose border is within SEAM
        for polygon in self.polygons:
            _lower(field, near, x=x, y=y, ring=polygon - origin)
        seam = near > 1
        field[seam] = np.minimum(field[seam], -SEAM)
        return field.astype(np.float16), corner


def _near(
    x: np.ndarray, y: np.ndarray, points: np.ndarray, reach: float
) -> tuple[slice, slice]:
    """The cells, at x [G] and y [G], within `reach` m of the bounding box of points [P,
    2]."""
    ends = zip((x, y), points.min(0) - reach, points.max(0) + reach, strict=True)
    rows, columns = (
        slice(*np.searchsorted(axis, [low, np.nextafter(high, np.inf)]))
        for axis, low, high in ends
    )
    return rows, columns


def _lower(
    field: np.ndarray, near: np.ndarray, x: np.ndarray, y: np.ndarray, ring: np.ndarray
) -> None:
    """Lower the field [G, G] of cells at x [G], y [G] to the distance beyond a polygon
    [P, 2], and count in `near` [G, G] the cells within SEAM of its border, both in
    place.

    The distance from a tile's middle bounds that of its cells, so cells outside which
    cannot change are not searched.
    """
    rows, columns = _near(x, y, points=ring, reach=FAR)
    part = field[rows, columns]
    count = near[rows, columns]
    x = x[rows]
    y = y[columns]
    if not part.size:
        return
    tree = cKDTree(dense := _dense(ring))
    cell = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    least = tree.query(cell[::TILE, ::TILE] + (TILE - CELL) / 2)[0] - RADIUS - DENSE / 2
    least = least.repeat(TILE, 0).repeat(TILE, 1)[: len(x), : len(y)]
    inside = np.zeros(part.shape, bool)
    box = _near(x, y, points=ring, reach=0.0)
    inside[box] = (
        Path(ring).contains_points(cell[box].reshape(-1, 2)).reshape(inside[box].shape)
    )
    change = inside | (least < part)
    border = _border_distance(dense, tree, points=cell[change])
    part[change] = np.minimum(part[change], np.where(inside[change], -border, border))
    count[change] += border <= SEAM


def _dense(ring: np.ndarray) -> np.ndarray:
    """A closed ring [P, 2] with points at most DENSE apart."""
    side = np.concatenate([ring[1:], ring[:1]]) - ring
    count = np.maximum(np.ceil(np.sqrt(np.vecdot(side, side)) / DENSE), 1).astype(int)
    share = (
        np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    ) / np.repeat(count, count)
    return np.repeat(ring, count, 0) + share[:, None] * np.repeat(side, count, 0)


def _border_distance(
    dense: np.ndarray, tree: cKDTree, points: np.ndarray
) -> np.ndarray:
    """Distance [Q] of points [Q, 2] from a closed ring: to the two segments that meet
    at its nearest dense vertex."""
    index = tree.query(points)[1]
    best = np.full(len(points), np.inf)
    for a, b in (
        (dense[index - 1], dense[index]),
        (dense[index], dense[(index + 1) % len(dense)]),
    ):
        along = b - a
        t = ((points - a) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
        best = np.minimum(
            best, np.linalg.norm(points - a - np.clip(t, 0, 1)[:, None] * along, axis=1)
        )
    return best


def off_road(
    points: Tensor, field: Tensor, origin: Tensor, row: Tensor | None = None
) -> Tensor:
    """Metres [B, ...] that points [B, ..., 2] lie beyond the drivable border; negative
    inside.

    field [B, G, G]: value at cells of CELL m, first index along x; origin [B, 2]:
    centre of cell (0, 0). Bilinear between cell centres, FAR outside the grid. row [B]
    int64: which rows of larger field and origin the points are on; default: each its
    own. Differentiable in the points; the cost does not depend on them.
    """
    row = torch.arange(points.shape[0], device=points.device) if row is None else row
    return off_road_rows(points.flatten(1, -2), field, origin, row).view(
        points.shape[:-1]
    )


@fused("R K 2", "F G G:float16", "F 2", "R:int64")
def off_road_rows(points: Tensor, field: Tensor, origin: Tensor, row: Tensor) -> Tensor:
    """`off_road` [R, K] of points [R, K, 2] on fields row [R]."""
    cells = field.shape[-1]
    cell = (points - origin[row][:, None]) / CELL
    outside = ((cell < 0) | (cell > cells - 1)).any(-1)
    low = cell.detach().floor().clamp(0, cells - 2)
    share = (cell - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long() + row[:, None] * cells**2
    four = (
        index[..., None] + torch.arange(2, device=index.device) * cells
    )  # rows x and x + 1 of the cell
    four = four[..., None] + torch.arange(2, device=index.device)
    value = field.flatten()[four].to(points.dtype)
    sx = share[..., 0]
    sy = share[..., 1:]
    value = (1 - sy) * value[..., 0] + sy * value[..., 1]
    return ((1 - sx) * value[..., 0] + sx * value[..., 1]).masked_fill(outside, FAR)


def off_road_at(x: Tensor, y: Tensor, field: Tensor, origin: Tensor) -> Tensor:
    """`off_road` of points x, y [B, K], apart as compiled code wants them."""
    cells = field.shape[-1]
    values = field.flatten(1)
    x, y = ((value - origin[:, axis, None]) / CELL for axis, value in enumerate((x, y)))
    outside = (torch.minimum(x, y) < 0) | (torch.maximum(x, y) > cells - 1)
    low_x, low_y = (value.floor().clamp(0, cells - 2) for value in (x, y))
    index = (low_x * cells + low_y).long()
    sx = (x - low_x).clamp(0, 1)
    sy = (y - low_y).clamp(0, 1)
    first, second, third, fourth = (
        values.gather(1, index + row * cells + column).to(x.dtype)
        for row in (0, 1)
        for column in (0, 1)
    )
    return torch.lerp(
        torch.lerp(first, second, sy), torch.lerp(third, fourth, sy), sx
    ).masked_fill(outside, FAR)
