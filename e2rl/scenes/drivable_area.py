"""The drivable area as a field, metres beyond its border on a 1 m grid, and its look-up
(docs/reference/scenes.md)."""

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.lane_cover import (
    CELL,
    FAR,
    RADIUS,
    TILE,
    LaneCover,
)

DENSE = 0.5  # m at most between the points of a polygon's border
SEAM = 0.2  # m from the borders of two polygons: what lies between them is theirs


class DrivableArea:
    """The drivable area of a log, of which scenes have fields.

    A point is off the road when it lies outside every polygon and farther than half the
    width + MARGIN from every lane centreline. Polygons that adjoin with a seam, as many
    maps draw them, are one: cells within SEAM of two are inside.
    """

    def __init__(
        self,
        lines: list[ndarray],
        widths: ndarray,
        polygons: list[ndarray],
    ) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m; polygons: [P, 2] each."""
        self.lanes = LaneCover(lines, widths)
        self.polygons = polygons

    def field(
        self,
        origin: ndarray,
        center: ndarray,
        cells: int,
    ) -> tuple[ndarray, ndarray]:
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
            _lower(
                field,
                near,
                x=x,
                y=y,
                ring=polygon - origin,
            )
        seam = near > 1
        field[seam] = np.minimum(field[seam], -SEAM)
        return field.astype(np.float16), corner


def _near(
    x: ndarray,
    y: ndarray,
    ring: ndarray,
    reach: float,
) -> tuple[slice, slice]:
    """The cells, at x [G] and y [G], within `reach` m of the bounding box of a ring [P,
    2]."""
    low = ring.min(0) - reach
    high = np.nextafter(ring.max(0) + reach, np.inf)
    rows = slice(*np.searchsorted(x, [low[0], high[0]]))
    return rows, slice(*np.searchsorted(y, [low[1], high[1]]))


def _lower(
    field: ndarray,
    near: ndarray,
    *,
    x: ndarray,
    y: ndarray,
    ring: ndarray,
) -> None:
    """Lower the field [G, G] of cells at x [G], y [G] to the distance beyond a polygon
    [P, 2], and count in `near` [G, G] the cells within SEAM of its border, both in
    place.

    The distance from a tile's middle bounds that of its cells, so cells outside which
    cannot change are not searched.
    """
    part = _near(
        x,
        y,
        ring,
        FAR,
    )
    x = x[part[0]]
    y = y[part[1]]
    beyond = field[part]
    if not beyond.size:
        return
    dense = _dense(ring)
    tree = cKDTree(dense)
    cell = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    middle = cell[::TILE, ::TILE] + (TILE - CELL) / 2
    least = tree.query(middle)[0] - RADIUS - DENSE / 2
    least = least.repeat(TILE, 0).repeat(TILE, 1)[: len(x), : len(y)]
    inside = np.zeros(beyond.shape, bool)
    box = _near(
        x,
        y,
        ring,
        0.0,
    )
    from matplotlib.path import Path  # only where scenes are built

    within = Path(ring).contains_points(cell[box].reshape(-1, 2))
    inside[box] = within.reshape(inside[box].shape)
    change = inside | (least < beyond)
    border = _border_distance(dense, tree, points=cell[change])
    signed = np.where(inside[change], -border, border)
    beyond[change] = np.minimum(beyond[change], signed)
    near[part][change] += border <= SEAM


def _dense(ring: ndarray) -> ndarray:
    """A closed ring [P, 2] with points at most DENSE apart."""
    side = np.concatenate([ring[1:], ring[:1]]) - ring
    length = np.sqrt(np.vecdot(side, side))
    count = np.maximum(np.ceil(length / DENSE), 1).astype(int)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(count.sum()) - first) / np.repeat(count, count)
    return np.repeat(ring, count, 0) + share[:, None] * np.repeat(side, count, 0)


def _border_distance(
    dense: ndarray,
    tree: cKDTree,
    points: ndarray,
) -> ndarray:
    """Distance [Q] of points [Q, 2] from a closed ring: to the two segments that meet
    at its nearest dense vertex."""
    index = tree.query(points)[1]
    best = np.full(len(points), np.inf)
    for start in (index - 1, index):
        offset = points - dense[start]
        along = dense[(start + 1) % len(dense)] - dense[start]
        t = (offset * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
        gap = offset - np.clip(t, 0, 1)[:, None] * along
        best = np.minimum(best, np.linalg.norm(gap, axis=1))
    return best


def off_road(
    points: Tensor,
    field: Tensor,
    origin: Tensor,
    row: Tensor | None = None,
) -> Tensor:
    """Returns the metres [B, ...] that points lie beyond the drivable border, negative
    inside: bilinear between cell centres, FAR outside the grid.

    Differentiable in the points; the cost does not depend on them.

    Args:
        points: [B, ..., 2] m.
        field: [F, G, G] value at cells of CELL m, first index along x.
        origin: [F, 2] m, centre of cell (0, 0).
        row: [B] int64, which field each is on; default: each its own.
    """
    row = torch.arange(points.shape[0], device=points.device) if row is None else row
    flat = off_road_rows(
        points.flatten(1, -2),
        field,
        origin,
        row,
    )
    return flat.view(points.shape[:-1])


@fused(
    "R K 2",
    "F G G:float16",
    "F 2",
    "R:int64",
)
def off_road_rows(
    points: Tensor,
    field: Tensor,
    origin: Tensor,
    row: Tensor,
) -> Tensor:
    """`off_road` [R, K] of points [R, K, 2] on fields row [R].

    Args:
        points, field, origin, row: see `off_road`.
    """
    cells = field.shape[-1]
    cell = (points - origin[row][:, None]) / CELL
    outside = ((cell < 0) | (cell > cells - 1)).any(-1)
    low = cell.detach().floor().clamp(0, cells - 2)
    share = (cell - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long() + row[:, None] * cells**2
    step = torch.arange(2, device=index.device)
    four = index[..., None] + step * cells  # rows x and x + 1 of the cell
    four = four[..., None] + step
    value = field.flatten()[four].to(points.dtype)
    sx = share[..., 0]
    sy = share[..., 1:]
    value = (1 - sy) * value[..., 0] + sy * value[..., 1]
    return ((1 - sx) * value[..., 0] + sx * value[..., 1]).masked_fill(outside, FAR)


def off_road_at(
    x: Tensor,
    y: Tensor,
    field: Tensor,
    origin: Tensor,
) -> Tensor:
    """`off_road` of points x, y, apart as compiled code wants them.

    Args:
        x, y: [B, K] m.
        field, origin: see `off_road`; a field for each row.
    """
    cells = field.shape[-1]
    values = field.flatten(1)
    x = (x - origin[:, 0, None]) / CELL
    y = (y - origin[:, 1, None]) / CELL
    outside = (torch.minimum(x, y) < 0) | (torch.maximum(x, y) > cells - 1)
    low_x = x.floor().clamp(0, cells - 2)
    low_y = y.floor().clamp(0, cells - 2)
    index = (low_x * cells + low_y).long()
    sx = (x - low_x).clamp(0, 1)
    sy = (y - low_y).clamp(0, 1)

    def row(offset: int) -> Tensor:
        first = values.gather(1, index + offset).to(x.dtype)
        second = values.gather(1, index + offset + 1).to(x.dtype)
        return torch.lerp(first, second, sy)

    return torch.lerp(row(0), row(cells), sx).masked_fill(outside, FAR)
