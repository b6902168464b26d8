"""How far cells lie beyond the lanes of a log: the part of the drivable field that lanes make.

What it takes to find the lane points near a cell is the same for all scenes of a log and is done once: the plane is cut
into tiles, and each tile has the few points that can be the nearest to one of its cells.
"""

from itertools import chain

import numpy as np
from scipy.spatial import cKDTree

CELL = 1.0  # m, the side of a cell
MARGIN = 1.0  # m beyond half the lane width that still counts as on the road
FAR = 10.0  # m, the field's largest value
INSIDE = 1.0  # m: cells at least this deep inside one lane are not compared with narrower ones
TILE = 8  # cells, the side of a tile
HALF, RADIUS = TILE / 2 * CELL + 1e-6, TILE / 2 * CELL * np.sqrt(2) + 1e-5  # m from a tile's middle to its border
AROUND = 8  # tiles beyond a second scene's for which points are chosen, too: scenes of a log are near each other


class LaneCover:
    """The lanes of a log: points [P, 2] m every 1 m, the widest lanes first, and how far they reach [P] m."""

    def __init__(self, lines: list[np.ndarray], widths: np.ndarray) -> None:
        """lines: of lanes, points every 1 m; widths [lanes] m."""
        width = np.round(np.repeat(widths, [len(line) for line in lines]), 1)
        order = np.argsort(-width, kind="stable")
        self.points = np.concatenate([np.zeros((0, 2)), *lines])[order]
        self.reach = width[order] / 2 + MARGIN
        self.low = self.high = np.zeros(2, int)  # of the tiles [low, high) whose points are chosen: none yet
        self.tree = cKDTree(self.points)

    def beyond(self, origin: np.ndarray, corner: np.ndarray, cells: int) -> np.ndarray:
        """Metres [cells, cells] beyond the lanes, negative on them, at most FAR.

        origin [2]: of the scene on the map; corner [2]: of its cell (0, 0). The widest lanes come first: where one of
        them is at least INSIDE deep, narrower ones do not count.
        """
        first = np.floor(origin + corner).astype(int)
        low = first // TILE
        lead = first - low * TILE
        count = -(-(lead + cells) // TILE)
        self._choose(low, low + count)
        rows = np.flatnonzero(((self.tile >= low) & (self.tile < low + count)).all(1))
        tile = self.tile[rows] - low
        axes = (np.arange(n * TILE).reshape(-1, TILE) for n in count)
        x, y = (at + (axis[row] - skip) * CELL for at, axis, row, skip in zip(corner, axes, tile.T, lead, strict=True))
        value = self._nearest(rows, x, y, origin)
        tiles, at = np.full((count.prod(), TILE, TILE), FAR), tile[:, 0] * count[1] + tile[:, 1]
        for rank in range(self.rank[rows].max(initial=-1) + 1):
            which = np.flatnonzero(self.rank[rows] == rank)
            so_far = tiles[at[which]]
            tiles[at[which]] = np.where(so_far > -INSIDE, np.minimum(so_far, value[which]), so_far)
        field = tiles.reshape(*count, TILE, TILE).swapaxes(1, 2).reshape(count * TILE)
        return field[lead[0] : lead[0] + cells, lead[1] : lead[1] + cells]

    def _nearest(self, rows: np.ndarray, x: np.ndarray, y: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Metres [R, TILE, TILE] from the nearest point of each row less its reach; x, y [R, TILE]: of its cells."""
        px, py = (self.points - origin).T
        begin, count = self.begin[rows], self.count[rows]
        squared, other = np.full((len(rows), TILE, TILE), np.inf), np.empty((len(rows), TILE, TILE))
        for k in range(count.max(initial=0)):
            some = np.searchsorted(-count, -k)  # the first rows have more than k points
            point = self.point[begin[:some] + k]
            dx, dy = x[:some] - px[point, None], y[:some] - py[point, None]
            np.add((dx * dx)[:, :, None], (dy * dy)[:, None, :], out=other[:some])
            np.minimum(squared[:some], other[:some], out=squared[:some])
        return np.sqrt(squared, out=squared) - self.reach[self.point[begin]][:, None, None]

    def _choose(self, low: np.ndarray, high: np.ndarray) -> None:
        """Choose the points of the tiles [low, high).

        Sets rows, one for each tile and reach, those of the most points first: `tile` [R, 2], `rank` [R] of the reach
        in the tile, and `count` [R] points from `begin` [R] on in `point` [K].
        """
        if (low >= self.low).all() and (high <= self.high).all():
            return
        around = AROUND * int((self.low < self.high).all())
        self.low, self.high = low - around, high + around
        axes = (np.arange(*ends) for ends in zip(self.low, self.high, strict=True))
        tiles = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        of, self.point = self._candidates((tiles + 0.5) * TILE * CELL)
        reach = self.reach[self.point]
        begin = np.flatnonzero(np.diff(of, prepend=-1) | np.diff(reach, prepend=0.0).astype(bool))
        count = np.diff(begin, append=len(of))
        lead = np.flatnonzero(np.diff(of[begin], prepend=-1))  # the first row of each tile
        rank = np.arange(len(begin)) - np.repeat(lead, np.diff(lead, append=len(begin)))
        order = np.argsort(-count, kind="stable")
        self.begin, self.count, self.rank, self.tile = begin[order], count[order], rank[order], tiles[of[begin]][order]

    def _candidates(self, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which tile [K], of those at middle [T, 2], has which point [K] that may matter there; both ascending.

        No point does that is farther beyond than another is in all of the tile, or to which its neighbours leave none.
        """
        more = self.reach.max(initial=0.0) + RADIUS
        distance, nearest = self.tree.query(middle, distance_upper_bound=FAR + more)
        near = np.flatnonzero(np.isfinite(distance))
        most = np.clip(distance[near] - self.reach[nearest[near]] + RADIUS, -INSIDE, FAR)
        found = self.tree.query_ball_point(middle[near], most + more, return_sorted=True)
        of = np.repeat(near, [len(points) for points in found])
        point = np.fromiter(chain.from_iterable(found), int, len(of))
        x, y = (middle[of] - self.points[point]).T
        step, keep = np.diff(self.points, axis=0) * (np.diff(self.reach) == 0)[:, None], np.ones(len(of), bool)
        for side in (np.pad(step, ((0, 1), (0, 0))), np.pad(-step, ((1, 0), (0, 0)))):
            bound = (side**2).sum(1) / 2 + HALF * np.abs(side).sum(1) + 1e-9
            keep &= side[point, 0] * x + side[point, 1] * y <= bound[point]
        return of[keep], point[keep]
