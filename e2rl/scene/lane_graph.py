"""The lane graph of a recording on the host (networkx), and the route candidates of a vehicle on it."""

from dataclasses import dataclass
from heapq import heappop, heappush

import networkx as nx
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from e2rl.scene.paths import arc_length, wrap
from e2rl.scene.recording import Lane
from e2rl.scene.route import SPACING

START_RADIUS, START_ANGLE = 5.0, 0.8  # m, rad: lanes this close may be a vehicle's own
MAX_START_LANES, MAX_LEAVES = 6, 4
BEHIND, AHEAD = 20.0, 300.0  # m of route behind and ahead of the vehicle
BUCKET = 20.0  # m to which distances on the start lane are rounded up, so that vehicles share a search
SMOOTHING = 1.3  # vertices
JOIN_GAP, JOIN_ANGLE, JOIN_HEIGHT = 1.5, 0.6, 2.0  # where connectivity is inferred: m, rad, m
SAME_GAP = 1.2  # m: routes closer than this at all probes are one


@dataclass
class Route:
    """A path of lanes: points [P, 2] every SPACING m, its usable length, whether the map ends there, its lanes (id, arc
    length at which the lane begins), the speed limit [P] at each vertex (0 unknown), and the arc length of the vehicle
    that it was made for."""

    points: np.ndarray
    length: float
    open: bool
    lanes: list[tuple[str, float]]
    limit: np.ndarray
    here: float = 0.0


def believed_width(width: float) -> float:
    """Recorded lane widths hold garbage (half of Waymo's connectors are 0, some 90 m): outside 2.5-6 m it is 3.7 m."""
    return float(width) if 2.5 <= width <= 6.0 else 3.7


def resample(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points [Q, 2] every `spacing` m (nearly: the length is divided evenly) along points [P, 2]."""
    arc = arc_length(points)
    count = max(int(np.ceil(arc[-1] / spacing)), 1) + 1
    at = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(at, arc, points[:, axis]) for axis in range(2)], 1)


def headings(points: np.ndarray) -> np.ndarray:
    """Tangent angle [P] of points [P, 2]."""
    tangent = np.gradient(points, axis=0)
    return np.arctan2(tangent[:, 1], tangent[:, 0])


def infer_exits(lanes: dict[str, Lane]) -> dict[str, list[str]]:
    """Successors by geometry, for files without connectivity: a lane follows where another ends, in nearly the same
    direction and, where heights are known, on the same level."""
    ids = list(lanes)
    if not ids:
        return {}
    start = np.array([lanes[i].points[0] for i in ids])
    angle = {name: headings(resample(lane.points, 1.0)) for name, lane in lanes.items()}
    tree = cKDTree(start)
    exits = {}
    for name in ids:
        lane = lanes[name]
        near = [
            j
            for j in tree.query_ball_point(lane.points[-1], JOIN_GAP)
            if ids[j] != name and abs(wrap(angle[ids[j]][0] - angle[name][-1])) < JOIN_ANGLE
        ]
        if lane.heights is not None:
            near = [
                j
                for j in near
                if lanes[ids[j]].heights is None or abs(lanes[ids[j]].heights[0] - lane.heights[-1]) < JOIN_HEIGHT
            ]
        exits[name] = [ids[j] for j in near]
    return exits


class LaneGraph:
    """Lanes of at least 0.5 m, connected, with a nearest-lane index.

    `graph` is the networkx DiGraph (nodes: lane ids; edges: successors); `points`, `heading`, `lane_of` describe all
    centrelines at 1 m.
    """

    def __init__(self, lanes: dict[str, Lane]):
        self.lanes = {
            name: lane for name, lane in lanes.items() if len(lane.points) >= 2 and arc_length(lane.points)[-1] >= 0.5
        }
        self.ids = list(self.lanes)
        exits = {name: lane.exits for name, lane in self.lanes.items()}
        if not any(exits.values()):
            exits = infer_exits(self.lanes)
        self.graph = nx.DiGraph()
        self.graph.add_nodes_from(self.ids)
        self.graph.add_edges_from((a, b) for a, nexts in exits.items() for b in nexts if b in self.lanes and b != a)
        self.line = {name: resample(lane.points, 1.0) for name, lane in self.lanes.items()}
        self.arc = {name: float(arc_length(line)[-1]) for name, line in self.line.items()}
        self.points = np.concatenate(list(self.line.values())) if self.ids else np.zeros((0, 2))
        self.heading = np.concatenate([headings(line) for line in self.line.values()]) if self.ids else np.zeros(0)
        self.lane_of = np.repeat(np.arange(len(self.ids)), [len(self.line[name]) for name in self.ids])
        self.first_point = np.concatenate([[0], np.cumsum([len(self.line[name]) for name in self.ids])])
        self.tree = cKDTree(self.points) if self.ids else None
        self.leaves_of: dict[tuple[str, float, float], list[list[str]]] = {}

    def near_lanes(self, position: np.ndarray, heading: float) -> list[tuple[str, float, float]]:
        """(lane, arc length on it, distance) of lanes within reach of a pose, best first, one entry a lane."""
        near = np.array(self.tree.query_ball_point(position, START_RADIUS), dtype=int)
        if not len(near):
            return []
        angle = np.abs(wrap(self.heading[near] - heading))
        near, angle = near[angle < START_ANGLE], angle[angle < START_ANGLE]
        distance = np.linalg.norm(self.points[near] - position, axis=1)
        found: dict[int, tuple[float, int, float]] = {}
        for cost, point, gap in sorted(zip(distance + 2.5 * angle, near, distance, strict=True)):
            found.setdefault(self.lane_of[point], (cost, point, gap))
        best = list(found.items())[:MAX_START_LANES]
        return [
            (self.ids[lane], float(point - self.first_point[lane]) * self.spacing(lane), gap)
            for lane, (_, point, gap) in best
        ]

    def spacing(self, lane: int) -> float:
        """Distance between neighbouring points of a lane's resampled line, m."""
        name = self.ids[lane]
        return self.arc[name] / (len(self.line[name]) - 1)

    def turn(self, a: str, b: str) -> float:
        """Heading change over lane b when entered from a: how straight the way on is."""
        line_a, line_b = self.line[a], self.line[b]
        end, start = line_b[-1] - line_b[-2], line_a[-1] - line_a[-2]
        return abs(wrap(np.arctan2(end[1], end[0]) - np.arctan2(start[1], start[0])))

    def bend(self, name: str) -> float:
        """Heading change between both ends of a lane."""
        angle = headings(self.line[name])
        return abs(wrap(angle[-1] - angle[0]))

    def leaves(self, lane: str, begin: float, reach: float) -> list[list[str]]:
        """Lane sequences for AHEAD m from arc length `begin` of `lane`, at most MAX_LEAVES, the straightest first.

        They branch at the forks within `reach` m of `begin` (up to BUCKET more); those that leave the straightest way
        least often come first, then those that leave it soonest. A lane is entered twice only where no other follows.
        """
        fork_end, end = (BUCKET * np.ceil((begin + length) / BUCKET) for length in (reach, AHEAD))
        key = (lane, fork_end, end)
        if key not in self.leaves_of:
            found, queue, pushed = [], [(0, 0.0, 0, [lane], self.arc[lane])], 0
            while queue and len(found) < MAX_LEAVES:
                turns, _, _, path, length = heappop(queue)
                while length < end and (nexts := self._onward(path)):
                    for other in nexts[1:] if length < fork_end else ():
                        pushed += 1
                        heappush(queue, (turns + 1, length, pushed, [*path, other], length + self.arc[other]))
                    path, length = [*path, nexts[0]], length + self.arc[nexts[0]]
                found.append(path)
            self.leaves_of[key] = found
        return self.leaves_of[key]

    def _onward(self, path: list[str]) -> list[str]:
        """Successors of the last lane of a path, straightest first; known ones only where no other follows."""
        nexts = list(self.graph.successors(path[-1]))
        fresh = [name for name in nexts if name not in path] or nexts
        return sorted(fresh, key=lambda name: self.turn(path[-1], name))

    def behind(self, lane: str, length: float) -> list[str]:
        """Lanes before `lane`, straightest first, until `length` m are covered."""
        path: list[str] = []
        while length > 0:
            head = path[0] if path else lane
            before = [p for p in self.graph.predecessors(head) if p not in path and p != lane]
            if not before:
                break
            best = min(before, key=self.bend)
            path.insert(0, best)
            length -= self.arc[best]
        return path

    def route(self, lanes: list[str], begin: float, vertices: int) -> Route:
        """The smoothed route along `lanes` from arc length `begin` of the first lane, `vertices` points long."""
        chain, starts, total = [], [], 0.0
        for name in lanes:
            starts.append((name, total - begin))
            chain.append(self.line[name])
            total += self.arc[name]
        line = np.concatenate(chain)
        keep = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.05])
        line = line[keep] if keep.sum() >= 2 else line
        arc = arc_length(line)
        scale = arc[-1] / max(total, 1e-6)
        at = np.arange(vertices) * SPACING + begin * scale
        inside = at <= arc[-1]
        points = np.stack([np.interp(at, arc, line[:, axis]) for axis in range(2)], 1)
        unit = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
        points[~inside] = line[-1] + (at[~inside] - arc[-1])[:, None] * unit
        points = smooth_vertices(points)
        length = min(arc[-1] - begin * scale, (vertices - 1) * SPACING)
        limit = np.zeros(vertices, np.float32)
        for name, start in starts:
            limit[max(int(start // SPACING), 0) :] = self.lanes[name].speed_limit
        return Route(
            points, float(length), bool(not inside[-1]), [(name, start * scale) for name, start in starts], limit
        )

    def candidates(self, position: np.ndarray, heading: float, speed: float, count: int, vertices: int) -> list[Route]:
        """Up to `count` route candidates of a vehicle, the nearest lane's first (prior_pilot B.2)."""
        reach = float(np.clip(5.0 * speed + 25.0, 40.0, 120.0))
        found: list[Route] = []
        probes = np.array([12, 18, 26, 38, 55])
        for lane, arc, _ in self.near_lanes(position, heading):
            behind = self.behind(lane, BEHIND - arc)
            before = sum(self.arc[name] for name in behind)
            begin = max(before + arc - BEHIND, 0.0)
            for leaf in self.leaves(lane, arc, reach):
                route = self.route([*behind, *leaf], begin, vertices)
                route.here = before + arc - begin
                shift = int(round(route.here / SPACING)) - 10
                at = np.clip(probes + shift, 0, vertices - 1)
                same = any(
                    np.linalg.norm(route.points[at][:, None] - other.points[None], axis=-1).min(1).max() < SAME_GAP
                    for other in found
                )
                if not same:
                    found.append(route)
                if len(found) == count:
                    return found
        return found


def smooth_vertices(points: np.ndarray) -> np.ndarray:
    """Route vertices [P, 2], Gaussian smoothed with both ends in place (odd extension)."""
    pad = 6
    head = 2 * points[0] - points[pad:0:-1]
    tail = 2 * points[-1] - points[-2 : -pad - 2 : -1]
    return gaussian_filter1d(np.concatenate([head, points, tail]), SMOOTHING, axis=0)[pad:-pad]
