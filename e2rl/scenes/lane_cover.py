"""How far cells lie beyond the lanes of a log: the part of the drivable field that
lanes make.

The plane is cut into tiles, each with the few lane points that can be nearest to one of
its cells.
"""

from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from e2rl.scenes.paths import (
    part_of,
    stacked,
)

CELL = 1.0  # m, the side of a cell
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's largest value
INSIDE = 1.0  # m: cells this deep inside one lane are not compared with narrower ones
TILE = 8  # cells, the side of a tile
HALF = TILE / 2 * CELL + 1e-6  # m from a tile's middle to its sides
RADIUS = TILE / 2 * CELL * np.sqrt(2) + 1e-5  # m from there to its corners


class NearPoints(NamedTuple):
    """Rows [R], one for each tile [R, 2] and reach, those of the most points first:
    `length` [R] points from `begin` [R] on in `point` [K]."""

    tile: ndarray
    begin: ndarray
    length: ndarray
    point: ndarray


class LaneCover:
    """The lanes of a log: points [P, 2] m every 1 m, the widest lanes first, and how
    far they reach [P] m."""

    def __init__(self, lines: list[ndarray], widths: ndarray) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m."""
        width = np.round(widths[part_of(lines)], 1)
        order = np.argsort(-width, kind="stable")
        self.points = stacked(lines)[order]
        self.reach = width[order] / 2 + MARGIN
        self.tree = cKDTree(self.points)

    def beyond(
        self,
        origin: ndarray,
        corner: ndarray,
        cells: int,
    ) -> ndarray:
        """Metres [cells, cells] beyond the lanes, negative on them, at most FAR.

        origin [2]: of the scene on the map; corner [2]: of its cell (0, 0). The widest
        lanes come first: where one of them is at least INSIDE deep, narrower ones do
        not count.
        """
        low, lead = np.divmod(np.floor(origin + corner).astype(int), TILE)
        size = -(-(lead + cells) // TILE)
        near = self._near(low, size)
        i, j = near.tile.T
        cell = np.arange(size.max() * TILE)[:, None] - lead
        x, y = (corner + cell * CELL).T.reshape(2, -1, TILE)
        px, py = (self.points - origin).T
        squared = np.full((len(i), TILE, TILE), np.inf)
        for k in range(near.length.max(initial=0)):
            # the first rows have more than k points
            rows = slice(np.searchsorted(-near.length, -k))
            point = near.point[near.begin[rows] + k]
            dx = x[i[rows]] - px[point, None]
            dy = y[j[rows]] - py[point, None]
            other = (dx * dx)[:, :, None] + (dy * dy)[:, None, :]
            np.minimum(squared[rows], other, out=squared[rows])
        field = np.full((*size, TILE, TILE), FAR)
        row_reach = self.reach[near.point[near.begin]]
        for reach in np.unique(row_reach)[::-1]:
            band = np.flatnonzero(row_reach == reach)
            old = field[i[band], j[band]]
            lower = np.minimum(old, np.sqrt(squared[band]) - reach)
            field[i[band], j[band]] = np.where(old > -INSIDE, lower, old)
        whole = field.swapaxes(1, 2).reshape(size * TILE)
        return whole[lead[0] : lead[0] + cells, lead[1] : lead[1] + cells]

    def _near(self, low: ndarray, size: ndarray) -> NearPoints:
        """The points that may matter in `size` [2] tiles from tile `low` [2] on.

        No point matters that is farther beyond than another in all of the tile, or to
        which those beside leave none.
        """
        tiles = np.indices(size.tolist()).reshape(2, -1).T
        middle = (low + tiles + 0.5) * TILE * CELL
        margin = self.reach.max(initial=0.0) + RADIUS
        distance, nearest = self.tree.query(middle, distance_upper_bound=FAR + margin)
        near = np.isfinite(distance)
        tiles = tiles[near]
        middle = middle[near]
        beyond = distance[near] - self.reach[nearest[near]] + RADIUS
        radius = np.clip(beyond, -INSIDE, FAR) + margin
        points = self.tree.query_ball_point(middle, radius, return_sorted=True)
        tile = part_of(points)
        point = np.fromiter(chain.from_iterable(points), int, len(tile))
        x, y = (middle[tile] - self.points[point]).T
        keep = np.ones(len(tile), bool)
        step = np.diff(self.points, axis=0) * (np.diff(self.reach) == 0)[:, None]
        none = np.zeros((min(len(self.points), 1), 2))
        after = np.concatenate([step, none])
        before = np.concatenate([none, -step])
        for side in (after, before):
            bound = (side**2).sum(1) / 2 + HALF * np.abs(side).sum(1) + 1e-9
            keep &= side[point, 0] * x + side[point, 1] * y <= bound[point]
        tile = tile[keep]
        point = point[keep]
        changes = np.diff(self.reach[point], prepend=0.0) != 0
        begin = np.flatnonzero(np.diff(tile, prepend=-1) | changes)
        count = np.diff(begin, append=len(tile))
        order = np.argsort(-count, kind="stable")
        begin = begin[order]
        return NearPoints(tiles[tile[begin]], begin, count[order], point=point)
