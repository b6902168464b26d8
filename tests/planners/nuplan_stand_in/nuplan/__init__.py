"""A stand-in for nuplan-devkit, which no package index has: as much of its published
interface as the adapter and the planners of the tests use, under the devkit's module
names. Written from the interface; it holds none of its code."""

import math
import sys
from abc import ABCMeta, abstractmethod
from collections import deque
from dataclasses import dataclass
from enum import Enum, IntEnum

from shapely.geometry import Point

MODULES = """
common.actor_state.agent common.actor_state.ego_state common.actor_state.oriented_box common.actor_state.scene_object
common.actor_state.state_representation common.actor_state.tracked_objects common.actor_state.tracked_objects_types
common.actor_state.vehicle_parameters common.maps.abstract_map common.maps.abstract_map_objects
common.maps.maps_datatypes planning.simulation.history.simulation_history_buffer
planning.simulation.observation.observation_type planning.simulation.planner.abstract_planner
planning.simulation.simulation_time_controller.simulation_iteration
planning.simulation.trajectory.interpolated_trajectory
"""


@dataclass
class Point2D:
    x: float
    y: float


@dataclass
class StateSE2(Point2D):
    heading: float


@dataclass
class StateVector2D:
    x: float
    y: float


@dataclass(order=True)
class TimePoint:
    time_us: int

    def __post_init__(self):
        assert isinstance(self.time_us, int)
        assert self.time_us >= 0


class VehicleParameters:
    def __init__(
        self,
        width,
        front_length,
        rear_length,
        cog_position_from_rear_axle,
        wheel_base,
        vehicle_name,
        vehicle_type,
        height=None,
    ):
        self.width = width
        self.length = front_length + rear_length
        self.height = height
        self.front_length = front_length
        self.rear_length = rear_length
        self.wheel_base = wheel_base
        self.rear_axle_to_center = self.length / 2 - rear_length


@dataclass
class OrientedBox:
    center: StateSE2
    length: float
    width: float
    height: float


@dataclass
class CarFootprint:
    vehicle_parameters: VehicleParameters


@dataclass
class DynamicCarState:
    rear_axle_velocity_2d: StateVector2D
    center_velocity_2d: StateVector2D
    center_acceleration_2d: StateVector2D
    angular_velocity: float


@dataclass
class EgoState:
    center: StateSE2
    rear_axle: StateSE2
    dynamic_car_state: DynamicCarState
    time_point: TimePoint
    car_footprint: CarFootprint

    @classmethod
    def build_from_center(
        cls,
        center,
        center_velocity_2d,
        center_acceleration_2d,
        tire_steering_angle,
        time_point,
        vehicle_parameters,
        is_in_auto_mode=True,
        angular_vel=0.0,
        angular_accel=0.0,
    ):
        back = vehicle_parameters.rear_axle_to_center
        rear = StateVector2D(
            center_velocity_2d.x, center_velocity_2d.y - back * angular_vel
        )
        dynamic = DynamicCarState(
            rear,
            center_velocity_2d,
            center_acceleration_2d=center_acceleration_2d,
            angular_velocity=angular_vel,
        )
        return cls(
            center,
            moved(center, -back),
            dynamic,
            time_point,
            CarFootprint(vehicle_parameters),
        )

    @classmethod
    def build_from_rear_axle(
        cls,
        rear_axle_pose,
        rear_axle_velocity_2d,
        rear_axle_acceleration_2d,
        tire_steering_angle,
        time_point,
        vehicle_parameters,
        is_in_auto_mode=True,
        angular_vel=0.0,
    ):
        ahead = vehicle_parameters.rear_axle_to_center
        rear = rear_axle_velocity_2d
        velocity = StateVector2D(rear.x, rear.y + ahead * angular_vel)
        dynamic = DynamicCarState(
            rear,
            velocity,
            center_acceleration_2d=rear_axle_acceleration_2d,
            angular_velocity=angular_vel,
        )
        return cls(
            moved(rear_axle_pose, ahead),
            rear_axle_pose,
            dynamic,
            time_point,
            CarFootprint(vehicle_parameters),
        )


def moved(pose, ahead):
    return StateSE2(
        pose.x + ahead * math.cos(pose.heading),
        pose.y + ahead * math.sin(pose.heading),
        heading=pose.heading,
    )


TrackedObjectType = Enum(
    "TrackedObjectType",
    "VEHICLE PEDESTRIAN BICYCLE TRAFFIC_CONE BARRIER CZONE_SIGN GENERIC_OBJECT EGO",
)


@dataclass(frozen=True)
class SceneObjectMetadata:
    timestamp_us: int
    token: str
    track_id: int
    track_token: str


class Agent:
    def __init__(
        self,
        tracked_object_type,
        oriented_box,
        velocity,
        metadata,
        angular_velocity=None,
    ):
        self.tracked_object_type = tracked_object_type
        self.box = oriented_box
        self.velocity = velocity
        self.metadata = metadata
        self.track_token = metadata.track_token
        self.angular_velocity = angular_velocity
        self.center = oriented_box.center


class TrackedObjects:
    def __init__(self, tracked_objects=()):
        self.tracked_objects = list(tracked_objects)


class Observation:
    """Any of nuPlan's."""


class Sensors(Observation):
    """Of pictures and point clouds."""


@dataclass
class DetectionsTracks(Observation):
    tracked_objects: TrackedObjects


class SimulationHistoryBuffer:
    def __init__(
        self,
        ego_state_buffer,
        observations_buffer,
        sample_interval=None,
    ):
        self._egos = ego_state_buffer
        self._observations = observations_buffer
        self.sample_interval = sample_interval

    @classmethod
    def initialize_from_list(
        cls,
        buffer_size,
        ego_states,
        observations,
        sample_interval=None,
    ):
        return cls(
            deque(ego_states, buffer_size),
            deque(observations, buffer_size),
            sample_interval,
        )

    ego_states = property(lambda self: list(self._egos))
    observations = property(lambda self: list(self._observations))
    current_state = property(lambda self: (self._egos[-1], self._observations[-1]))

    def append(self, ego_state, observation):
        self._egos.append(ego_state)
        self._observations.append(observation)


@dataclass
class SimulationIteration:
    time_point: TimePoint
    index: int


class SemanticMapLayer(IntEnum):
    LANE = 0
    INTERSECTION = 1
    STOP_LINE = 2
    CROSSWALK = 4
    DRIVABLE_AREA = 5
    LANE_CONNECTOR = 11
    WALKWAYS = 14
    CARPARK_AREA = 15
    ROADBLOCK = 17
    ROADBLOCK_CONNECTOR = 18


LaneConnectorType = IntEnum(
    "LaneConnectorType", "STRAIGHT LEFT RIGHT UTURN UNKNOWN", start=0
)
TrafficLightStatusType = IntEnum(
    "TrafficLightStatusType", "GREEN YELLOW RED UNKNOWN", start=0
)


@dataclass
class TrafficLightStatusData:
    status: TrafficLightStatusType
    lane_connector_id: int
    timestamp: int


def interface(name, members, *bases):
    """An abstract class of the given members."""
    return ABCMeta(
        name,
        bases,
        {member: abstractmethod(lambda self: None) for member in members.split()},
    )


class AbstractMapObject:
    def __init__(self, object_id):
        self.id = str(object_id)


class PolygonMapObject(interface("Polygonal", "polygon", AbstractMapObject)):
    def contains_point(self, point):
        return self.polygon.contains(Point(point.x, point.y))


GraphEdgeMapObject = interface(
    "GraphEdgeMapObject",
    "incoming_edges outgoing_edges parallel_edges",
    PolygonMapObject,
)
LANE = """baseline_path left_boundary right_boundary speed_limit_mps get_roadblock_id parent has_traffic_lights
stop_lines is_left_of is_right_of adjacent_edges get_width_left_right oriented_distance"""
LaneGraphEdgeMapObject = interface("LaneGraphEdgeMapObject", LANE, GraphEdgeMapObject)
Lane = interface("Lane", "index", LaneGraphEdgeMapObject)
LaneConnector = interface("LaneConnector", "turn_type", LaneGraphEdgeMapObject)
BLOCK = "interior_edges children_stop_lines"
RoadBlockGraphEdgeMapObject = interface(
    "RoadBlockGraphEdgeMapObject", BLOCK, GraphEdgeMapObject
)
LINE = """linestring length discrete_path get_nearest_arc_length_from_position get_nearest_pose_from_position
get_curvature_at_arc_length"""
PolylineMapObject = interface("PolylineMapObject", LINE, AbstractMapObject)
MAP = """get_available_map_objects get_available_raster_layers get_raster_map_layer get_raster_map map_name
get_all_map_objects get_one_map_object is_in_layer get_proximal_map_objects get_map_object
get_distance_to_nearest_map_object get_distance_to_nearest_raster_layer get_distances_matrix_to_nearest_map_object
initialize_all_layers"""
AbstractMap = interface("AbstractMap", MAP)


@dataclass(frozen=True)
class PlannerInitialization:
    route_roadblock_ids: list
    mission_goal: StateSE2
    map_api: AbstractMap


@dataclass(frozen=True)
class PlannerInput:
    iteration: SimulationIteration
    history: SimulationHistoryBuffer
    traffic_light_data: list


AbstractPlanner = interface(
    "AbstractPlanner", "name initialize observation_type compute_planner_trajectory"
)


class InterpolatedTrajectory:
    def __init__(self, trajectory):
        self._states = trajectory

    def get_sampled_trajectory(self):
        return self._states


for module in MODULES.split():
    parts = module.split(".")
    sys.modules.update(
        {
            ".".join([__name__, *parts[:depth]]): sys.modules[__name__]
            for depth in range(1, 1 + len(parts))
        }
    )
