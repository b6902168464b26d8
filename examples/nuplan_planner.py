"""A planner written for nuPlan, as the process that `ego=nuplan` asks (docs/how-to/nuplan.md).

Copy this file next to the planner, and run it with the Python in which nuplan-devkit is installed:

    python nuplan_planner.py --planner MODULE:CLASS [NAME=VALUE ...] ADDRESS
    python nuplan_planner.py --config PLANNER.yaml ADDRESS

It serves the protocol of docs/how-to/planner.md with one planner a scene. Of e2rl it needs nothing.
"""

import argparse
import ast
import importlib
import math
import os
import socketserver
import struct
import sys
import traceback
from functools import cached_property

import numpy as np
from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox
from nuplan.common.actor_state.scene_object import SceneObjectMetadata
from nuplan.common.actor_state.state_representation import Point2D, StateSE2, StateVector2D, TimePoint
from nuplan.common.actor_state.tracked_objects import TrackedObjects
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import VehicleParameters
from nuplan.common.maps.abstract_map import AbstractMap
from nuplan.common.maps.abstract_map_objects import (
    Lane,
    LaneConnector,
    PolylineMapObject,
    RoadBlockGraphEdgeMapObject,
)
from nuplan.common.maps.maps_datatypes import (
    LaneConnectorType,
    SemanticMapLayer,
    TrafficLightStatusData,
    TrafficLightStatusType,
)
from nuplan.planning.simulation.history.simulation_history_buffer import SimulationHistoryBuffer
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.planner.abstract_planner import PlannerInitialization, PlannerInput
from nuplan.planning.simulation.simulation_time_controller.simulation_iteration import SimulationIteration
from shapely.geometry import LineString, Point, box
from shapely.ops import unary_union

VERSION = 1
HELLO, SCENE, PLAN, TRAJECTORY, FAILED = 1, 2, 3, 4, 6
STEP, STEP_US, START_US = 0.1, 100_000, 10_000_000  # s; the same in us; time of step 0, with room for a past
PAST = 20  # steps of history besides the present: 2 s
SPACING = 2.0  # m between two points of a route
TYPES = [
    TrackedObjectType.VEHICLE,
    TrackedObjectType.PEDESTRIAN,
    TrackedObjectType.BICYCLE,
    TrackedObjectType.GENERIC_OBJECT,
]
LIGHTS = [
    TrafficLightStatusType.UNKNOWN,
    TrafficLightStatusType.RED,
    TrafficLightStatusType.YELLOW,
    TrafficLightStatusType.GREEN,
]
HEIGHT = 1.7  # m, of everybody: the scenes have none
# nuPlan's vehicle, a Pacifica, as fractions of its length: rear axle to rear bumper, wheel base, rear axle to centre of gravity
REAR, WHEEL_BASE, COG = 1.127 / 5.176, 3.089 / 5.176, 1.67 / 5.176
STRAY, DISTANT = 60.0, 4.0  # degrees, m: a point of the route is on a lane that is within both
ASIDE, JUMP = 3.0, 1000.0  # cost, in m of distance, of a lane change and of going where no lane leads
LANE_LAYERS = (SemanticMapLayer.LANE, SemanticMapLayer.LANE_CONNECTOR)
BLOCK_LAYERS = (SemanticMapLayer.ROADBLOCK, SemanticMapLayer.ROADBLOCK_CONNECTOR)
EMPTY_LAYERS = (
    SemanticMapLayer.STOP_LINE,
    SemanticMapLayer.CROSSWALK,
    SemanticMapLayer.INTERSECTION,
    SemanticMapLayer.WALKWAYS,
    SemanticMapLayer.CARPARK_AREA,
)


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


# --- the map ---------------------------------------------------------------------------------------------------------


class Polyline(PolylineMapObject):
    """A centreline, or a boundary."""

    def __init__(self, name, points):
        """points [P, 2] m, P >= 2."""
        super().__init__(name)
        self.points = points
        steps = np.diff(points, axis=0)
        self._heading = np.arctan2(steps[:, 1], steps[:, 0])
        self._s = np.concatenate([[0.0], np.hypot(*steps.T).cumsum()])

    @cached_property
    def linestring(self):
        return LineString(self.points)

    @property
    def length(self):
        return float(self._s[-1])

    @cached_property
    def discrete_path(self):
        heading = np.append(self._heading, self._heading[-1])
        return [StateSE2(*map(float, pose)) for pose in zip(*self.points.T, heading)]

    def get_nearest_arc_length_from_position(self, point):
        return float(self.linestring.project(Point(point.x, point.y)))

    def get_nearest_pose_from_position(self, point):
        s = self.get_nearest_arc_length_from_position(point)
        on = self.linestring.interpolate(s)
        return StateSE2(on.x, on.y, float(self._heading[self._segment(s)]))

    def get_curvature_at_arc_length(self, arc_length):
        """Change of heading over the metre on either side."""
        ends = np.clip([arc_length - 1.0, arc_length + 1.0], 0.0, self.length)
        turn = wrap(self._heading[self._segment(ends[1])] - self._heading[self._segment(ends[0])])
        return float(turn / max(ends[1] - ends[0], 1e-6))

    def _segment(self, s):
        return min(int(np.searchsorted(self._s[1:], s)), len(self._heading) - 1)


class LaneOfScene:
    """What lanes and lane connectors have in common; edges are of the same kind of object."""

    def __init__(self, name, points, width):
        super().__init__(name)
        self.width, self.light = width, None
        self.incoming, self.outgoing, self.left, self.right, self.block, self.limit = [], [], None, None, None, None
        normal = np.gradient(points, axis=0)[:, ::-1] * [-1.0, 1.0]
        normal *= width / 2 / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        self._lines = [Polyline(f"{name}{tail}", points + side * normal) for tail, side in (("", 0), ("l", 1), ("r", -1))]

    incoming_edges = property(lambda self: self.incoming)
    outgoing_edges = property(lambda self: self.outgoing)
    baseline_path = property(lambda self: self._lines[0])
    left_boundary = property(lambda self: self._lines[1])
    right_boundary = property(lambda self: self._lines[2])
    adjacent_edges = property(lambda self: (self.left, self.right))
    speed_limit_mps = property(lambda self: self.limit)
    parent = property(lambda self: self.block)
    parallel_edges = property(lambda self: self.block.interior_edges)
    stop_lines = property(lambda self: [])
    index = property(lambda self: self.block.interior_edges.index(self) + 1)

    @cached_property
    def polygon(self):
        return self._lines[0].linestring.buffer(self.width / 2, cap_style=2)

    def get_roadblock_id(self):
        return self.block.id

    def has_traffic_lights(self):
        return self.light is not None

    def is_left_of(self, other):
        assert self.is_same_roadblock(other), "Lanes must be in the same roadblock"
        return self.index < other.index

    def is_right_of(self, other):
        assert self.is_same_roadblock(other), "Lanes must be in the same roadblock"
        return self.index > other.index

    def oriented_distance(self, point):
        pose = self.baseline_path.get_nearest_pose_from_position(point)
        side = math.cos(pose.heading) * (point.y - pose.y) - math.sin(pose.heading) * (point.x - pose.x)
        return math.copysign(math.hypot(point.x - pose.x, point.y - pose.y), side)

    def get_width_left_right(self, point, include_outside=False):
        if not include_outside and not self.contains_point(point):
            return math.inf, math.inf
        left = self.oriented_distance(point)
        return self.width / 2 - left, self.width / 2 + left


class SceneLane(LaneOfScene, Lane):
    """A lane that is no connector."""


class SceneLaneConnector(LaneOfScene, LaneConnector):
    """A lane with a light, or at a split or a merge."""

    adjacent_edges = LaneOfScene.adjacent_edges

    @property
    def turn_type(self):
        path = self.baseline_path.discrete_path
        turn = math.degrees(wrap(path[-1].heading - path[0].heading))
        if abs(turn) < 20:
            return LaneConnectorType.STRAIGHT
        return LaneConnectorType.UTURN if abs(turn) > 150 else LaneConnectorType.LEFT if turn > 0 else LaneConnectorType.RIGHT


class SceneRoadblock(RoadBlockGraphEdgeMapObject):
    """Lanes side by side, from left to right."""

    children_stop_lines = property(lambda self: [])
    parallel_edges = property(lambda self: [self])

    def __init__(self, name, lanes):
        super().__init__(name)
        self.interior_edges_, self.connector = lanes, isinstance(lanes[0], SceneLaneConnector)

    interior_edges = property(lambda self: self.interior_edges_)
    incoming_edges = property(lambda self: self._blocks("incoming"))
    outgoing_edges = property(lambda self: self._blocks("outgoing"))

    @cached_property
    def polygon(self):
        """The lanes, with the gaps of up to 2 m between them."""
        lanes = unary_union([lane.polygon for lane in self.interior_edges])
        return lanes.buffer(1.0, join_style=2).buffer(-1.0, join_style=2)

    def _blocks(self, edges):
        found = {edge.block.id: edge.block for lane in self.interior_edges for edge in getattr(lane, edges)}
        return [block for name, block in found.items() if name != self.id]


def roadblocks_of(left, right, exits):
    """Rows of lanes [list], each from left to right: neighbours on both sides, none of which follows another. left,
    right: neighbour of each lane, -1 none; exits: the set of successors of each."""
    row = {lane: [lane] for lane in range(len(left))}
    for lane, other in enumerate(left):
        if other < 0 or right[other] != lane or row[lane] is row[other]:
            continue
        joined = row[other] + row[lane]
        if not any(exits[one].intersection(joined) for one in joined):
            row.update(dict.fromkeys(joined, joined))
    return list({id(lanes): lanes for lanes in row.values()}.values())


class SceneMap(AbstractMap):
    """The lanes of a scene, and roadblocks made of lanes side by side. All other layers are empty, but the drivable
    area, which is the lanes'."""

    def __init__(self, name, lines, about, lights):
        """lines: points [P, 2] by lane; about [L, 9]: width, left, right and 6 exits; lights [S, 2]: where lanes with
        lights begin."""
        self._name = name
        exits = [{int(n) for n in row[3:] if int(n) in lines} for row in about]
        entries = [sum(lane in after for after in exits) for lane in range(len(about))]
        starts = {lane: points[0] for lane, points in lines.items()}
        lit = {lane for lane, start in starts.items() if len(lights) and np.hypot(*(lights - start).T).min() < 0.5}
        branches = {lane for after in exits if len(after) > 1 for lane in after}
        merges = {lane for lane, after in enumerate(exits) if any(entries[n] > 1 for n in after)}
        sides = [[int(n) if int(n) in lines else -1 for n in row[1:3]] for row in about]
        self.lanes, self.blocks = {}, []
        for row in roadblocks_of([side[0] for side in sides], [side[1] for side in sides], exits):
            row = [lane for lane in row if lane in lines]
            kind = SceneLaneConnector if not (lit | branches | merges).isdisjoint(row) else SceneLane
            self.lanes.update({lane: kind(str(lane), lines[lane], float(about[lane][0])) for lane in row})
            if row:
                self.blocks.append(SceneRoadblock(str(len(about) + len(self.blocks)), [self.lanes[n] for n in row]))
        for block in self.blocks:
            for lane in block.interior_edges:
                lane.block = block
                lane.left, lane.right = (self.lanes.get(n) for n in sides[int(lane.id)])
                lane.outgoing = [self.lanes[n] for n in sorted(exits[int(lane.id)])]
                for after in lane.outgoing:
                    after.incoming.append(lane)
        kinds = [
            [lane for lane in self.lanes.values() if isinstance(lane, Lane)],
            [lane for lane in self.lanes.values() if isinstance(lane, LaneConnector)],
            [block for block in self.blocks if not block.connector],
            [block for block in self.blocks if block.connector],
        ]
        self._objects = dict(zip(LANE_LAYERS + BLOCK_LAYERS, kinds))
        self._objects.update({layer: [] for layer in EMPTY_LAYERS})

    map_name = property(lambda self: self._name)

    def get_available_map_objects(self):
        return list(self._objects)

    def get_available_raster_layers(self):
        return []

    def get_raster_map_layer(self, layer):
        raise NotImplementedError("e2rl's scenes have no raster maps")

    def get_raster_map(self, layers):
        raise NotImplementedError("e2rl's scenes have no raster maps")

    def get_distance_to_nearest_raster_layer(self, point, layer):
        raise NotImplementedError("e2rl's scenes have no raster maps")

    def initialize_all_layers(self):
        """Everything is there already."""

    def get_map_object(self, object_id, layer):
        return next((one for one in self._of(layer) if one.id == str(object_id)), None)

    def get_all_map_objects(self, point, layer):
        return [one for one in self._near(point, 0.0, layer) if one.contains_point(point)]

    def get_one_map_object(self, point, layer):
        found = self.get_all_map_objects(point, layer)
        assert len(found) <= 1, f"{len(found)} map objects found; use get_all_map_objects()"
        return found[0] if found else None

    def is_in_layer(self, point, layer):
        layers = LANE_LAYERS if layer == SemanticMapLayer.DRIVABLE_AREA else (layer,)
        return any(self.get_all_map_objects(point, one) for one in layers)

    def get_proximal_map_objects(self, point, radius, layers):
        """Objects that touch the square of half the side `radius` around a point, as in nuPlan."""
        patch = box(point.x - radius, point.y - radius, point.x + radius, point.y + radius)
        return {layer: [one for one in self._near(point, radius, layer) if one.polygon.intersects(patch)] for layer in layers}

    def get_distance_to_nearest_map_object(self, point, layer):
        at = Point(point.x, point.y)
        found = [(one.polygon.distance(at), one.id) for one in self._of(layer)]
        return min(found)[::-1] if found else (None, None)

    def get_distances_matrix_to_nearest_map_object(self, points, layer):
        found = [self.get_distance_to_nearest_map_object(point, layer)[1] for point in points]
        return None if None in found else np.array(found)

    def _get_roadblock(self, name):  # PDM-Closed asks its map by these
        return self.get_map_object(name, SemanticMapLayer.ROADBLOCK)

    def _get_roadblock_connector(self, name):
        return self.get_map_object(name, SemanticMapLayer.ROADBLOCK_CONNECTOR)

    def _of(self, layer):
        if layer not in self._objects:
            raise NotImplementedError(f"e2rl's scenes have no layer {getattr(layer, 'name', layer)}")
        return self._objects[layer]

    def _near(self, point, radius, layer):
        """Objects of a layer whose bounding box comes within `radius` of a point along x and y."""
        objects = self._of(layer)
        if not objects:
            return []
        low, high = self._bounds(layer)
        at = np.array([point.x, point.y])
        return [objects[i] for i in np.flatnonzero(((low <= at + radius) & (high >= at - radius)).all(1))]

    def _bounds(self, layer):
        known = self.__dict__.setdefault("_boxes", {})
        if layer not in known:
            bounds = np.array([one.polygon.bounds for one in self._of(layer)])
            known[layer] = bounds[:, :2], bounds[:, 2:]
        return known[layer]


def lanes_along(route, lanes):
    """The lane [P] of each point of a route [P, 2], None where no lane is near: the cheapest sequence of lanes by
    distance, lane changes and jumps. lanes: SceneLane and SceneLaneConnector by number."""
    steps = np.gradient(route, axis=0)
    heading, names, cost = np.arctan2(steps[:, 1], steps[:, 0]), [], []
    for name, lane in lanes.items():
        path = np.array([list(pose) for pose in lane.baseline_path.discrete_path])
        low, high = path[:, :2].min(0) - DISTANT, path[:, :2].max(0) + DISTANT
        if not ((route >= low) & (route <= high)).all(1).any():
            continue
        distance = np.linalg.norm(route[:, None] - path[None, :, :2], axis=-1)
        distance[np.abs(wrap(heading[:, None] - path[None, :, 2])) > math.radians(STRAY)] = np.inf
        if distance.min() < DISTANT:
            names.append(name)
            cost.append(distance.min(1))
    if not names:
        return [None] * len(route)
    cost = np.array(cost).T  # [P, lanes near the route]
    change = np.full((len(names), len(names)), JUMP)
    for i, name in enumerate(names):
        lane = lanes[name]
        for j, other in enumerate(lanes[n] for n in names):
            if lane is other or other in lane.outgoing:
                change[i, j] = 0.0
            elif other in (lane.left, lane.right):
                change[i, j] = ASIDE
    best, came = np.minimum(cost[0], DISTANT), []
    for now in cost[1:]:
        total = best[:, None] + change
        came.append(total.argmin(0))
        best = total.min(0) + np.minimum(now, DISTANT)
    at = int(best.argmin())
    found = [at]
    for before in reversed(came):
        found.append(int(before[found[-1]]))
    on = cost[np.arange(len(route)), found[::-1]] < DISTANT
    return [names[i] if near else None for i, near in zip(found[::-1], on)]


# --- scenes ----------------------------------------------------------------------------------------------------------


class Scene:
    """A scene of e2rl and its planner."""

    def __init__(self, payload, make):
        """payload: of SCENE; make: returns a new planner."""
        self._make, self._planner, self._buffer, self._last = make, None, None, None
        (_, index, count, dots, lanes, lights), at = struct.unpack_from("<6I", payload), 36
        length, width, self._end = struct.unpack_from("<3f", payload, 24)

        def take(rows, form):
            nonlocal at
            size = struct.calcsize("<" + form)
            found = list(struct.iter_unpack("<" + form, payload[at : at + rows * size]))
            at += rows * size
            return found

        route, self._ahead = np.array(take(count, "3f")), take(2, "if")
        points, about = np.array(take(dots, "i2f")).reshape(-1, 3), take(lanes, "f8i")
        self._lights = np.array(take(lights, "2f")).reshape(-1, 2)
        lines = {lane: points[points[:, 0] == lane, 1:] for lane in range(lanes)}
        lines = {lane: line[np.append(True, np.abs(np.diff(line, axis=0)).sum(1) > 1e-6)] for lane, line in lines.items() if len(line)}
        self.map = SceneMap(f"scene-{index}", {lane: line for lane, line in lines.items() if len(line) > 1}, about, self._lights)
        self._route, self._limit = route[:, :2], route[:, 2]
        self.vehicle = VehicleParameters(
            width=width,
            front_length=(1 - REAR) * length,
            rear_length=REAR * length,
            cog_position_from_rear_axle=COG * length,
            wheel_base=WHEEL_BASE * length,
            vehicle_name="e2rl",
            vehicle_type="scene",
            height=HEIGHT,
        )
        self._on = self._match()

    def _match(self):
        """The lane of each point of the route, which gives lanes their limits and the lights of the route."""
        on = lanes_along(self._route, self.map.lanes)
        for lane, limit in zip(on, self._limit):
            if lane is not None and limit > 0:
                for beside in self.map.lanes[lane].block.interior_edges:
                    beside.limit = beside.limit or float(limit)
        taken = set()
        for light, s in self._ahead:
            near = on[max(math.ceil(s / SPACING), 0) :][:1] if light >= 0 else []
            for lane in near:
                if lane is not None and self._begins(lane, light):
                    self.map.lanes[lane].light = light
                    taken.add(light)
        for light in range(len(self._lights)):  # of several lanes that begin at one point: in their order
            free = (n for n, lane in self.map.lanes.items() if lane.light is None and self._begins(n, light))
            lane = None if light in taken else next(free, None)
            if lane is not None:
                self.map.lanes[lane].light = light
        return on

    def _begins(self, lane, light):
        return bool(np.hypot(*(self.map.lanes[lane].baseline_path.points[0] - self._lights[light])) < 0.5)

    def plan(self, step, states, agents):
        """States [K, 4] of the ego's centre; states: of the lights; agents: records of PLAN, the ego first."""
        now = {record[0]: record for record in agents}
        self._remember(step, now)
        if self._planner is None:
            self._planner = self._begin(now[0])
        time = TimePoint(START_US + step * STEP_US)
        status = [
            TrafficLightStatusData(LIGHTS[states[lane.light]], int(lane.id), time.time_us)
            for lane in self.map.lanes.values()
            if lane.light is not None
        ]
        planned = self._planner.compute_planner_trajectory(PlannerInput(SimulationIteration(time, step), self._buffer, status))
        return self._sampled(planned, time.time_us, now[0])

    def _begin(self, ego):
        planner = self._make()
        if planner.observation_type() is not DetectionsTracks:
            raise TypeError(f"{planner.name()} observes {planner.observation_type().__name__}; e2rl has DetectionsTracks only")
        near = int(np.hypot(*(self._route - ego[2:4]).T).argmin())
        until = max(near + 2, min(len(self._route), int(min(self._end, 1e6) / SPACING) + 1))
        lanes = [self.map.lanes[lane] for lane in self._on[near:until] if lane is not None]
        blocks = list({lane.block.id: lane.block for lane in lanes}.values())
        if len(blocks) == 1:  # nuPlan's IDMPlanner needs two
            blocks = blocks[0].incoming_edges[:1] + blocks
        (x, y), (dx, dy) = self._route[until - 1], self._route[until - 1] - self._route[until - 2]
        goal = StateSE2(float(x), float(y), math.atan2(dy, dx))
        planner.initialize(PlannerInitialization([block.id for block in blocks], goal, self.map))
        return planner

    def _remember(self, step, now):
        """Append the moments since the last plan to the history. At the first plan, everybody has come at its present
        speed and yaw rate; between two plans, everybody is interpolated."""
        if self._last is None:
            past = [(step - back, {name: backward(one, STEP * back) for name, one in now.items()}) for back in range(PAST, 0, -1)]
        else:
            before, old = self._last
            past = [(k, between(old, now, (k - before) / (step - before))) for k in range(before + 1, step)]
        frames = [(self._ego(k, moment[0]), self._tracks(k, moment)) for k, moment in [*past, (step, now)]]
        if self._buffer is None:
            self._buffer = SimulationHistoryBuffer.initialize_from_list(PAST + 1, *map(list, zip(*frames)), STEP)
        else:
            self._buffer.extend(*map(list, zip(*frames)))
        self._last = step, now

    def _ego(self, step, record):
        _, _, x, y, heading, speed, _, _, acceleration, yaw_rate = record
        steer = math.atan(self.vehicle.wheel_base * yaw_rate / speed) if speed > 0.5 else 0.0
        return EgoState.build_from_center(
            center=StateSE2(x, y, heading),
            center_velocity_2d=StateVector2D(speed, 0.0),
            center_acceleration_2d=StateVector2D(acceleration, speed * yaw_rate),
            tire_steering_angle=steer,
            time_point=TimePoint(START_US + step * STEP_US),
            vehicle_parameters=self.vehicle,
            angular_vel=yaw_rate,
        )

    def _tracks(self, step, moment):
        time, found = START_US + step * STEP_US, []
        for name, kind, x, y, heading, speed, length, width, _, yaw_rate in list(moment.values())[1:]:
            token = f"agent-{name}"
            found.append(
                Agent(
                    tracked_object_type=TYPES[kind],
                    oriented_box=OrientedBox(StateSE2(x, y, heading), length, width, HEIGHT),
                    velocity=StateVector2D(speed * math.cos(heading), speed * math.sin(heading)),
                    metadata=SceneObjectMetadata(time, f"{token}-{time}", name, token),
                    angular_velocity=yaw_rate,
                )
            )
        return DetectionsTracks(TrackedObjects(found))

    def _sampled(self, planned, now, ego):
        """A trajectory at steps of 0.1 s, its rear axle moved to the centre of the scene's ego."""
        count = min(50, (planned.end_time.time_us - now + STEP_US // 100) // STEP_US)
        times = [min(now + k * STEP_US, planned.end_time.time_us) for k in range(1, count + 1)]
        found, ahead = [], self.vehicle.rear_axle_to_center
        for state in (planned.get_state_at_time(TimePoint(int(time))) for time in times):
            x, y, heading = state.rear_axle
            speed = state.dynamic_car_state.rear_axle_velocity_2d.x
            found.append((x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading, speed))
        if not found:
            raise ValueError("its trajectory ends within 0.1 s")
        way = np.array([ego[2:6], *found], float)
        driven, told = np.hypot(*np.diff(way[:, :2], axis=0).T).sum(), STEP * np.abs(way[1:, 3]).sum()
        if abs(driven - told) > 2.0 + 0.25 * driven:  # e2rl tracks the speeds
            raise ValueError(f"its poses move {driven:.1f} m, its rear-axle velocities {told:.1f} m")
        return found


def backward(record, seconds):
    """An agent's record so many seconds ago, at its present speed and yaw rate."""
    name, kind, x, y, heading, speed, length, width, _, rate = record
    middle = heading - rate * seconds / 2
    chord = speed * seconds * (math.sin(rate * seconds / 2) / (rate * seconds / 2) if abs(rate) > 1e-6 else 1.0)
    x, y = x - chord * math.cos(middle), y - chord * math.sin(middle)
    return name, kind, x, y, wrap(heading - rate * seconds), speed, length, width, 0.0, rate


def between(old, new, fraction):
    """Records of the agents that are there at both moments, at a fraction of the time between them."""
    found = {}
    for name in new.keys() & old.keys():
        first, last = np.array(old[name][2:]), np.array(new[name][2:])
        change = last - first
        change[2] = wrap(change[2])
        found[name] = (*new[name][:2], *(first + fraction * change).tolist())
    return {name: found[name] for name in sorted(found)}


# --- the process -----------------------------------------------------------------------------------------------------


def read_plan(payload):
    """Yields (scene, step, states of the lights, records of the agents, the ego first)."""
    (count,), at = struct.unpack_from("<I", payload), 4
    for _ in range(count):
        scene, step, agents, lights = struct.unpack_from("<4I", payload, at)
        end = at + 16 + 4 * lights
        states = struct.unpack_from(f"<{lights}I", payload, at + 16)
        at = end + 40 * agents
        yield scene, step, states, list(struct.iter_unpack("<2I8f", payload[end:at]))


class Connection(socketserver.StreamRequestHandler):
    """One worker process of e2rl."""

    def handle(self):
        scenes = {}
        while header := self.rfile.read(8):
            kind, length = struct.unpack("<II", header)
            payload = self.rfile.read(length)
            if kind == HELLO:
                self.reply(HELLO, struct.pack("<I", VERSION))
            elif kind == SCENE:
                scenes[struct.unpack_from("<I", payload)[0]] = payload
            elif kind == PLAN:
                for scene, *moment in read_plan(payload):
                    try:
                        if isinstance(scenes[scene], bytes):
                            scenes[scene] = Scene(scenes[scene], self.server.make)
                        states = scenes[scene].plan(*moment)
                        words = struct.pack(f"<2I{4 * len(states)}f", scene, len(states), *np.ravel(states))
                        self.reply(TRAJECTORY, words)
                    except Exception as error:  # ends this scene's rollout only
                        traceback.print_exc()
                        why = f"{type(error).__name__}: {error} ({place(error)})"
                        self.reply(FAILED, struct.pack("<I", scene) + why.encode()[:1000])

    def reply(self, kind, payload):
        self.wfile.write(struct.pack("<II", kind, len(payload)) + payload)


def place(error):
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{os.path.basename(last.filename)}, line {last.lineno}"


class Unix(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    """Listens at a path."""


def maker(options):
    """What makes a planner, by the command line."""
    if options.config:  # the devkit's own libraries; its files hold the planner under a name
        from hydra.utils import instantiate
        from omegaconf import OmegaConf

        config = OmegaConf.load(options.config)
        if "_target_" not in config:
            (config,) = config.values()
        return lambda: instantiate(config)
    module, _, name = options.planner.partition(":")
    kind, given = getattr(importlib.import_module(module), name), {}
    for argument in options.arguments:
        key, _, value = argument.partition("=")
        try:
            given[key] = ast.literal_eval(value)
        except (SyntaxError, ValueError):
            given[key] = value
    return lambda: kind(**given)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--planner", metavar="MODULE:CLASS")
    which.add_argument("--config", metavar="PLANNER.yaml", help="names the class as _target_, as nuPlan's configuration does")
    parser.add_argument("arguments", nargs="*", metavar="NAME=VALUE", help="arguments of the class")
    parser.add_argument("address", metavar="ADDRESS", help="unix:PATH or HOST:PORT to listen at; e2rl adds it")
    options = parser.parse_args()
    sys.path.insert(0, os.getcwd())
    make = maker(options)
    if options.address.startswith("unix:"):  # started by e2rl: ends with its connection
        with Unix(options.address[len("unix:") :], Connection) as server:
            server.make = make
            server.handle_request()
    else:
        host, _, port = options.address.rpartition(":")
        with socketserver.ThreadingTCPServer((host, int(port)), Connection) as server:
            server.make = make
            server.serve_forever()


if __name__ == "__main__":
    main()
