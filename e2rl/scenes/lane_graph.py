"""The lane graph of a recording (networkx), route candidates of a vehicle on it, and
who drives against its lanes."""

from dataclasses import dataclass, replace
from heapq import heappop, heappush

import networkx as nx
import numpy as np
import torch
from scipy.ndimage import convolve1d
from scipy.spatial import cKDTree
from torch import Tensor

from e2rl.scenes.links import adjacent, drivable_exits
from e2rl.scenes.paths import arc_length, points_at, resample, tangent_angle, wrap
from e2rl.scenes.recording import Lane
from e2rl.scenes.route import BEHIND, SPACING

START_RADIUS, START_ANGLE = 5.0, 0.8  # m, rad: lanes this close may be a vehicle's own
MAX_START_LANES = 6
MAX_BRANCHES = 4
AHEAD = 300.0  # m of route ahead of the vehicle
BUCKET = 20.0  # m to which distances on the start lane are rounded up, so that vehicles share a search
SMOOTHING, SMOOTHED_ENDS = (
    1.3,
    6,
)  # vertices: standard deviation of the filter, odd extension beyond the ends
FILTER = np.exp(
    -0.5 / (SMOOTHING * SMOOTHING) * np.arange(-5, 6) ** 2
)  # of a Gaussian, to four standard deviations
FILTER /= FILTER.sum()
SAME_GAP = 1.2  # m: routes closer than this at all probes are one
OVERLAP = 2.0  # m at most from the end of a lane to the point of the next one that lies ahead of it
PROBES = np.array(
    [2, 8, 16, 28, 45]
)  # vertices ahead of the vehicle where routes are compared


@dataclass
class Route:
    """A route along lanes.

    points [P, 2] every SPACING m; length: usable m of it; open: whether the map ends
    before the points do; lanes: (id, arc length where the lane begins); limit [P]:
    speed limit m/s at each vertex (0 unknown); vehicle_s: arc length of the vehicle
    that it was made for.
    """

    points: np.ndarray
    length: float
    open: bool
    lanes: list[tuple[str, float]]
    limit: np.ndarray
    vehicle_s: float = 0.0


class LaneGraph:
    """Lanes of at least 0.5 m, connected, with a nearest-lane index.

    `graph` is the networkx DiGraph (nodes: lane ids; edges: successors); `line` and
    `arc` are a lane's centreline with points every 1 m and its length; `points`,
    `heading`, `lane_of` are the points of all centrelines, in order; `named_beside`:
    the neighbours that the map names, which need not be adjacent; `repairs`: what was
    left out of the recorded links and neighbours or inferred, by a phrase in the
    plural.
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
        self.ids = list(self.lanes)
        self.number = {name: index for index, name in enumerate(self.ids)}
        self.graph = nx.DiGraph()
        self.graph.add_nodes_from(self.ids)
        self.graph.add_edges_from(
            (name, other) for name, nexts in exits.items() for other in nexts
        )
        self.arc = {
            name: float(arc_length(line)[-1]) for name, line in self.line.items()
        }
        counts = [len(line) for line in self.line.values()]
        self.points = np.concatenate([np.zeros((0, 2)), *self.line.values()])
        self.heading = np.concatenate(
            [np.zeros(0), *(tangent_angle(line) for line in self.line.values())]
        )
        self.lane_of = np.repeat(np.arange(len(self.ids)), counts)
        self.first_point = np.cumsum([0, *counts])
        self.tree = cKDTree(self.points)
        self.nexts_of: dict[str, list[str]] = {}
        self.branches_of: dict[tuple[str, float, float], list[list[str]]] = {}
        self.path_of: dict[
            tuple[str, ...], tuple[np.ndarray, np.ndarray, np.ndarray]
        ] = {}

    def near_lanes(
        self, position: np.ndarray, heading: float, away: np.ndarray | None = None
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
        found: dict[int, int] = {}
        for _, point in sorted(zip(distance + 2.5 * angle, near, strict=True)):
            found.setdefault(self.lane_of[point], point)
        starts = []
        for lane, point in list(found.items())[:MAX_START_LANES]:
            name = self.ids[lane]
            along = float(point - self.first_point[lane]) * (
                self.arc[name] / (len(self.line[name]) - 1)
            )
            starts.append((name, along))
        return starts

    def turn(self, a: str, b: str) -> float:
        """Heading change [rad] from the end of lane a to the end of its successor b."""
        first = self.line[a][-1] - self.line[a][-2]
        second = self.line[b][-1] - self.line[b][-2]
        return abs(
            wrap(np.arctan2(second[1], second[0]) - np.arctan2(first[1], first[0]))
        )

    def bend(self, name: str) -> float:
        """Heading change [rad] between both ends of a lane."""
        angle = tangent_angle(self.line[name])
        return abs(wrap(angle[-1] - angle[0]))

    def branches(self, lane: str, begin: float, reach: float) -> list[list[str]]:
        """Lane sequences for AHEAD m from arc length `begin` of `lane`, at most
        MAX_BRANCHES, the straightest first.

        They branch at the forks within `reach` m of `begin` (up to BUCKET more).
        Sequences that leave the straightest one least often come first, then those that
        leave it soonest. A lane is repeated only where no other follows.
        """
        fork_end, end = (
            BUCKET * np.ceil((begin + length) / BUCKET) for length in (reach, AHEAD)
        )
        key = (lane, fork_end, end)
        if key not in self.branches_of:
            found: list[list[str]] = []
            queue = [(0, 0.0, 0, [lane], self.arc[lane])]
            pushed = 0
            while queue and len(found) < MAX_BRANCHES:
                turns, _, _, path, length = heappop(queue)
                while length < end and (nexts := self._successors(path)):
                    for other in nexts[1:] if length < fork_end else ():
                        pushed += 1
                        heappush(
                            queue,
                            (
                                turns + 1,
                                length,
                                pushed,
                                [*path, other],
                                length + self.arc[other],
                            ),
                        )
                    path = [*path, nexts[0]]
                    length = length + self.arc[nexts[0]]
                found.append(path)
            self.branches_of[key] = found
        return self.branches_of[key]

    def _successors(self, path: list[str]) -> list[str]:
        """Successors of a path's last lane, the straightest first; lanes of the path
        only where there is no other."""
        last = path[-1]
        if last not in self.nexts_of:
            self.nexts_of[last] = sorted(
                self.graph.successors(last), key=lambda name: self.turn(last, name)
            )
        return [
            name for name in self.nexts_of[last] if name not in path
        ] or self.nexts_of[last]

    def behind(self, lane: str, length: float) -> list[str]:
        """Lanes before `lane`, of several the straightest, until `length` m are
        covered."""
        path: list[str] = []
        while length > 0:
            head = path[0] if path else lane
            before = [
                name
                for name in self.graph.predecessors(head)
                if name not in path and name != lane
            ]
            if not before:
                break
            best = min(before, key=self.bend)
            path.insert(0, best)
            length -= self.arc[best]
        return path

    def path(self, lanes: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The centrelines of lanes one after another [P, 2], without repeated points;
        their arc lengths [P]; the arc lengths [lanes + 1] where the lanes begin and the
        last one ends."""
        key = tuple(lanes)
        if key not in self.path_of:
            line = _joined([self.line[name] for name in lanes])
            keep = np.concatenate(
                [[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.05]
            )
            line = line[keep] if keep.sum() >= 2 else line
            self.path_of[key] = (
                line,
                arc_length(line),
                np.cumsum([0.0, *(self.arc[name] for name in lanes)]),
            )
        return self.path_of[key]

    def route(self, lanes: list[str], begin: float, vertices: int) -> Route:
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
            smooth_vertices(points_at(line, arc, at=at)),
            float(length),
            open=bool(at[-1] > arc[-1]),
            lanes=lane_s,
            limit=limit,
        )

    def candidates(
        self,
        position: np.ndarray,
        heading: float,
        speed: float,
        count: int,
        vertices: int,
        away: np.ndarray | None = None,
    ) -> list[Route]:
        """Up to `count` route candidates of a vehicle, those of the nearest lane first.

        Along each lane near the vehicle, from BEHIND m before it to AHEAD m after it,
        on every branch of the forks that it may reach in 5 s; routes that coincide are
        one. away: see `near_lanes`.
        """
        reach = float(np.clip(5.0 * speed + 25.0, 40.0, 120.0))
        found: list[Route] = []
        points = np.empty((count, vertices, 2))
        for lane, s in self.near_lanes(position, heading, away=away):
            behind = self.behind(lane, BEHIND - s)
            before = sum(self.arc[name] for name in behind)
            begin = max(before + s - BEHIND, 0.0)
            for branch in self.branches(lane, s, reach=reach):
                route = self.route([*behind, *branch], begin, vertices=vertices)
                route.vehicle_s = before + s - begin
                probes = np.clip(
                    PROBES + int(round(route.vehicle_s / SPACING)), 0, vertices - 1
                )
                dx, dy = (
                    route.points[probes, axis, None]
                    - points[: len(found), None, :, axis]
                    for axis in range(2)
                )
                if not (np.sqrt((dx * dx + dy * dy).min(-1).max(-1)) < SAME_GAP).any():
                    points[len(found)] = route.points
                    found.append(route)
                if len(found) == count:
                    return found
        return found


def _joined(lines: list[np.ndarray]) -> np.ndarray:
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


def smooth_vertices(points: np.ndarray) -> np.ndarray:
    """Route vertices [P, 2], Gaussian smoothed with both ends in place (odd extension)."""
    pad = SMOOTHED_ENDS
    head = 2 * points[0] - points[pad:0:-1]
    tail = 2 * points[-1] - points[-2 : -pad - 2 : -1]
    return convolve1d(np.concatenate([head, points, tail]), FILTER, axis=0)[pad:-pad]


LANE_REACH = 2.5  # m from a lane's centreline within which a vehicle is on it
ALONG = 0.866  # cosine between a heading and a lane, either way, above which a vehicle drives along it: 30 degrees


def packed(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Indices [B, S] of what is true in rows [B, M], filled up by 0, and bool [B, S]:
    which are no filling."""
    count = rows.sum(1)
    most = int(count.max()) if len(count) else 0
    there = torch.arange(most, device=rows.device) < count[:, None]
    return torch.zeros_like(there, dtype=torch.long).masked_scatter(
        there, rows.nonzero()[:, 1]
    ), there


def against_lanes(points: Tensor, lane: Tensor, xy: Tensor, heading: Tensor) -> Tensor:
    """Bool [B, K, H]: of the lanes along which vehicles at xy [B, K, 2] of heading [B,
    K, H] drive, in either direction, the nearest runs against them.

    points [B, M, 2]: of centrelines; lane [B, M]: which one each point is of (-1:
    padding).
    """
    start = points[:, :-1]
    end = points[:, 1:]
    low = xy.amin(1, keepdim=True) - LANE_REACH
    high = xy.amax(1, keepdim=True) + LANE_REACH
    inside = (
        ((start > low) & (start < high)).all(-1)
        & (lane[:, 1:] == lane[:, :-1])
        & (lane[:, 1:] >= 0)
    )
    place, there = packed(inside)  # maps are large, and vehicles in one part of them
    start, end = (
        value.gather(1, place[..., None].expand(-1, -1, 2)) for value in (start, end)
    )
    length = (end - start).norm(dim=-1).clamp(min=1e-6)
    ahead = (end - start) / length[..., None]
    near = (torch.cdist(xy, start) < LANE_REACH) & there[:, None]
    b, k, segment = near.nonzero(as_tuple=True)  # few of them are near
    towards = torch.stack([heading[b, k].cos(), heading[b, k].sin()], -1)
    cosine = (towards * ahead[b, segment][:, None]).sum(-1)

    offset = xy[b, k] - start[b, segment]
    along = (
        (offset * ahead[b, segment]).sum(-1).clamp(min=0).minimum(length[b, segment])
    )
    gap = (
        (offset - along[:, None] * ahead[b, segment])
        .norm(dim=-1)[:, None]
        .expand_as(cosine)
    )

    def nearest(which: Tensor) -> Tensor:
        row = (b * xy.shape[1] + k)[:, None].expand_as(cosine)
        found = torch.full_like(heading, torch.inf).flatten(0, 1)
        return found.scatter_reduce(
            0, row, gap.masked_fill(~which, torch.inf), "amin"
        ).view_as(heading)

    return nearest(cosine < -ALONG) < nearest(cosine > ALONG)
