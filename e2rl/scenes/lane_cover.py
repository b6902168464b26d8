"""How far cells lie beyond the lanes of a log: the part of the drivable field that
lanes make.

The plane is cut into tiles, each with the few lane points that can be nearest to one of
its cells: they are found once for all scenes of a log.
"""

from itertools import chain

import numpy as np
from scipy.spatial import cKDTree

CELL = 1.0  # m, the side of a cell
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's largest value
INSIDE = 1.0  # m: cells at least this deep inside one lane are not compared with narrower ones
TILE, AROUND = (
    8,
    8,
)  # cells, the side of a tile; tiles around a second scene of a log that are looked at with it
HALF, RADIUS = (
    TILE / 2 * CELL + 1e-6,
    TILE / 2 * CELL * np.sqrt(2) + 1e-5,
)  # m from a tile's middle to its border


class LaneCover:
    """The lanes of a log: points [P, 2] m every 1 m, the widest lanes first, and how
    far they reach [P] m."""

    def __init__(self, lines: list[np.ndarray], widths: np.ndarray) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m."""
        width = np.round(np.repeat(widths, [len(line) for line in lines]), 1)
        order = np.argsort(-width, kind="stable")
        self.points = np.concatenate([np.zeros((0, 2)), *lines])[order]
        self.reach = width[order] / 2 + MARGIN
        self.low = self.high = np.zeros(
            2, int
        )  # of the tiles [low, high) that were looked at: none yet

    def beyond(self, origin: np.ndarray, corner: np.ndarray, cells: int) -> np.ndarray:
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
        x, y = (
            corner + (np.arange(size.max() * TILE)[:, None] - lead) * CELL
        ).T.reshape(2, -1, TILE)
        squared = self._squared(rows, x[i], y=y[j], origin=origin)
        reach = self.reach[self.point[self.begin[rows]]]
        field = np.full((*size, TILE, TILE), FAR)
        for each in np.unique(reach)[::-1]:
            which = np.flatnonzero(reach == each)
            old = field[i[which], j[which]]
            new = np.sqrt(squared[which]) - each
            field[i[which], j[which]] = np.where(
                old > -INSIDE, np.minimum(old, new), old
            )
        return field.swapaxes(1, 2).reshape(size * TILE)[
            lead[0] : lead[0] + cells, lead[1] : lead[1] + cells
        ]

    def _squared(
        self, rows: np.ndarray, x: np.ndarray, y: np.ndarray, origin: np.ndarray
    ) -> np.ndarray:
        """m^2 [R, TILE, TILE] from the nearest point of each row to its cells at x, y
        [R, TILE] from the origin."""
        (px, py), begin, count = (
            (self.points - origin).T,
            self.begin[rows],
            self.count[rows],
        )
        least = np.full((len(rows), TILE, TILE), np.inf)
        other = np.empty((len(rows), TILE, TILE))
        for k in range(count.max(initial=0)):
            some = np.searchsorted(-count, -k)  # the first rows have more than k points
            point = self.point[begin[:some] + k]
            dx = x[:some] - px[point, None]
            dy = y[:some] - py[point, None]
            np.add((dx * dx)[:, :, None], (dy * dy)[:, None, :], out=other[:some])
            np.minimum(least[:some], other[:some], out=least[:some])
        return least

    def _look(self, low: np.ndarray, high: np.ndarray) -> None:
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
        more = self.reach.max(initial=0.0) + RADIUS
        distance, nearest = tree.query(
            (tiles + 0.5) * TILE * CELL, distance_upper_bound=FAR + more
        )
        tiles, distance, nearest = (
            values[np.isfinite(distance)] for values in (tiles, distance, nearest)
        )
        middle = (tiles + 0.5) * TILE * CELL
        most = np.clip(distance - self.reach[nearest] + RADIUS, -INSIDE, FAR)
        found = tree.query_ball_point(middle, most + more, return_sorted=True)
        of = np.repeat(np.arange(len(tiles)), [len(points) for points in found])
        point = np.fromiter(chain.from_iterable(found), int, len(of))
        (x, y), keep = (middle[of] - self.points[point]).T, np.ones(len(of), bool)
        step = np.diff(self.points, axis=0) * (np.diff(self.reach) == 0)[:, None]
        for side in (np.pad(step, ((0, 1), (0, 0))), np.pad(-step, ((1, 0), (0, 0)))):
            bound = (side**2).sum(1) / 2 + HALF * np.abs(side).sum(1) + 1e-9
            keep &= side[point, 0] * x + side[point, 1] * y <= bound[point]
        of = of[keep]
        self.point = point[keep]
        begin = np.flatnonzero(
            np.diff(of, prepend=-1)
            | (np.diff(self.reach[self.point], prepend=0.0) != 0)
        )
        count = np.diff(begin, append=len(of))
        order = np.argsort(-count, kind="stable")
        self.tile = tiles[of[begin]][order]
        self.begin = begin[order]
        self.count = count[order]
