"""The map of a scene as a planner written for nuPlan asks for it; goes with
nuplan_planner.py (docs/guide/nuplan.md).

Lanes are e2rl's centrelines with their widths. Lanes side by side make a roadblock. A
roadblock with a light, behind a split or before a merge is a connector, as are its
lanes.
"""

import math
from functools import cached_property

import numpy as np
from nuplan.common.actor_state.state_representation import StateSE2
from nuplan.common.maps.abstract_map import AbstractMap
from nuplan.common.maps.abstract_map_objects import (
    Lane,
    LaneConnector,
    PolygonMapObject,
    PolylineMapObject,
    RoadBlockGraphEdgeMapObject,
)
from nuplan.common.maps.maps_datatypes import LaneConnectorType, SemanticMapLayer
from shapely.geometry import LineString, Point, box
from shapely.ops import unary_union

STRAY, DISTANT = (
    math.radians(60),
    4.0,
)  # rad, m: a point of the route is on a lane that is within both
ASIDE, JUMP = (
    3.0,
    1000.0,
)  # cost, in m of distance, of a lane change and of going where no lane leads
SHOULDER = 1.0  # m beside a lane that e2rl counts as road
LIT = 0.5  # m from where a lane begins to the point of its light
LANES = (SemanticMapLayer.LANE, SemanticMapLayer.LANE_CONNECTOR)
BLOCKS = (SemanticMapLayer.ROADBLOCK, SemanticMapLayer.ROADBLOCK_CONNECTOR)
BESIDE = SemanticMapLayer.CARPARK_AREA  # nuPlan's layer of what is drivable and no lane
AREAS = {
    SemanticMapLayer.DRIVABLE_AREA: (*LANES, BESIDE),
    SemanticMapLayer.INTERSECTION: LANES[1:],
}  # made of what
EMPTY = (
    SemanticMapLayer.STOP_LINE,
    SemanticMapLayer.CROSSWALK,
    SemanticMapLayer.INTERSECTION,
    SemanticMapLayer.WALKWAYS,
)


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


class Polyline(PolylineMapObject):
    """A centreline, or the border of a lane."""

    def __init__(self, name, points):
        """points [P, 2] m, P >= 2."""
        super().__init__(name)
        self.points = points
        steps = np.diff(points, axis=0)
        self._heading = np.arctan2(steps[:, 1], steps[:, 0])
        self._s = np.concatenate([[0.0], np.hypot(*steps.T).cumsum()])

    length = property(lambda self: float(self._s[-1]))

    @cached_property
    def linestring(self):
        return LineString(self.points)

    @cached_property
    def poses(self):
        """[P, 3]"""
        return np.column_stack(
            [self.points, np.append(self._heading, self._heading[-1])]
        )

    @cached_property
    def discrete_path(self):
        return [StateSE2(*pose) for pose in self.poses.tolist()]

    def get_nearest_arc_length_from_position(self, point):
        return float(self.linestring.project(Point(point.x, point.y)))

    def get_nearest_pose_from_position(self, point):
        s = self.get_nearest_arc_length_from_position(point)
        on = self.linestring.interpolate(s)
        return StateSE2(on.x, on.y, self._heading_at(s))

    def get_curvature_at_arc_length(self, arc_length):
        """Change of heading over the metre on either side."""
        start = max(arc_length - 1.0, 0.0)
        end = min(arc_length + 1.0, self.length)
        return wrap(self._heading_at(end) - self._heading_at(start)) / max(
            end - start, 1e-6
        )

    def _heading_at(self, s):
        return float(
            self._heading[
                min(int(np.searchsorted(self._s[1:], s)), len(self._heading) - 1)
            ]
        )


class LaneOfScene:
    """What lanes and lane connectors have in common. light: index of its light, None
    where it has none."""

    def __init__(self, name, points, width):
        super().__init__(name)
        self.width = width
        self.light = None
        self.limit = None
        self.block = None
        self.left = None
        self.right = None
        self.incoming = []
        self.outgoing = []
        normal = np.gradient(points, axis=0)[:, ::-1] * [-1.0, 1.0]
        normal *= (
            width / 2 / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        )
        self._lines = [
            Polyline(name + end, points + side * normal)
            for end, side in (("", 0), ("left", 1), ("right", -1))
        ]

    baseline_path = property(lambda self: self._lines[0])
    left_boundary = property(lambda self: self._lines[1])
    right_boundary = property(lambda self: self._lines[2])
    incoming_edges = property(lambda self: self.incoming)
    outgoing_edges = property(lambda self: self.outgoing)
    adjacent_edges = property(lambda self: (self.left, self.right))
    parallel_edges = property(lambda self: self.block.interior_edges)
    parent = property(lambda self: self.block)
    index = property(lambda self: self.block.interior_edges.index(self) + 1)
    speed_limit_mps = property(lambda self: self.limit)
    stop_lines = property(lambda self: [])

    @cached_property
    def polygon(self):
        return self.baseline_path.linestring.buffer(self.width / 2, cap_style=2)  # flat

    def get_roadblock_id(self):
        return self.block.id

    def has_traffic_lights(self):
        return self.light is not None

    def is_left_of(self, other):
        return self.block is other.block and self.index < other.index

    def is_right_of(self, other):
        return self.block is other.block and self.index > other.index

    def oriented_distance(self, point):
        pose = self.baseline_path.get_nearest_pose_from_position(point)
        aside = math.cos(pose.heading) * (point.y - pose.y) - math.sin(pose.heading) * (
            point.x - pose.x
        )
        return math.copysign(math.hypot(point.x - pose.x, point.y - pose.y), aside)

    def get_width_left_right(self, point, include_outside=False):
        if not include_outside and not self.contains_point(point):
            return math.inf, math.inf
        aside = self.oriented_distance(point)
        return self.width / 2 - aside, self.width / 2 + aside


class SceneLane(LaneOfScene, Lane):
    """A lane that is no connector."""


class SceneLaneConnector(LaneOfScene, LaneConnector):
    """A lane of a connector."""

    @property
    def turn_type(self):
        first, last = self.baseline_path.poses[[0, -1], 2]
        turn = math.degrees(wrap(last - first))
        if abs(turn) > 150:
            return LaneConnectorType.UTURN
        if abs(turn) < 20:
            return LaneConnectorType.STRAIGHT
        return LaneConnectorType.LEFT if turn > 0 else LaneConnectorType.RIGHT


class SceneRoadblock(RoadBlockGraphEdgeMapObject):
    """Lanes side by side, from left to right."""

    def __init__(self, name, lanes):
        super().__init__(name)
        self.lanes = lanes

    interior_edges = property(lambda self: self.lanes)
    incoming_edges = property(lambda self: self._blocks("incoming"))
    outgoing_edges = property(lambda self: self._blocks("outgoing"))
    parallel_edges = property(lambda self: [self])
    children_stop_lines = property(lambda self: [])

    @cached_property
    def polygon(self):
        """The lanes, and the gaps of up to 2 m between them."""
        lanes = unary_union([lane.polygon for lane in self.lanes])
        joined = lanes.buffer(1.0, join_style=2).buffer(-1.0, join_style=2)  # mitred
        return joined if joined.geom_type == "Polygon" else joined.convex_hull

    def _blocks(self, edges):
        return list(
            {
                edge.block.id: edge.block
                for lane in self.lanes
                for edge in getattr(lane, edges)
            }.values()
        )


class Shoulder(PolygonMapObject):
    """Road beside the lanes."""

    polygon = None

    def __init__(self, name, polygon):
        super().__init__(name)
        self.polygon = polygon


class SceneMap(AbstractMap):
    """The lanes and roadblocks of a scene. Inside of the drivable area is who is inside
    of a lane or beside one, inside of an intersection who is inside of a connector; the
    layers of EMPTY hold no objects."""

    def __init__(self, name, lines, about, lights):
        """lines: centrelines [P, 2], P >= 2, by lane; about [L, 9]: width, left, right
        and 6 exits of each, -1 none; lights [S, 2]: where lanes with lights begin."""
        self._name = name
        self._boxes = {}
        self._objects = {layer: {} for layer in (*LANES, *BLOCKS, BESIDE, *EMPTY)}
        left, right = (
            [int(row[k]) if row[k] in lines else -1 for row in about] for k in (1, 2)
        )
        exits = [{int(lane) for lane in row[3:] if lane in lines} for row in about]
        entries = [sum(lane in after for after in exits) for lane in range(len(about))]
        connecting = {lane for after in exits if len(after) > 1 for lane in after}
        connecting |= {
            lane
            for lane, after in enumerate(exits)
            if any(entries[other] > 1 for other in after)
        }
        connecting |= {
            lane
            for lane, line in lines.items()
            if len(lights) and np.hypot(*(lights - line[0]).T).min() < LIT
        }
        self.lanes = {}
        for number, row in enumerate(rows_of(lines, left, right, exits), len(about)):
            connector = not connecting.isdisjoint(row)
            kind = SceneLaneConnector if connector else SceneLane
            lanes = [
                kind(str(lane), lines[lane], float(about[lane][0])) for lane in row
            ]
            block = SceneRoadblock(str(number), lanes)
            self._objects[BLOCKS[connector]][block.id] = block
            for lane, made in zip(row, lanes):
                made.block, self.lanes[lane] = block, made
                self._objects[LANES[connector]][made.id] = made
        for number, lane in self.lanes.items():
            lane.left = self.lanes.get(left[number])
            lane.right = self.lanes.get(right[number])
            lane.outgoing = [self.lanes[after] for after in sorted(exits[number])]
            for after in lane.outgoing:
                after.incoming.append(lane)
        area = unary_union([lane.polygon for lane in self.lanes.values()])
        beside = area.buffer(SHOULDER, quad_segs=2).difference(area)
        for number, part in enumerate(getattr(beside, "geoms", [beside])):
            self._objects[BESIDE][f"beside-{number}"] = Shoulder(
                f"beside-{number}", part
            )

    map_name = property(lambda self: self._name)

    def initialize_all_layers(self):
        """They are there."""

    def get_available_map_objects(self):
        return list(self._objects)

    def get_available_raster_layers(self):
        return []

    def get_raster_map_layer(self, layer):
        raise NotImplementedError("e2rl's scenes have no raster layers")

    def get_raster_map(self, layers):
        raise NotImplementedError("e2rl's scenes have no raster layers")

    def get_distance_to_nearest_raster_layer(self, point, layer):
        raise NotImplementedError("e2rl's scenes have no raster layers")

    def get_map_object(self, object_id, layer):
        return self._of(layer).get(str(object_id))

    def get_all_map_objects(self, point, layer):
        return [
            one for one in self._near(point, 0.0, layer) if one.contains_point(point)
        ]

    def get_one_map_object(self, point, layer):
        found = self.get_all_map_objects(point, layer)
        assert len(found) <= 1, (
            f"{len(found)} map objects found; use get_all_map_objects()"
        )
        return found[0] if found else None

    def is_in_layer(self, point, layer):
        return any(
            self.get_all_map_objects(point, one) for one in AREAS.get(layer, (layer,))
        )

    def get_proximal_map_objects(self, point, radius, layers):
        """Objects that touch the square of half the side `radius` around a point, as in
        nuPlan."""
        square = box(
            point.x - radius, point.y - radius, point.x + radius, point.y + radius
        )
        return {
            layer: [
                one
                for one in self._near(point, radius, layer)
                if one.polygon.intersects(square)
            ]
            for layer in layers
        }

    def get_distance_to_nearest_map_object(self, point, layer):
        at = Point(point.x, point.y)
        found = [
            (one.polygon.distance(at), name) for name, one in self._of(layer).items()
        ]
        return min(found)[::-1] if found else (None, None)

    def get_distances_matrix_to_nearest_map_object(self, points, layer):
        return np.array(
            [
                self.get_distance_to_nearest_map_object(point, layer)[1]
                for point in points
            ],
            float,
        )

    def _get_roadblock(self, name):  # PDM-Closed asks by this and the next one
        return self.get_map_object(name, SemanticMapLayer.ROADBLOCK)

    def _get_roadblock_connector(self, name):
        return self.get_map_object(name, SemanticMapLayer.ROADBLOCK_CONNECTOR)

    def _of(self, layer):
        if layer not in self._objects:
            raise NotImplementedError(
                f"e2rl's scenes have no layer {getattr(layer, 'name', layer)}"
            )
        return self._objects[layer]

    def _near(self, point, radius, layer):
        """Objects of a layer whose bounding boxes reach the square around a point."""
        objects = list(self._of(layer).values())
        if not objects:
            return []
        if layer not in self._boxes:
            self._boxes[layer] = np.array([one.polygon.bounds for one in objects])
        low, high = np.split(self._boxes[layer], 2, axis=1)
        at = np.array([point.x, point.y])
        return [
            objects[i]
            for i in np.flatnonzero(
                ((low <= at + radius) & (high >= at - radius)).all(1)
            )
        ]


def rows_of(lanes, left, right, exits):
    """Rows of lanes side by side, each from left to right: neighbours of each other,
    none of which follows another. left, right, exits: of each lane; -1 none."""
    row = {lane: [lane] for lane in lanes}
    for lane in lanes:
        other = left[lane]
        if other >= 0 and right[other] == lane and row[lane] is not row[other]:
            joined = row[other] + row[lane]
            if not any(exits[one].intersection(joined) for one in joined):
                row.update(dict.fromkeys(joined, joined))
    return list({id(found): found for found in row.values()}.values())


def lanes_along(route, lanes):
    """The lane [P] of each point of a route [P, 2], None where none is near: of all
    sequences of lanes the one of least distance, lane changes and jumps. lanes: by
    number."""
    steps = np.gradient(route, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    names = []
    costs = []
    for name, lane in lanes.items():
        path = lane.baseline_path.poses
        low = path[:, :2].min(0) - DISTANT
        high = path[:, :2].max(0) + DISTANT
        if not ((route >= low) & (route <= high)).all(1).any():
            continue
        distance = np.linalg.norm(route[:, None] - path[:, :2], axis=-1)
        distance[np.abs(wrap(heading[:, None] - path[:, 2])) > STRAY] = np.inf
        if distance.min() < DISTANT:
            names.append(name)
            costs.append(distance.min(1))
    if not names:
        return [None] * len(route)
    near = [lanes[name] for name in names]
    change = np.array([[_change(lane, other) for other in near] for lane in near])
    cost = np.minimum(np.array(costs).T, DISTANT)  # [P, lanes near the route]
    best = cost[0]
    came = []
    for here in cost[1:]:
        total = best[:, None] + change
        came.append(total.argmin(0))
        best = total.min(0) + here
    found = [int(best.argmin())]
    for before in reversed(came):
        found.append(int(before[found[-1]]))
    return [
        names[i] if cost[k, i] < DISTANT else None
        for k, i in enumerate(reversed(found))
    ]


def _change(lane, other):
    if lane is other or other in lane.outgoing:
        return 0.0
    return ASIDE if other in (lane.left, lane.right) else JUMP
