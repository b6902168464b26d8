"""A vehicle's recorded way as a route, for missions that no lane route fits (lane changes, car parks)."""

import numpy as np

from e2rl.scene.lane_graph import BEHIND, LaneGraph, Route, headings, smooth_vertices
from e2rl.scene.paths import arc_length
from e2rl.scene.route import SPACING

MARGIN = 10.0  # m beyond the recording that stay usable where no lane goes on
JOIN = 10.0  # m within which the recorded way passes over to the lane that goes on
STRIDE = 0.5  # m between the recorded points that are kept: standing vehicles jitter


def route_from_log(graph: LaneGraph, track: np.ndarray, vertices: int) -> Route:
    """The way of track [Q, 4], from BEHIND m before its start, going on along the nearest lane at its end.

    Where no lane goes on, the route is open MARGIN m after the track's end: a vehicle leaves the scene there rather
    than drive on into the unknown. Limits and lanes are those of the nearest lane at each vertex.
    """
    arc = arc_length(track[:, :2])
    kept = track[np.unique(np.floor(arc / STRIDE), return_index=True)[1]]
    direction = [np.array([np.cos(a), np.sin(a)]) for a in (track[0, 2], track[-1, 2])]
    line = np.concatenate([track[:1, :2] - BEHIND * direction[0], kept[:, :2], track[-1:, :2]])
    known = arc_length(line)[-1] + MARGIN
    onward = graph.candidates(track[-1, :2], track[-1, 2], track[-1, 3], 1, vertices)
    if onward:
        ahead = int(np.ceil((onward[0].here + JOIN) / SPACING))
        used = onward[0].points[ahead : max(int(onward[0].length / SPACING) + 1, ahead + 1)]
        line = np.concatenate([line, used])
        known = max(known, arc_length(line)[-1])
    line = np.concatenate([line, line[-1:] + vertices * SPACING * _direction(line)])
    arc, at = arc_length(line), np.arange(vertices) * SPACING
    points = smooth_vertices(np.stack([np.interp(at, arc, line[:, axis]) for axis in range(2)], 1))
    lanes, limit = _lanes_along(graph, points, known)
    return Route(points, min(known, at[-1]), bool(known < at[-1]), lanes, limit, BEHIND)


def _direction(line: np.ndarray) -> np.ndarray:
    """Unit vector [2] of the last metre or more of a line."""
    back = line[-1] - line[np.searchsorted(arc_length(line), arc_length(line)[-1] - 1.0, side="right") - 1]
    return back / np.linalg.norm(back)


def _lanes_along(graph: LaneGraph, points: np.ndarray, length: float) -> tuple[list[tuple[str, float]], np.ndarray]:
    """Lanes (id, arc length at which they begin) under the first `length` m of route vertices [P, 2], and the speed
    limit [P] there."""
    lanes, limit = [], np.zeros(len(points), np.float32)
    for index, (point, angle) in enumerate(zip(points, headings(points), strict=True)):
        near = graph.near_lanes(point, angle)
        if near and index * SPACING <= length:
            limit[index] = graph.lanes[near[0][0]].speed_limit
            if near[0][0] not in [name for name, _ in lanes]:
                lanes.append((near[0][0], index * SPACING))
    return lanes, limit
