"""The recorded path of a vehicle as a route, for missions that no lane route fits (lane
changes, car parks)."""

import numpy as np

from e2rl.scenes.lane_graph import (
    LaneGraph,
    Route,
    smooth_vertices,
)
from e2rl.scenes.paths import (
    arc_length,
    direction,
    points_at,
    tangent_angle,
)
from e2rl.scenes.route import (
    BEHIND,
    SPACING,
)

MARGIN = 10.0  # m after the recording that stay usable where no lane goes on
JOIN = 10.0  # m over which the route passes from the recording to the lane that goes on
STRIDE = 0.5  # m between the recorded points that are kept: standing vehicles jitter


def route_from_log(
    graph: LaneGraph,
    track: np.ndarray,
    vertices: int,
) -> Route:
    """The route along a recorded track [Q, 4], from BEHIND m before its start and on
    along the nearest lane at its end.

    Where no lane goes on, the route is open MARGIN m after the track's end, so that the
    vehicle leaves the scene there instead of driving where nothing is known. Limits and
    lanes are those of the nearest lane at each vertex.
    """
    arc = arc_length(track[:, :2])
    steps = track[np.unique(np.floor(arc / STRIDE), return_index=True)[1]]
    before = track[:1, :2] - BEHIND * direction(track[:1, 2])
    line = np.concatenate([before, steps[:, :2], track[-1:, :2]])
    length = arc_length(line)[-1] + MARGIN
    onward = graph.candidates(track[-1], 1, vertices=vertices)
    if onward:
        ahead = int(np.ceil((onward[0].vehicle_s + JOIN) / SPACING))
        end = max(int(onward[0].length / SPACING) + 1, ahead + 1)
        line = np.concatenate([line, onward[0].points[ahead:end]])
        length = max(length, arc_length(line)[-1])
    line = np.concatenate([line, line[-1:] + vertices * SPACING * _end_direction(line)])
    at = np.arange(vertices) * SPACING
    points = smooth_vertices(points_at(line, arc_length(line), at=at))
    lanes: dict[str, float] = {}
    limit = np.zeros(len(points), np.float32)
    for index, (point, angle) in enumerate(
        zip(points, tangent_angle(points), strict=True)
    ):
        near = graph.near_lanes(point, angle) if at[index] <= length else []
        if near:
            limit[index] = graph.lanes[near[0][0]].speed_limit
            lanes.setdefault(near[0][0], float(at[index]))
    return Route(
        points=points,
        length=min(length, at[-1]),
        open=bool(length < at[-1]),
        lanes=list(lanes.items()),
        limit=limit,
        vehicle_s=BEHIND,
    )


def _end_direction(line: np.ndarray) -> np.ndarray:
    """Unit vector [2] of the last metre or more of a line."""
    arc = arc_length(line)
    back = line[-1] - line[np.searchsorted(arc, arc[-1] - 1.0, side="right") - 1]
    return back / np.linalg.norm(back)
