"""Serves a planner written for nuPlan to e2rl: `ego=nuplan` (docs/guide/nuplan.md).

    python nuplan_planner.py --planner MODULE:CLASS [NAME=VALUE ...] ADDRESS python
    nuplan_planner.py --config PLANNER.yaml ADDRESS

Runs in the Python in which nuplan-devkit is installed, with nuplan_map.py beside it; of
e2rl it needs nothing. It speaks the protocol of docs/guide/planner.md, and makes one
planner a scene.
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
from itertools import groupby

import numpy as np
from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox
from nuplan.common.actor_state.scene_object import SceneObjectMetadata
from nuplan.common.actor_state.state_representation import (
    StateSE2,
    StateVector2D,
    TimePoint,
)
from nuplan.common.actor_state.tracked_objects import TrackedObjects
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import VehicleParameters
from nuplan.common.maps.maps_datatypes import (
    TrafficLightStatusData,
    TrafficLightStatusType,
)
from nuplan.planning.simulation.history.simulation_history_buffer import (
    SimulationHistoryBuffer,
)
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.planner.abstract_planner import (
    PlannerInitialization,
    PlannerInput,
)
from nuplan.planning.simulation.simulation_time_controller.simulation_iteration import (
    SimulationIteration,
)
from nuplan_map import LIT, SceneMap, lanes_along, wrap

VERSION = 1
HELLO = 1
SCENE = 2
PLAN = 3
TRAJECTORY = 4
FAILED = 6
STEPS, STEP = 50, 0.1  # of a plan, at most; s
STEP_US, START_US = (
    100_000,
    10_000_000,
)  # us of a step; time of step 0, which leaves room for a past
PAST = 20  # steps of history besides the present, as in nuPlan's simulation
SPACING = 2.0  # m between two points of a route
AWAY = 5.0  # m from the ego: a trajectory that begins farther is in another frame, or on another road
HORIZON = 10  # steps to the speed at which nuPlan's controller aims
SHIFT_TIME, SHIFT_LENGTH = (
    1.5,
    6.0,
)  # s, m: way in which the ego comes over to a path beside it; the longer of the two
TYPES = (
    TrackedObjectType.VEHICLE,
    TrackedObjectType.PEDESTRIAN,
    TrackedObjectType.BICYCLE,
    TrackedObjectType.GENERIC_OBJECT,
)
LIGHTS = (
    TrafficLightStatusType.UNKNOWN,
    TrafficLightStatusType.RED,
    TrafficLightStatusType.YELLOW,
    TrafficLightStatusType.GREEN,
)
HEIGHT = 1.7  # m, of everybody: scenes have none
REAR, WHEEL_BASE, GRAVITY = (
    0.218,
    0.597,
    0.323,
)  # of the ego's length: rear axle to rear bumper, wheel base, rear axle to
# centre of gravity; those of nuPlan's vehicle


class Scene:
    """A scene and its planner."""

    def __init__(self, payload, make):
        """payload: of SCENE; make: returns a new planner."""
        self._make = make
        self._planner = None
        self._history = None
        self._last = None
        _, index, count, dots, lanes, lights, length, width, self._end = (
            struct.unpack_from("<6I3f", payload)
        )
        parts = []
        at = 36
        for rows, form in (
            (count, "3f"),
            (2, "if"),
            (dots, "i2f"),
            (lanes, "f8i"),
            (lights, "2f"),
        ):
            end = at + rows * struct.calcsize("<" + form)
            parts.append(list(struct.iter_unpack("<" + form, payload[at:end])))
            at = end
        route, self._ahead, points, about, lights = parts
        self._route = np.array(route)[:, :2]
        self._limit = np.array(route)[:, 2]
        self._lights = np.array(lights).reshape(-1, 2)
        self.map = SceneMap(
            f"scene {index}",
            lines_of(np.array(points).reshape(-1, 3)),
            about,
            self._lights,
        )
        self.vehicle = VehicleParameters(
            width=width,
            front_length=(1 - REAR) * length,
            rear_length=REAR * length,
            cog_position_from_rear_axle=GRAVITY * length,
            wheel_base=WHEEL_BASE * length,
            vehicle_name="ego",
            vehicle_type="e2rl",
            height=HEIGHT,
        )
        self._on = lanes_along(self._route, self.map.lanes)
        self._set_limits()
        self._set_lights()

    def _set_limits(self):
        """Limits are known along the route: its roadblocks have them."""
        for lane, limit in zip(self._on, self._limit):
            if lane is not None and limit > 0:
                for beside in self.map.lanes[lane].block.interior_edges:
                    beside.limit = beside.limit or float(limit)

    def _set_lights(self):
        """The lane of a light begins at its point. Of several that begin there, the
        route's lane has the route's light, and the others have theirs in their order.
        """
        lights = range(len(self._lights))
        mine = [
            (light, self._on[math.ceil(s / SPACING)])
            for light, s in self._ahead
            if light in lights
        ]
        free = {lane for lane in self.map.lanes if lane not in dict(mine).values()}
        for light, lane in [
            *mine,
            *((light, None) for light in lights if light not in dict(mine)),
        ]:
            candidates = sorted(free) if lane is None else [lane]
            for one in candidates:
                begin = self.map.lanes[one].baseline_path.points[0]
                if np.hypot(*(begin - self._lights[light])) < LIT:
                    self.map.lanes[one].light = light
                    free.discard(one)
                    break

    def plan(self, step, lights, agents):
        """States [K, 4] of the ego's centre. lights: their states; agents: records of
        PLAN, the ego first."""
        now = {record[0]: record for record in agents}
        self._remember(step, now)
        if self._planner is None:
            self._planner = self._begun(agents[0])
        time = TimePoint(START_US + step * STEP_US)
        status = [
            TrafficLightStatusData(
                LIGHTS[lights[lane.light]], int(lane.id), time.time_us
            )
            for lane in self.map.lanes.values()
            if lane.light is not None
        ]
        given = PlannerInput(SimulationIteration(time, step), self._history, status)
        return self._sampled(
            self._planner.compute_planner_trajectory(given), time.time_us, agents[0]
        )

    def _begun(self, ego):
        """A new planner, initialized with the route from where the ego is."""
        planner = self._make()
        observed = planner.observation_type()
        if observed is not DetectionsTracks:
            raise TypeError(
                f"{planner.name()} observes {observed.__name__}; e2rl has DetectionsTracks only"
            )
        near = int(np.hypot(*(self._route - ego[2:4]).T).argmin())
        last = min(len(self._route) - 1, int(min(self._end, 1e6) / SPACING))
        on = (
            self.map.lanes[lane].block
            for lane in self._on[near : last + 1]
            if lane is not None
        )
        blocks = [
            block for block, _ in groupby(on)
        ]  # a route may come twice through one
        if len(blocks) == 1:  # nuPlan's IDMPlanner needs two
            blocks = blocks[0].incoming_edges[:1] + blocks
        (x, y), (back_x, back_y) = self._route[last], self._route[last - 1]
        goal = StateSE2(float(x), float(y), math.atan2(y - back_y, x - back_x))
        planner.initialize(
            PlannerInitialization([block.id for block in blocks], goal, self.map)
        )
        return planner

    def _remember(self, step, now):
        """Append what came since the last plan. Between two plans all are interpolated;
        before the first one all came at the speed and yaw rate that they have then, for
        e2rl tells no more of the past."""
        if self._last is None:
            moments = [
                (step - k, {name: before(one, STEP * k) for name, one in now.items()})
                for k in range(PAST, 0, -1)
            ]
        else:
            last, old = self._last
            moments = [
                (k, between(old, now, (k - last) / (step - last)))
                for k in range(last + 1, step)
            ]
        egos, others = zip(
            *(
                (self._ego(k, moment[0]), tracks(k, moment))
                for k, moment in [*moments, (step, now)]
            )
        )
        if self._history is None:
            self._history = SimulationHistoryBuffer.initialize_from_list(
                1 + PAST, list(egos), list(others), STEP
            )
        else:
            for ego, other in zip(egos, others):
                self._history.append(ego, other)
        self._last = step, now

    def _ego(self, step, record):
        _, _, x, y, heading, speed, _, _, acceleration, yaw_rate = record
        return EgoState.build_from_center(
            center=StateSE2(x, y, heading),
            center_velocity_2d=StateVector2D(speed, 0.0),
            center_acceleration_2d=StateVector2D(acceleration, speed * yaw_rate),
            tire_steering_angle=math.atan(self.vehicle.wheel_base * yaw_rate / speed)
            if speed > 0.5
            else 0.0,
            time_point=TimePoint(START_US + step * STEP_US),
            vehicle_parameters=self.vehicle,
            angular_vel=yaw_rate,
        )

    def _sampled(self, trajectory, now, ego):
        """A trajectory every 0.1 s, linear between its states as nuPlan's
        InterpolatedTrajectory is. The rear axle is moved to the centre of the scene's
        ego, for planners may assume another vehicle."""
        planned = trajectory.get_sampled_trajectory()
        times = np.array([state.time_point.time_us for state in planned])
        if not times[0] - STEP_US <= now <= times[-1] - STEP_US:
            raise ValueError(
                f"the trajectory is of {(times[0] - now) / 1e6:g} to "
                f"{(times[-1] - now) / 1e6:g} s from now"
            )
        axles = [
            (one.rear_axle, one.dynamic_car_state.rear_axle_velocity_2d.x)
            for one in planned
        ]
        x, y, heading, speed = np.array(
            [(axle.x, axle.y, axle.heading, v) for axle, v in axles], float
        ).T
        at = now + STEP_US * np.arange(
            min(STEPS, round((times[-1] - now) / STEP_US)) + 1
        )
        x, y, heading, speed = (
            np.interp(at, times, one) for one in (x, y, np.unwrap(heading), speed)
        )
        ahead = self.vehicle.rear_axle_to_center
        x = x + ahead * np.cos(heading)
        y = y + ahead * np.sin(heading)
        away = math.hypot(x[0] - ego[2], y[0] - ego[3])
        if away > AWAY:
            raise ValueError(f"the trajectory begins {away:.1f} m from the ego")
        if speed.any():
            driven = np.hypot(np.diff(x), np.diff(y)).sum()
            told = STEP * np.abs(speed[1:]).sum()
            if (
                abs(driven - told) > 2.0 + 0.25 * driven
            ):  # e2rl follows poses and speeds
                raise ValueError(
                    f"the trajectory's poses move {driven:.1f} m, its rear-axle "
                    f"velocities {told:.1f} m"
                )
        else:
            speed = speeds_of(x, y, heading, ego[5])
        return returning(np.stack([x, y, heading, speed], 1), ego)[1:]


def speeds_of(x, y, heading, now):
    """Speeds [K] for poses [K] that tell none, from the speed now: an even change to
    that of the poses 1 s ahead, at which nuPlan's controller aims, then that of the
    poses."""
    speed = (np.gradient(x) * np.cos(heading) + np.gradient(y) * np.sin(heading)) / STEP
    until = min(HORIZON, len(speed) - 1)
    speed[: until + 1] = np.linspace(now, speed[until], until + 1)
    return speed


def returning(states, ego):
    """Planned states [K, 4], from the ego's pose on. Planners plan on a path beside
    which the ego may be; nuPlan's controller steers to it, and e2rl takes a plan to
    begin at the ego. The way over is a cubic polynomial."""
    x, y, heading, speed = states.T
    length = max(SHIFT_LENGTH, SHIFT_TIME * ego[5])
    way = np.append(0.0, np.hypot(np.diff(x), np.diff(y)).cumsum())
    part = np.minimum(way / length, 1.0)
    beside = math.cos(heading[0]) * (ego[3] - y[0]) - math.sin(heading[0]) * (
        ego[2] - x[0]
    )
    turned = math.tan(np.clip(wrap(ego[4] - heading[0]), -1.0, 1.0))
    aside = (1 - part) ** 2 * (beside * (1 + 2 * part) + turned * length * part)
    slope = (1 - part) * (turned * (1 - 3 * part) - 6 * beside * part / length)
    x = x - aside * np.sin(heading)
    y = y + aside * np.cos(heading)
    return np.stack([x, y, wrap(heading + np.arctan(slope)), speed], 1)


def lines_of(points):
    """Centrelines [P, 2] by lane of points [M, 3] (lane, x, y), without repeated points
    and lanes of one point."""
    lines = {
        int(lane): points[points[:, 0] == lane, 1:] for lane in np.unique(points[:, 0])
    }
    lines = {
        lane: line[np.append(True, np.diff(line, axis=0).any(1))]
        for lane, line in lines.items()
    }
    return {lane: line for lane, line in lines.items() if len(line) > 1}


def tracks(step, moment):
    """Everybody but the ego, as nuPlan's detections. moment: records by id, the ego
    first."""
    time = START_US + step * STEP_US
    found = []
    for name, kind, x, y, heading, speed, length, width, _, yaw_rate in list(
        moment.values()
    )[1:]:
        found.append(
            Agent(
                tracked_object_type=TYPES[kind],
                oriented_box=OrientedBox(
                    StateSE2(x, y, heading), length, width, HEIGHT
                ),
                velocity=StateVector2D(
                    speed * math.cos(heading), speed * math.sin(heading)
                ),
                metadata=SceneObjectMetadata(
                    time, f"agent-{name}-{time}", name, f"agent-{name}"
                ),
                angular_velocity=yaw_rate,
            )
        )
    return DetectionsTracks(TrackedObjects(found))


def before(record, seconds):
    """An agent's record so many seconds ago, at its present speed and yaw rate."""
    name, kind, x, y, heading, speed, length, width, _, yaw_rate = record
    half = yaw_rate * seconds / 2
    chord = speed * seconds * (math.sin(half) / half if half else 1.0)
    x = x - chord * math.cos(heading - half)
    y = y - chord * math.sin(heading - half)
    return (
        name,
        kind,
        x,
        y,
        wrap(heading - 2 * half),
        speed,
        length,
        width,
        0.0,
        yaw_rate,
    )


def between(old, new, fraction):
    """Records of the agents that are there at both of two moments, at a fraction of the
    time between them."""
    found = {}
    for name, record in new.items():
        if name in old:
            change = np.subtract(record[2:], old[name][2:])
            change[2] = wrap(change[2])
            found[name] = (*record[:2], *(old[name][2:] + fraction * change).tolist())
    return found


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
    """One simulator; each of its worker processes opens a connection of its own."""

    def handle(self):
        scenes = {}  # a Scene, or the payload that it is made of at its first plan
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
                        plan = (
                            struct.pack("<2I", scene, len(states))
                            + states.astype("<f4").tobytes()
                        )
                        self.reply(TRAJECTORY, plan)
                    except Exception as error:  # ends this scene's rollout only
                        traceback.print_exc()
                        last = traceback.extract_tb(error.__traceback__)[-1]
                        why = f"{type(error).__name__}: {error} ({os.path.basename(last.filename)}, line {last.lineno})"
                        self.reply(
                            FAILED, struct.pack("<I", scene) + why.encode()[:1000]
                        )

    def reply(self, kind, payload):
        self.wfile.write(struct.pack("<II", kind, len(payload)) + payload)


class Unix(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    """Listens at a path."""


def maker(options):
    """A function that makes a planner, by the command line."""
    if options.config:
        from hydra.utils import (
            instantiate,
        )  # the devkit's, for its own configuration files
        from omegaconf import OmegaConf

        config = OmegaConf.load(options.config)
        if "_target_" not in config:  # nuPlan's files hold the planner under its name
            (config,) = config.values()
        return lambda: instantiate(config)
    module, _, name = options.planner.partition(":")
    kind = getattr(importlib.import_module(module), name)
    given = {}
    for argument in options.arguments:
        key, _, value = argument.partition("=")
        try:
            given[key] = ast.literal_eval(value)
        except (SyntaxError, ValueError):
            given[key] = value
    return lambda: kind(**given)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--planner", metavar="MODULE:CLASS")
    which.add_argument(
        "--config",
        metavar="PLANNER.yaml",
        help="names the class as _target_, and its arguments",
    )
    parser.add_argument(
        "arguments", nargs="*", metavar="NAME=VALUE", help="an argument of the class"
    )
    parser.add_argument(
        "address",
        metavar="ADDRESS",
        help="unix:PATH or HOST:PORT to listen at; e2rl adds it",
    )
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
