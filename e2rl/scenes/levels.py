"""Who is on another level than the ego: on a bridge above its road, or in a tunnel
below it.

Simulation and verdicts are flat, so whoever crosses the ego's way above or below would
touch it. Where a log has heights, agents whose ways come near the ego's on other levels
alone are found here, and left out of its scenes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.paths import (
    arc_length,
    part_of,
)
from e2rl.scenes.recording import (
    DT,
    VEHICLE,
    Recording,
)

LEVEL = 4.0  # m between levels: bridges leave as much to what passes below
NEAR = 6.0  # m at most between ways that meet
AHEAD = 150.0  # m of lanes beyond what an agent drove where it may yet come to
STRIDE = 3  # frames between the places of a track that are compared
ON_LANE = 3.0  # m from the lane of a vehicle
UNEVEN = 1.5  # m up to which the heights of both agree
DRIVES = 10.0  # m that a vehicle drives whose heights vary, where they are measured
SAMPLES = 200  # places of vehicles that are held against lanes
AGREE = 0.8  # fraction of them that has to agree


@dataclass
class Levels:
    """Heights of the tracks and lanes of a log.

    valid [F, A]: frames of the tracks that count; heights [F, A] m of tracks, None
    where they tell nothing; lane_height [P] m: at the points of a LaneGraph, in the
    tracks' heights; NaN where it is unknown.
    """

    recording: Recording
    graph: LaneGraph
    valid: ndarray

    def __post_init__(self) -> None:
        graph = self.graph
        climbs = ego_climbs(self.recording, self.valid)
        self.heights = self.recording.heights if climbs else None
        self.lane_height = np.full(len(graph.points), np.nan)
        if self.heights is not None:
            height = np.concatenate([_at_points(graph, name) for name in graph.ids])
            self.lane_height = self._levelled(self.heights, height)

    def _levelled(self, heights: ndarray, lane_height: ndarray) -> ndarray:
        """Lane heights [P] on the scale of the tracks, which may be of boxes' middles;
        NaN where the two disagree.

        The difference is the one that puts the most vehicles on a lane: several lie one
        above the other at a bridge.
        """
        recording = self.recording
        vehicles = np.argwhere(self.valid & (recording.agent_type == VEHICLE))
        count = min(SAMPLES, len(vehicles))
        chosen = np.unique(np.linspace(0, len(vehicles) - 1, count).astype(int))
        frame, agent = vehicles[chosen].T
        position = recording.states[frame, agent, :2]
        sample, points = _pairs(self.graph.tree, position, ON_LANE)
        offset = heights[frame, agent][sample] - lane_height[points]
        sample = sample[np.isfinite(offset)]
        offset = offset[np.isfinite(offset)]
        best = np.nan
        explained = 0
        for value in sorted(np.unique(np.round(offset)), key=abs):
            count = len(np.unique(sample[np.abs(offset - value) < UNEVEN]))
            if count > explained:
                best = value
                explained = count
        finite = lane_height[np.isfinite(lane_height)]
        drawn_flat = len(finite) > 0 and np.ptp(finite) == 0
        share = 1.0 if drawn_flat else AGREE
        if not explained or explained < share * len(np.unique(sample)):
            return np.full_like(lane_height, np.nan)
        return lane_height + np.median(offset[np.abs(offset - best) < UNEVEN])

    def elsewhere(self, ego: int) -> ndarray:
        """Bool [A]: agents whose ways come near that of the track `ego`, and nowhere on
        its level."""
        other = np.zeros(self.valid.shape[1], bool)
        if self.heights is None or not self.valid[:, ego].any():
            return other
        path, height = self.way(ego, self.heights)
        tree = cKDTree(path)
        for agent in np.flatnonzero(self.valid.any(0)).tolist():
            frames = np.flatnonzero(self.valid[:, agent])[::STRIDE]
            nearest = tree.query(self.recording.states[frames, agent, :2])[1]
            above = np.abs(self.heights[frames, agent] - height[nearest]) > LEVEL
            if agent == ego or not above.any():
                continue
            points, heights = self.way(agent, self.heights)
            place, near = _pairs(tree, points, NEAR)
            above = np.abs(heights[place] - height[near]) > LEVEL
            other[agent] = len(above) > 0 and above.all()
        return other

    def way(self, agent: int, heights: ndarray) -> tuple[ndarray, ndarray]:
        """Places [Q, 2] m that an agent drove, and may yet drive along lanes of known
        height from its first one on, and their heights [Q] m.

        heights: [F, A] m of the tracks.
        """
        graph = self.graph
        frames = np.flatnonzero(self.valid[:, agent])
        track = self.recording.states[frames, agent]
        height = heights[frames, agent]
        ways = [track[::STRIDE, :2]]
        way_heights = [height[::STRIDE]]
        if self.recording.agent_type[agent] == VEHICLE:
            away = np.abs(self.lane_height - height[0]) > LEVEL
            starts = dict(graph.near_lanes(track[0, :2], track[0, 2], away))
            reach = arc_length(track[:, :2])[-1] + AHEAD
            for name in _reached(graph, starts, reach=reach):
                lane = graph.number[name]
                rows = slice(*graph.first_point[lane : lane + 2])
                finite = np.isfinite(self.lane_height[rows])
                ways.append(graph.points[rows][finite])
                way_heights.append(self.lane_height[rows][finite])
        return np.concatenate(ways), np.concatenate(way_heights)

    def lanes_elsewhere(self, height: ndarray) -> Callable[[int], ndarray | None]:
        """Returns a function that says which points [P] of lanes are on another level
        than the vehicle of a row, None where all may be on its own; height [rows] m,
        NaN unknown."""
        finite = self.lane_height[np.isfinite(self.lane_height)]
        low = finite.min(initial=np.inf)
        high = finite.max(initial=-np.inf)

        def elsewhere(row: int) -> ndarray | None:
            if not max(height[row] - low, high - height[row]) > LEVEL:
                return None
            return np.abs(self.lane_height - height[row]) > LEVEL

        return elsewhere


def _pairs(
    tree: cKDTree,
    points: ndarray,
    radius: float,
) -> tuple[ndarray, ndarray]:
    """Indices [K] of points and of the points of a tree within `radius` m of them."""
    near = tree.query_ball_point(points, radius)
    return part_of(near), np.concatenate([*near, []]).astype(int)


def _at_points(graph: LaneGraph, name: str) -> ndarray:
    """Heights [P] m at the points of a lane's line, NaN where they are unknown."""
    lane = graph.lanes[name]
    line = graph.line[name]
    if lane.heights is None:
        return np.full(len(line), np.nan)
    arc = arc_length(lane.points)
    return np.interp(np.linspace(0, arc[-1], len(line)), arc, lane.heights)


def ego_climbs(recording: Recording, valid: ndarray) -> bool:
    """Returns whether the ego's heights are measured: those of some logs (nuScenes) are
    0 whatever it drives, and the others' are relative to it, so that who drives ahead
    of it uphill is above it.

    valid [F, A]: frames of the tracks that count.
    """
    if recording.heights is None:
        return False
    finite = valid & np.isfinite(recording.heights)
    low = np.where(finite, recording.heights, np.inf).min(0, initial=np.inf)
    high = np.where(finite, recording.heights, -np.inf).max(0, initial=-np.inf)
    drives = (np.abs(recording.states[..., 3]) * valid).sum(0) * DT > DRIVES
    drives &= (recording.agent_type == VEHICLE) & finite.any(0)
    if not drives[recording.ego]:
        return True
    change = high[drives] - low[drives]
    return bool(high[recording.ego] > low[recording.ego] or np.median(change) == 0)


def _reached(
    graph: LaneGraph,
    starts: dict[str, float],
    reach: float,
) -> list[str]:
    """Lanes that begin at most `reach` m after places [m] on `starts`."""
    begin = {name: -place for name, place in starts.items()}
    waiting = list(starts)
    while waiting:
        name = waiting.pop(0)
        end = begin[name] + graph.arc[name]
        for other in graph.graph.successors(name) if end < reach else ():
            if end < begin.get(other, np.inf):
                begin[other] = end
                waiting.append(other)
    return list(begin)
