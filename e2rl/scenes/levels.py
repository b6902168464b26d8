"""Who is on another level than the ego: on a bridge above its road, or in a tunnel
below it.

Simulation and verdicts are flat, so whoever crosses the ego's way above or below would
touch it. Where a log has heights, agents whose ways come near the ego's on other levels
alone are found here, and left out of its scenes.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.paths import arc_length
from e2rl.scenes.recording import DT, VEHICLE, Recording

LEVEL = 4.0  # m between what is on different levels: bridges leave as much to what passes below
NEAR = 6.0  # m at most between ways that meet
AHEAD = 150.0  # m of lanes beyond what an agent drove where it may yet come to
STRIDE = 3  # frames between the places of a track that are compared
ON_LANE, UNEVEN = (
    3.0,
    1.5,
)  # m: of a vehicle on a lane; deviation of heights up to which the two agree
DRIVES = 10.0  # m that a vehicle drives whose heights vary, where they are measured
SAMPLES, AGREE = (
    200,
    0.8,
)  # places of vehicles that are held against lanes; the fraction that has to agree


class Levels:
    """Heights of the tracks and lanes of a log.

    lane_height [P] m: at the points of a LaneGraph, in the tracks' heights; NaN where
    it is unknown.
    """

    def __init__(
        self, recording: Recording, graph: LaneGraph, valid: np.ndarray
    ) -> None:
        """valid [F, A]: frames of the tracks that count."""
        self.recording = (
            recording
            if ego_climbs(recording, valid)
            else replace(recording, heights=None)
        )
        self.graph = graph
        self.valid = valid
        self.lane_height = np.full(len(graph.points), np.nan)
        if self.recording.heights is not None:
            height = np.concatenate([_at_points(graph, name) for name in graph.ids])
            self.lane_height = self._levelled(height)

    def _levelled(self, height: np.ndarray) -> np.ndarray:
        """Lane heights [P] on the scale of the tracks, which may be of boxes' middles;
        NaN where the two disagree.

        The difference is the one that puts the most vehicles on a lane: several lie one
        above the other at a bridge.
        """
        recording = self.recording
        assert recording.heights is not None
        frame, agent = (self.valid & (recording.agent_type == VEHICLE)).nonzero()
        chosen = np.unique(
            np.linspace(0, len(frame) - 1, min(SAMPLES, len(frame))).astype(int)
        )
        frame = frame[chosen]
        agent = agent[chosen]
        near = self.graph.tree.query_ball_point(
            recording.states[frame, agent, :2], ON_LANE
        )
        sample = np.repeat(np.arange(len(near)), [len(points) for points in near])
        offset = (
            recording.heights[frame, agent][sample]
            - height[np.concatenate([*near, []]).astype(int)]
        )
        sample = sample[np.isfinite(offset)]
        offset = offset[np.isfinite(offset)]
        best = np.nan
        explained = 0
        for value in sorted(np.unique(np.round(offset)), key=abs):
            count = len(np.unique(sample[np.abs(offset - value) < UNEVEN]))
            best, explained = (value, count) if count > explained else (best, explained)
        known = height[np.isfinite(height)]
        drawn_flat = len(known) > 0 and np.ptp(known) == 0
        if (
            explained < (1.0 if drawn_flat else AGREE) * len(np.unique(sample))
            or not explained
        ):
            return np.full_like(height, np.nan)
        return height + np.median(offset[np.abs(offset - best) < UNEVEN])

    def elsewhere(self, ego: int) -> np.ndarray:
        """Bool [A]: agents whose ways come near that of the track `ego`, and nowhere on
        its level."""
        other = np.zeros(self.valid.shape[1], bool)
        heights = self.recording.heights
        if heights is None or not self.valid[:, ego].any():
            return other
        path, height = self.way(ego)
        tree = cKDTree(path)
        states = self.recording.states
        for agent in np.flatnonzero(self.valid.any(0)).tolist():
            frames = np.flatnonzero(self.valid[:, agent])[::STRIDE]
            _, nearest = tree.query(states[frames, agent, :2])
            if (
                agent == ego
                or not (np.abs(heights[frames, agent] - height[nearest]) > LEVEL).any()
            ):
                continue
            points, own = self.way(agent)
            close = tree.query_ball_point(points, NEAR)
            index = np.repeat(np.arange(len(points)), [len(near) for near in close])
            apart = np.abs(
                own[index] - height[np.concatenate([*close, []]).astype(int)]
            )
            other[agent] = len(apart) > 0 and bool((apart > LEVEL).all())
        return other

    def way(self, agent: int) -> tuple[np.ndarray, np.ndarray]:
        """Places [Q, 2] m that an agent drove, and may yet drive along lanes of known
        height from its first one on, and their heights [Q] m."""
        recording = self.recording
        graph = self.graph
        assert recording.heights is not None
        frames = np.flatnonzero(self.valid[:, agent])
        track = recording.states[frames, agent]
        height = recording.heights[frames, agent]
        places = [track[::STRIDE, :2]]
        heights = [height[::STRIDE]]
        if recording.agent_type[agent] == VEHICLE:
            reach = arc_length(track[:, :2])[-1] + AHEAD
            places_on_lanes = dict(
                self.near_lanes(track[0, :2], track[0, 2], height=height[0])
            )
            for name in _reached(graph, places_on_lanes, reach=reach):
                rows = slice(
                    *graph.first_point[[graph.number[name], graph.number[name] + 1]]
                )
                known = np.isfinite(self.lane_height[rows])
                places.append(graph.points[rows][known])
                heights.append(self.lane_height[rows][known])
        return np.concatenate(places), np.concatenate(heights)

    def lanes_elsewhere(self, height: np.ndarray) -> Callable[[int], np.ndarray | None]:
        """Returns a function that says which points [P] of lanes are on another level
        than the vehicle of a row, None where all may be on its own; height [rows] m,
        NaN unknown."""
        low, high = np.nan_to_num(
            [self.lane_height, -self.lane_height], nan=np.inf
        ).min(1, initial=np.inf)

        def elsewhere(row: int) -> np.ndarray | None:
            if not max(height[row] - low, -high - height[row]) > LEVEL:
                return None
            return np.abs(self.lane_height - height[row]) > LEVEL

        return elsewhere

    def near_lanes(
        self, position: np.ndarray, heading: float, height: float
    ) -> list[tuple[str, float]]:
        """`LaneGraph.near_lanes` without those on another level than `height` m."""
        away = np.abs(self.lane_height - height) > LEVEL
        return self.graph.near_lanes(position, heading, away)


def _at_points(graph: LaneGraph, name: str) -> np.ndarray:
    """Heights [P] m at the points of a lane's line, NaN where they are unknown."""
    lane = graph.lanes[name]
    line = graph.line[name]
    if lane.heights is None:
        return np.full(len(line), np.nan)
    arc = arc_length(lane.points)
    return np.interp(np.linspace(0, arc[-1], len(line)), arc, lane.heights)


def ego_climbs(recording: Recording, valid: np.ndarray) -> bool:
    """Returns whether the ego's heights are measured: those of some logs (nuScenes) are
    0 whatever it drives, and the others' are relative to it, so that who drives ahead
    of it uphill is above it.

    Args:
        recording: with states [F, A, 4], and heights [F, A] m or None.
        valid: [F, A] bool, frames of the tracks that count.
    """
    if recording.heights is None:
        return False
    known = valid & np.isfinite(recording.heights)
    low = np.where(known, recording.heights, np.inf).min(0, initial=np.inf)
    high = np.where(known, recording.heights, -np.inf).max(0, initial=-np.inf)
    drives = (np.abs(recording.states[..., 3]) * valid).sum(0) * DT > DRIVES
    drives &= (recording.agent_type == VEHICLE) & known.any(0)
    if not drives[recording.ego]:
        return True
    change = high[drives] - low[drives]
    return bool(high[recording.ego] > low[recording.ego] or np.median(change) == 0)


def _reached(graph: LaneGraph, starts: dict[str, float], reach: float) -> list[str]:
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
