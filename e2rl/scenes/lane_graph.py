"""The lane graph of a recording (networkx), route candidates of a vehicle on it, and
who drives against its lanes."""

from dataclasses import (
    dataclass,
    replace,
)
from heapq import (
    heappop,
    heappush,
)
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch
from numpy import ndarray
from scipy.ndimage import convolve1d
from scipy.spatial import cKDTree
from torch import Tensor

from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.links import (
    adjacent,
    drivable_exits,
    plausible_width,
)
from e2rl.scenes.paths import (
    arc_length,
    part_of,
    points_at,
    resample,
    stacked,
    tangent_angle,
    wrap,
)
from e2rl.scenes.recording import Lane
from e2rl.scenes.route import (
    BEHIND,
    SPACING,
)

START_RADIUS = 5.0  # m: lanes this close may be a vehicle's own
START_ANGLE = 0.8  # rad from their direction
START_WEIGHT = 2.5  # m of distance that a radian is worth
MAX_START_LANES = 6
MAX_BRANCHES = 4
AHEAD = 300.0  # m of route ahead of the vehicle
REACH_TIME = 5.0  # s in which a fork is reached, from REACH_REST m on
REACH_REST = 25.0
MIN_REACH, MAX_REACH = 40.0, 120.0  # m within which forks count
BUCKET = 20.0  # m, in steps of which distances are rounded up: vehicles share searches
SMOOTHING = 1.3  # vertices, standard deviation of the filter
SMOOTHED_ENDS = 6  # vertices, odd extension beyond the ends
# a Gaussian, to four standard deviations
FILTER = np.exp(-0.5 / (SMOOTHING * SMOOTHING) * np.arange(-5, 6) ** 2)
FILTER /= FILTER.sum()
SAME_GAP = 1.2  # m: routes closer than this at all probes are one
OVERLAP = 2.0  # m at most from the end of a lane back to where the next one lies ahead
PROBES = np.array([2, 8, 16, 28, 45])  # vertices ahead where routes are compared
LANE_REACH = 2.5  # m from a lane's centreline within which a vehicle is on it
ALONG = 0.866  # cosine of 30 degrees: between headings of a lane and who drives along


@dataclass
class Route:
    """A route along lanes.

    points [P, 2] every SPACING m; length: usable m of it; open: whether the map ends
    before the points do; lanes: (id, arc length where the lane begins); limit [P]:
    speed limit m/s at each vertex (0 unknown); vehicle_s: arc length of the vehicle
    that it was made for.
    """

    points: ndarray
    length: float
    open: bool
    lanes: list[tuple[str, float]]
    limit: ndarray
    vehicle_s: float = 0.0


class LanePath(NamedTuple):
    """Lanes one after another: their centreline [P, 2] and its arc lengths [P]; the arc
    lengths [lanes + 1] where the lanes begin and the last one ends."""

    line: ndarray
    arc: ndarray
    starts: ndarray


class LaneGraph:
    """Lanes of at least 0.5 m, connected, with a nearest-lane index.

    `graph` is the networkx DiGraph (nodes: lane ids; edges: successors); `line` and
    `arc` are a lane's centreline with points every 1 m and its length; `points`,
    `heading`, `lane_of` are the points of all centrelines, in order; `widths` [lanes]
    m; `named_beside`: the neighbours that the map names, which need not be adjacent;
    `repairs`: what was left out of the recorded links and neighbours or inferred, by a
    phrase in the plural.
    """

    def __init__(self, lanes: dict[str, Lane]):
        """lanes: by id; geometry decides which of their links and neighbours are kept
        (e2rl/scenes/links.py)."""
        long = {
            name: lane
            for name, lane in lanes.items()
            if len(lane.points) >= 2 and arc_length(lane.points)[-1] >= 0.5
        }
        self.line = {name: resample(lane.points, 1.0) for name, lane in long.items()}
        exits, links = drivable_exits(long)
        neighboured, neighbours = adjacent(long, self.line)
        self.lanes = {
            name: replace(lane, exits=exits[name]) for name, lane in neighboured.items()
        }
        self.repairs = links + neighbours
        self.named_beside = {
            name: {*lane.left, *lane.right} for name, lane in long.items()
        }
        self.widths = np.array([plausible_width(lane.width) for lane in long.values()])
        self.ids = list(self.lanes)
        self.number = {name: index for index, name in enumerate(self.ids)}
        self.graph = nx.DiGraph(exits)
        lines = self.line.values()
        self.arc = {
            name: float(arc_length(line)[-1]) for name, line in self.line.items()
        }
        self.points = stacked(lines)
        self.heading = np.concatenate([np.zeros(0), *map(tangent_angle, lines)])
        self.lane_of = part_of(lines)
        self.first_point = np.cumsum([0, *map(len, lines)])
        self.tree = cKDTree(self.points)
        self._nexts: dict[str, list[str]] = {}
        self._branches: dict[tuple[str, float, float], list[list[str]]] = {}
        self._paths: dict[tuple[str, ...], LanePath] = {}

    def near_lanes(
        self,
        position: ndarray,
        heading: float,
        away: ndarray | None = None,
    ) -> list[tuple[str, float]]:
        """(lane, arc length of its nearest point) of the lanes near a pose, best first,
        each once.

        away: bool [P], points of the graph that are on another level.
        """
        near = np.array(self.tree.query_ball_point(position, START_RADIUS), dtype=int)
        if away is not None:
            near = near[~away[near]]
        angle = np.abs(wrap(self.heading[near] - heading))
        near = near[angle < START_ANGLE]
        angle = angle[angle < START_ANGLE]
        distance = np.linalg.norm(self.points[near] - position, axis=1)
        starts: dict[str, float] = {}
        for point in near[np.lexsort((near, distance + START_WEIGHT * angle))]:
            lane = self.lane_of[point]
            name = self.ids[lane]
            spacing = self.arc[name] / (len(self.line[name]) - 1)
            starts.setdefault(name, float(point - self.first_point[lane]) * spacing)
        return list(starts.items())[:MAX_START_LANES]

    def turn(self, lane: str, successor: str) -> float:
        """Heading change [rad] from the end of a lane to the end of its successor."""
        first = self.line[lane][-1] - self.line[lane][-2]
        second = self.line[successor][-1] - self.line[successor][-2]
        angle = np.arctan2(second[1], second[0]) - np.arctan2(first[1], first[0])
        return abs(wrap(angle))

    def bend(self, name: str) -> float:
        """Heading change [rad] between both ends of a lane."""
        angle = tangent_angle(self.line[name])
        return abs(wrap(angle[-1] - angle[0]))

    def branches(
        self,
        lane: str,
        begin: float,
        reach: float,
    ) -> list[list[str]]:
        """Lane sequences for AHEAD m from arc length `begin` of `lane`, at most
        MAX_BRANCHES, the straightest first.

        They branch at the forks within `reach` m of `begin` (up to BUCKET more).
        Sequences that leave the straightest one least often come first, then those that
        leave it soonest. A lane is repeated only where no other follows.
        """
        fork_end = BUCKET * np.ceil((begin + reach) / BUCKET)
        end = BUCKET * np.ceil((begin + AHEAD) / BUCKET)
        key = (lane, fork_end, end)
        if key in self._branches:
            return self._branches[key]
        branches: list[list[str]] = []
        queue = [(0, 0.0, 0, [lane], self.arc[lane])]
        pushed = 0
        while queue and len(branches) < MAX_BRANCHES:
            turns, _, _, path, length = heappop(queue)
            while length < end and (nexts := self._successors(path)):
                for other in nexts[1:] if length < fork_end else ():
                    pushed += 1
                    after = length + self.arc[other]
                    heappush(queue, (turns + 1, length, pushed, [*path, other], after))
                path = [*path, nexts[0]]
                length = length + self.arc[nexts[0]]
            branches.append(path)
        self._branches[key] = branches
        return branches

    def _successors(self, path: list[str]) -> list[str]:
        """Successors of a path's last lane, the straightest first; lanes of the path
        only where there is no other."""
        last = path[-1]
        if last not in self._nexts:
            nexts = self.graph.successors(last)
            self._nexts[last] = sorted(nexts, key=lambda name: self.turn(last, name))
        nexts = self._nexts[last]
        return [name for name in nexts if name not in path] or nexts

    def behind(self, lane: str, length: float) -> list[str]:
        """Lanes before `lane`, of several the straightest, until `length` m are
        covered."""
        path = [lane]
        while length > 0:
            before = [
                name for name in self.graph.predecessors(path[0]) if name not in path
            ]
            if not before:
                break
            path.insert(0, min(before, key=self.bend))
            length -= self.arc[path[0]]
        return path[:-1]

    def path(self, lanes: list[str]) -> LanePath:
        """The centrelines of lanes one after another, without repeated points."""
        key = tuple(lanes)
        if key not in self._paths:
            line = _joined([self.line[name] for name in lanes])
            moves = np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.05
            if moves.any():
                line = line[np.concatenate([[True], moves])]
            starts = np.cumsum([0.0, *(self.arc[name] for name in lanes)])
            self._paths[key] = LanePath(line, arc_length(line), starts)
        return self._paths[key]

    def route(
        self,
        lanes: list[str],
        begin: float,
        vertices: int,
    ) -> Route:
        """The smoothed route along `lanes` from arc length `begin` of the first lane,
        `vertices` points long."""
        line, arc, starts = self.path(lanes)
        scale = arc[-1] / max(starts[-1], 1e-6)
        at = np.arange(vertices) * SPACING + begin * scale
        length = min(arc[-1] - begin * scale, (vertices - 1) * SPACING)
        limit = np.zeros(vertices, np.float32)
        lane_s = []
        for name, start in zip(lanes, starts[:-1] - begin, strict=True):
            limit[max(int(start // SPACING), 0) :] = self.lanes[name].speed_limit
            lane_s.append((name, float(start * scale)))
        return Route(
            points=smooth_vertices(points_at(line, arc, at=at)),
            length=float(length),
            open=bool(at[-1] > arc[-1]),
            lanes=lane_s,
            limit=limit,
        )

    def candidates(
        self,
        pose: ndarray,
        count: int,
        vertices: int,
        away: ndarray | None = None,
    ) -> list[Route]:
        """Returns route candidates of a vehicle, those of the nearest lane first.

        Along each lane near the vehicle, from BEHIND m before it to AHEAD m after it,
        on every branch of the forks that it may reach in REACH_TIME; routes that
        coincide are one.

        Args:
            pose: x, y [m], heading [rad], speed [m/s] of the vehicle.
            count: of candidates at most.
            vertices: of a route.
            away: bool [P], points of the graph that are on another level.
        """
        reach = REACH_TIME * pose[3] + REACH_REST
        reach = float(np.clip(reach, MIN_REACH, MAX_REACH))
        routes: list[Route] = []
        points = np.empty((count, vertices, 2))
        for lane, s in self.near_lanes(pose[:2], pose[2], away=away):
            behind = self.behind(lane, BEHIND - s)
            before = sum(self.arc[name] for name in behind)
            begin = max(before + s - BEHIND, 0.0)
            for branch in self.branches(lane, s, reach=reach):
                route = self.route([*behind, *branch], begin, vertices=vertices)
                route.vehicle_s = before + s - begin
                probes = PROBES + int(round(route.vehicle_s / SPACING))
                probe = route.points[np.clip(probes, 0, vertices - 1)]
                offset = probe[:, None] - points[: len(routes), None]
                squared = offset[..., 0] ** 2 + offset[..., 1] ** 2
                if not (np.sqrt(squared.min(-1).max(-1)) < SAME_GAP).any():
                    points[len(routes)] = route.points
                    routes.append(route)
                if len(routes) == count:
                    return routes
        return routes


def _joined(lines: list[ndarray]) -> ndarray:
    """The points of polylines one after another; where one begins before the end of the
    last, without what lies behind that end, so that the path never turns back."""
    parts = lines[:1]
    for line in lines[1:]:
        last = parts[-1][-1]
        ahead = (line - last) @ (last - parts[-1][-2]) > 0
        first = min(int(ahead.argmax()), len(line) - 2)
        overlaps = first > 1 and np.linalg.norm(line[first] - last) < OVERLAP
        parts.append(line[first:] if overlaps else line)
    return np.concatenate(parts)


def smooth_vertices(points: ndarray) -> ndarray:
    """Route vertices [P, 2], Gaussian smoothed with both ends in place (odd extension)."""
    pad = SMOOTHED_ENDS
    head = 2 * points[0] - points[pad:0:-1]
    tail = 2 * points[-1] - points[-2 : -pad - 2 : -1]
    return convolve1d(np.concatenate([head, points, tail]), FILTER, axis=0)[pad:-pad]


def packed(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Indices [B, S] of what is true in rows [B, M], filled up by 0, and bool [B, S]:
    which are no filling."""
    count = rows.sum(1)
    most = int(count.max()) if len(count) else 0
    filled = torch.arange(most, device=rows.device) < count[:, None]
    index = torch.zeros_like(filled, dtype=torch.long)
    return index.masked_scatter(filled, rows.nonzero()[:, 1]), filled


def against_lanes(
    points: Tensor,
    lane: Tensor,
    xy: Tensor,
    heading: Tensor,
) -> Tensor:
    """Returns whether vehicles drive against their lanes: of those along which they
    drive, in either direction, the nearest runs against them.

    Args:
        points: [B, M, 2] of centrelines.
        lane: [B, M] which one each point is of (-1: padding).
        xy: [B, K, 2] of vehicles.
        heading: [B, K, H] rad of each, several at once.

    Returns:
        Bool [B, K, H].
    """
    start = points[:, :-1]
    end = points[:, 1:]
    low = xy.amin(1, keepdim=True) - LANE_REACH
    high = xy.amax(1, keepdim=True) + LANE_REACH
    inside = ((start > low) & (start < high)).all(-1)
    inside &= (lane[:, 1:] == lane[:, :-1]) & (lane[:, 1:] >= 0)
    place, filled = packed(inside)  # maps are large, and vehicles in one part of them
    place = place[..., None].expand(-1, -1, 2)
    start = start.gather(1, place)
    end = end.gather(1, place)
    length = (end - start).norm(dim=-1).clamp(min=1e-6)
    ahead = (end - start) / length[..., None]
    near = (torch.cdist(xy, start) < LANE_REACH) & filled[:, None]
    b, k, segment = near.nonzero(as_tuple=True)  # few of them are near
    unit = ahead[b, segment]
    towards = unit_vectors(heading[b, k])
    cosine = (towards * unit[:, None]).sum(-1)
    offset = xy[b, k] - start[b, segment]
    along = (offset * unit).sum(-1).clamp(min=0).minimum(length[b, segment])
    gap = (offset - along[:, None] * unit).norm(dim=-1)[:, None].expand_as(cosine)
    row = (b * xy.shape[1] + k)[:, None].expand_as(cosine)

    def nearest(chosen: Tensor) -> Tensor:
        least = torch.full_like(heading, torch.inf).flatten(0, 1)
        gaps = gap.masked_fill(~chosen, torch.inf)
        return least.scatter_reduce(
            0,
            row,
            gaps,
            "amin",
        ).view_as(heading)

    return nearest(cosine < -ALONG) < nearest(cosine > ALONG)
