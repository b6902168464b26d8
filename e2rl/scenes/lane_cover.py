"""How far cells lie beyond the lanes of a log: the part of the drivable field that
lanes make.

The plane is cut into tiles, each with the few lane points that can be nearest to one of
its cells: they are found once for all scenes of a log.
"""

from itertools import chain

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
AROUND = 8  # tiles around a second scene of a log that are looked at with it
HALF = TILE / 2 * CELL + 1e-6  # m from a tile's middle to its sides
RADIUS = TILE / 2 * CELL * np.sqrt(2) + 1e-5  # m from there to its corners


class LaneCover:
    """The lanes of a log: points [P, 2] m every 1 m, the widest lanes first, and how
    far they reach [P] m."""

    def __init__(self, lines: list[ndarray], widths: ndarray) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m."""
        width = np.round(widths[part_of(lines)], 1)
        order = np.argsort(-width, kind="stable")
        self.points = stacked(lines)[order]
        self.reach = width[order] / 2 + MARGIN
        # of the tiles [low, high) that were looked at: none yet
        self.low = self.high = np.zeros(2, int)

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
        if (low < self.low).any() or (low + size > self.high).any():
            self._look(low, low + size)
        rows = np.flatnonzero(((self.tile >= low) & (self.tile < low + size)).all(1))
        i, j = (self.tile[rows] - low).T
        cell = np.arange(size.max() * TILE)[:, None] - lead
        x, y = (corner + cell * CELL).T.reshape(2, -1, TILE)
        squared = self._squared(
            rows,
            x[i],
            y=y[j],
            origin=origin,
        )
        row_reach = self.reach[self.point[self.begin[rows]]]
        field = np.full((*size, TILE, TILE), FAR)
        for reach in np.unique(row_reach)[::-1]:
            some = np.flatnonzero(row_reach == reach)
            old = field[i[some], j[some]]
            lower = np.minimum(old, np.sqrt(squared[some]) - reach)
            field[i[some], j[some]] = np.where(old > -INSIDE, lower, old)
        whole = field.swapaxes(1, 2).reshape(size * TILE)
        return whole[lead[0] : lead[0] + cells, lead[1] : lead[1] + cells]

    def _squared(
        self,
        rows: ndarray,
        x: ndarray,
        y: ndarray,
        origin: ndarray,
    ) -> ndarray:
        """m^2 [R, TILE, TILE] from the nearest point of each row to its cells at x, y
        [R, TILE] from the origin."""
        px, py = (self.points - origin).T
        begin = self.begin[rows]
        count = self.count[rows]
        least = np.full((len(rows), TILE, TILE), np.inf)
        other = np.empty_like(least)
        for k in range(count.max(initial=0)):
            some = np.searchsorted(-count, -k)  # the first rows have more than k points
            point = self.point[begin[:some] + k]
            dx = x[:some] - px[point, None]
            dy = y[:some] - py[point, None]
            np.add((dx * dx)[:, :, None], (dy * dy)[:, None, :], out=other[:some])
            np.minimum(least[:some], other[:some], out=least[:some])
        return least

    def _look(self, low: ndarray, high: ndarray) -> None:
        """Find the points that may matter in the tiles [low, high): rows, one for each
        tile and reach, of `tile` [R, 2] and `count` [R] points, the most first, from
        `begin` [R] on in `point` [K].

        No point matters that is farther beyond than another in all of the tile, or to
        which those beside leave none.
        """
        around = AROUND * int((self.low < self.high).all())
        self.low = low - around
        self.high = high + around
        tiles = np.mgrid[tuple(map(slice, self.low, self.high))].reshape(2, -1).T
        tree = cKDTree(self.points)
        margin = self.reach.max(initial=0.0) + RADIUS
        middle = (tiles + 0.5) * TILE * CELL
        distance, nearest = tree.query(middle, distance_upper_bound=FAR + margin)
        near = np.isfinite(distance)
        tiles = tiles[near]
        middle = middle[near]
        beyond = distance[near] - self.reach[nearest[near]] + RADIUS
        radius = np.clip(beyond, -INSIDE, FAR) + margin
        points = tree.query_ball_point(middle, radius, return_sorted=True)
        tile = part_of(points)
        point = np.fromiter(chain.from_iterable(points), int, len(tile))
        x, y = (middle[tile] - self.points[point]).T
        keep = np.ones(len(tile), bool)
        step = np.diff(self.points, axis=0) * (np.diff(self.reach) == 0)[:, None]
        for side in (np.pad(step, ((0, 1), (0, 0))), np.pad(-step, ((1, 0), (0, 0)))):
            bound = (side**2).sum(1) / 2 + HALF * np.abs(side).sum(1) + 1e-9
            keep &= side[point, 0] * x + side[point, 1] * y <= bound[point]
        tile = tile[keep]
        self.point = point[keep]
        changes = np.diff(self.reach[self.point], prepend=0.0) != 0
        begin = np.flatnonzero(np.diff(tile, prepend=-1) | changes)
        count = np.diff(begin, append=len(tile))
        order = np.argsort(-count, kind="stable")
        self.tile = tiles[tile[begin]][order]
        self.begin = begin[order]
        self.count = count[order]
