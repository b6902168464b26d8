"""Planners written against nuPlan's interface. They run in a process of their own, as a
user's do."""

import json
import math
import os
from pathlib import Path

from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.state_representation import (
    StateSE2,
    StateVector2D,
    TimePoint,
)
from nuplan.common.actor_state.vehicle_parameters import VehicleParameters
from nuplan.common.maps.maps_datatypes import SemanticMapLayer
from nuplan.planning.simulation.observation.observation_type import (
    DetectionsTracks,
    Sensors,
)
from nuplan.planning.simulation.planner.abstract_planner import AbstractPlanner
from nuplan.planning.simulation.trajectory.interpolated_trajectory import (
    InterpolatedTrajectory,
)

SECOND = 1_000_000  # us
LANES = [SemanticMapLayer.LANE, SemanticMapLayer.LANE_CONNECTOR]


class Straight(AbstractPlanner):
    """Keeps velocity and heading. It plans for a vehicle of its own, whose rear axle
    lies elsewhere in its box, as planners do that were tuned for nuPlan's."""

    vehicle = VehicleParameters(2.3, 4.0, 1.1, 1.7, 3.1, "mine", "one")

    def __init__(self, seconds=8.0):
        self.seconds = seconds

    def name(self):
        return type(self).__name__

    def observation_type(self):
        return DetectionsTracks

    def initialize(self, initialization):
        self.initialization = initialization

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        return self.straight(ego, ego.dynamic_car_state.center_velocity_2d.x)

    def straight(
        self,
        ego,
        speed,
        told=None,
    ):
        """At a speed; told: the speed that its states tell."""
        return InterpolatedTrajectory(
            [self.ahead(ego, speed, told, seconds) for seconds in (0.0, self.seconds)]
        )

    def ahead(
        self,
        ego,
        speed,
        told,
        seconds,
    ):
        pose = ego.rear_axle
        way = speed * seconds
        pose = StateSE2(
            pose.x + way * math.cos(pose.heading),
            pose.y + way * math.sin(pose.heading),
            pose.heading,
        )
        velocity = StateVector2D(speed if told is None else told, 0.0)
        zero = StateVector2D(0.0, 0.0)
        time = TimePoint(ego.time_point.time_us + round(seconds * SECOND))
        return EgoState.build_from_rear_axle(
            pose, velocity, zero, 0.0, time, self.vehicle
        )


class Wrong(Straight):
    """Goes wrong where the ego is at y = bad."""

    def __init__(self, how, bad=3.5):
        super().__init__()
        self.how = how
        self.bad = bad

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        if abs(ego.center.y - self.bad) > 0.5:
            return super().compute_planner_trajectory(current_input)
        if self.how == "raises":
            raise RuntimeError("no way out")
        if self.how == "short":
            self.seconds = 0.3
        if self.how == "elsewhere":
            ego.rear_axle.y += 20.0
            return self.straight(ego, 10.0)
        return self.straight(ego, 10.0, told=1.0 if self.how == "velocities" else None)


class Centred(Straight):
    """Plans on the centre of the ego's lane, wherever the ego is, at an acceleration.
    It tells poses only."""

    def __init__(self, acceleration):
        super().__init__()
        self.acceleration = acceleration
        self.path = None

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        if self.path is None:
            (lane,) = self.initialization.map_api.get_all_map_objects(
                ego.center, SemanticMapLayer.LANE
            )
            self.path = lane.baseline_path
        nearest = self.path.get_nearest_pose_from_position(ego.rear_axle)
        speed = state_of(ego)[3]
        return InterpolatedTrajectory(
            [self.later(ego, nearest, speed, step / 10) for step in range(81)]
        )

    def later(
        self,
        ego,
        begin,
        speed,
        seconds,
    ):
        way = speed * seconds + self.acceleration * seconds**2 / 2
        zero = StateVector2D(0.0, 0.0)
        pose = StateSE2(
            begin.x + way * math.cos(begin.heading),
            begin.y + way * math.sin(begin.heading),
            begin.heading,
        )
        time = TimePoint(ego.time_point.time_us + round(seconds * SECOND))
        return EgoState.build_from_rear_axle(
            pose, zero, zero, 0.0, time, ego.car_footprint.vehicle_parameters
        )


class Camera(Straight):
    """Wants what e2rl has not."""

    def observation_type(self):
        return Sensors


class Witness(Straight):
    """Turns at a tenth of a radian a second, and writes what it sees, a line a plan, to
    the file E2RL_WITNESS."""

    def compute_planner_trajectory(self, current_input):
        history = current_input.history
        layers = SemanticMapLayer
        ego, observation = history.current_state
        observed = {
            "index": current_input.iteration.index,
            "interval": history.sample_interval,
            "times": [single.time_point.time_us for single in history.ego_states],
            "egos": [state_of(single) for single in history.ego_states],
            "rear": [
                *pose_of(ego.rear_axle),
                ego.dynamic_car_state.rear_axle_velocity_2d.y,
            ],
            "yaw_rate": ego.dynamic_car_state.angular_velocity,
            "size": [
                ego.car_footprint.vehicle_parameters.length,
                ego.car_footprint.vehicle_parameters.width,
            ],
            "agents": {
                single.track_token: agent_of(single)
                for single in observation.tracked_objects.tracked_objects
            },
            "before": [
                sorted(a.track_token for a in single.tracked_objects.tracked_objects)
                for single in history.observations
            ],
        }
        if current_input.iteration.index == 0:
            api = self.initialization.map_api
            blocks = []
            for name in self.initialization.route_roadblock_ids:
                block = api.get_map_object(name, layers.ROADBLOCK)
                blocks.append(
                    block or api.get_map_object(name, layers.ROADBLOCK_CONNECTOR)
                )
            around = api.get_proximal_map_objects(ego.center, 1.0, LANES)
            observed["on"] = [
                lane.id
                for layer in LANES
                for lane in api.get_all_map_objects(ego.center, layer)
            ]
            observed["near"] = [lane.id for lanes in around.values() for lane in lanes]
            observed["route"] = [
                [lane_of(lane) for lane in block.interior_edges] for block in blocks
            ]
            observed["linked"] = [
                after in block.outgoing_edges
                for block, after in zip(blocks, blocks[1:])
            ]
            observed["drivable"] = api.is_in_layer(ego.center, layers.DRIVABLE_AREA)
            observed["aside"] = [
                aside_of(api, ego.center, 0.25 * k) for k in range(-40, 41)
            ]
            observed["goal"] = pose_of(self.initialization.mission_goal)
            observed["lights"] = [
                [
                    single.status.name,
                    api.get_map_object(
                        single.lane_connector_id, layers.LANE_CONNECTOR
                    ).id,
                ]
                for single in current_input.traffic_light_data
            ]
        with Path(os.environ["E2RL_WITNESS"]).open("a") as file:
            file.write(json.dumps(observed) + "\n")
        return self.turning(ego)

    def turning(self, ego, rate=0.1):
        """An arc of the centre; the rear axle is where this vehicle's lies."""
        vehicle = ego.car_footprint.vehicle_parameters
        result = []
        speed = ego.dynamic_car_state.center_velocity_2d.x
        for step in range(51):
            turn = rate * step / 10
            chord = (
                speed * step / 10 * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
            )
            heading = ego.center.heading + turn
            x = ego.center.x + chord * math.cos(heading - turn / 2)
            y = ego.center.y + chord * math.sin(heading - turn / 2)
            time = TimePoint(ego.time_point.time_us + step * SECOND // 10)
            velocity = StateVector2D(speed, 0.0)
            zero = StateVector2D(0.0, 0.0)
            pose = StateSE2(x, y, heading)
            result.append(
                EgoState.build_from_center(
                    pose, velocity, zero, 0.0, time, vehicle, angular_vel=rate
                )
            )
        return InterpolatedTrajectory(result)


def pose_of(pose):
    return [pose.x, pose.y, pose.heading]


def state_of(ego):
    return [*pose_of(ego.center), ego.dynamic_car_state.center_velocity_2d.x]


def aside_of(api, pose, aside):
    """Where a point beside a pose lies: in the drivable area, in lanes and in what is
    drivable and no lane."""
    point = StateSE2(
        pose.x - aside * math.sin(pose.heading),
        pose.y + aside * math.cos(pose.heading),
        pose.heading,
    )
    layers = ([SemanticMapLayer.DRIVABLE_AREA], LANES, [SemanticMapLayer.CARPARK_AREA])
    return [
        aside,
        *(any(api.is_in_layer(point, layer) for layer in single) for single in layers),
    ]


def agent_of(agent):
    box = agent.box
    return [
        *pose_of(box.center),
        agent.velocity.x,
        agent.velocity.y,
        box.length,
        box.width,
        agent.tracked_object_type.name,
    ]


def lane_of(lane):
    left, right = lane.adjacent_edges
    return {
        "id": lane.id,
        "begin": pose_of(lane.baseline_path.discrete_path[0]),
        "limit": lane.speed_limit_mps,
        "index": lane.index,
        "left": left and left.id,
        "right": right and right.id,
        "width": lane.polygon.area / lane.baseline_path.length,
        "borders": [
            lane.oriented_distance(line.discrete_path[0])
            for line in (lane.left_boundary, lane.right_boundary)
        ],
        "turns": lane.baseline_path.get_curvature_at_arc_length(
            lane.baseline_path.length / 2
        ),
    }
