"""Source of CommonRoad scenarios: XML files of format 2018b and 2020a, read by
commonroad-io (extra `commonroad`).

The ego is the obstacle that stands where a planning problem starts. Most scenarios have
none there, since their authors took the vehicle out to plan for it: then the ego is the
vehicle, recorded at the start frame, that moves for the most frames, of several the one
that drives farthest. Of a long scenario, which makes several scenes, each has an ego of
its own, which is chosen by its simulated steps.
"""

import io
from collections.abc import (
    Iterator,
    Sequence,
)
from dataclasses import dataclass
from math import (
    inf,
    isfinite,
)
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy import ndarray

from e2rl.run.errors import InputError
from e2rl.scenes.egos import with_egos
from e2rl.scenes.log_files import (
    LogFiles,
    bounded_memory,
    xml_parser,
)
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    CYCLIST,
    DT,
    HISTORY,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
    light_colour,
)
from e2rl.scenes.resampling import (
    FRAME_STEPS,
    latest_frames,
    resample_uniform,
)

KINDS = {  # ObstacleTypes; others are OTHER
    VEHICLE: "car truck bus motorcycle taxi vehicle priorityVehicle parkedVehicle",
    CYCLIST: "bicycle",
    PEDESTRIAN: "pedestrian",
}
TYPES = {name: kind for kind, names in KINDS.items() for name in names.split()}
# LaneletTypes on which a car does not drive; on the first two it could
PAVED = {"shoulder", "busLane"}
UNPAVED = (
    "sidewalk crosswalk bicycleLane busStop border parking restricted restricted_area"
)
FOR_OTHERS = PAVED.union(UNPAVED.split())
CARS = {"vehicle", "car"}  # RoadUsers
NEAR = 1.0  # m from a planning problem's start to the vehicle that is its ego
ELEMENTS = "x y z exact intervalStart intervalEnd length width radius orientation"
NUMBERS = frozenset(ELEMENTS.split())  # elements that hold one
MAX_DEPTH = 32  # elements
LARGEST_ANGLE = 1000.0  # rad
STEPS = 80  # simulated steps of a scene, by default


@dataclass
class CommonRoadSource(LogFiles):
    """The CommonRoad scenarios (*.xml) in a folder or zip.

    A scenario that leaves less than half of the simulated steps after its start frame,
    the tenth, makes no scene.
    """

    holds = "CommonRoad scenarios"
    ending = ".xml"
    mend = "export it again or leave it out"
    extra = "commonroad"

    def read(self, log: str) -> Iterator[Recording]:
        steps = self.build.steps
        with bounded_memory():
            recording = read_scenario(self.content(log), self.starts, steps=steps)
        first = min(self.starts or (HISTORY,))
        if len(recording.states) - steps // 2 >= first:
            yield recording


def read_scenario(
    content: bytes,
    starts: Sequence[int] | None = None,
    steps: int = STEPS,
) -> Recording:
    """Returns the recording in an XML file at 10 Hz, with an ego for each window that
    has a vehicle at its start.

    Args:
        content: of the file.
        starts: start frames of the windows; None: those of `Recording.windows`.
        steps: simulated steps of a scene.
    """
    # beside commonroad-io's reader of protobuf, which needs a protobuf of its own
    from commonroad.common.reader.file_reader_xml import XMLFileReader

    _check_content(content)
    scenario, problems = XMLFileReader(io.BytesIO(content)).open()
    recording, started = _recording(
        scenario, list(problems.planning_problem_dict.values())
    )
    return with_egos(recording, starts, steps=steps, started=started)


def _check_content(content: bytes) -> None:
    """Raise InputError for a document type, for deep nesting, and for numbers that are
    infinite, NaN, or no angles, with which commonroad-io would not end."""
    opened: list[str] = []

    def begin(name: str, _: object) -> None:
        opened.append(name)
        if len(opened) > MAX_DEPTH:
            raise InputError(f"nests deeper than {MAX_DEPTH} elements; export it again")

    def text(value: str) -> None:
        if opened[-1] in NUMBERS and value.strip():
            most = LARGEST_ANGLE if "orientation" in opened[-2:] else inf
            number = float(value)
            if not (isfinite(number) and abs(number) <= most):
                raise InputError(
                    f"{'/'.join(opened[-3:])} is {value.strip()[:40]}; repair it"
                )

    parser = xml_parser()
    parser.buffer_text = True  # a text comes whole
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: opened.pop()
    parser.CharacterDataHandler = text
    parser.Parse(content, True)


def _recording(scenario: Any, problems: list) -> tuple[Recording, list[int]]:
    """Returns the recording, still without an ego, and the tracks that begin where a
    planning problem does."""
    low, high = FRAME_STEPS
    if not low <= scenario.dt <= high:
        raise InputError(
            f"timeStepSize={scenario.dt:g}: expected {low:g} to {high:g} s; repair it"
        )
    obstacles = [*scenario.dynamic_obstacles, *scenario.static_obstacles]
    tracks = [_states(obstacle) for obstacle in scenario.dynamic_obstacles]
    if not tracks:
        raise InputError("no dynamic obstacle; leave it out")
    steps = [state.time_step for track in tracks for state in track]
    first = min(steps)
    shape = (max(steps) - first + 1, len(obstacles))
    name = str(scenario.scenario_id)
    check({"states": shape[0] * max(scenario.dt / DT, 1) * shape[1]}, name)
    states = np.zeros((*shape, 4))
    valid = np.zeros(shape, bool)
    size = np.zeros((len(obstacles), 2))
    for index, obstacle in enumerate(obstacles):
        size[index], middle = _box(obstacle.obstacle_shape)
        if index < len(tracks):
            for state in tracks[index]:
                states[state.time_step - first, index] = _state(state, middle)
                valid[state.time_step - first, index] = True
        else:
            states[:, index] = _state(obstacle.initial_state, middle)
            valid[:, index] = True
    kinds = [obstacle.obstacle_type.value for obstacle in obstacles]
    started = []
    for problem in problems:
        start = problem.initial_state
        frame = start.time_step - first
        if 0 <= frame < len(states):
            offset = states[frame, :, :2] - start.position[:2]
            distance = np.where(valid[frame], np.linalg.norm(offset, axis=-1), np.inf)
            if distance.min() < NEAR:
                started.append(int(distance.argmin()))
    seconds = np.arange(shape[0]) * scenario.dt
    states, valid, _ = resample_uniform(states, valid, seconds)
    lanes, drivable = _map(scenario.lanelet_network)
    steps_of_grid = first + latest_frames(seconds, len(states))
    recording = Recording(
        scene_id=name,
        location=f"{scenario.scenario_id.country_id}_{scenario.scenario_id.map_name}",
        dataset="commonroad",
        states=states,
        valid=valid,
        size=size,
        agent_type=np.array([TYPES.get(kind, OTHER) for kind in kinds]),
        ego=-1,
        lanes=lanes,
        drivable=drivable,
        lights=_lights(scenario.lanelet_network, lanes, steps=steps_of_grid),
        current=None,
    )
    return recording, started


def _states(obstacle: Any) -> list:
    """The states of a dynamic obstacle in order; raises InputError where its motion is
    no trajectory."""
    trajectory = getattr(obstacle.prediction, "trajectory", None)
    if obstacle.prediction is not None and trajectory is None:
        raise InputError(
            f"obstacle {obstacle.obstacle_id} has occupancy sets, no trajectory; "
            "leave it out"
        )
    return [obstacle.initial_state, *(trajectory.state_list if trajectory else ())]


def _state(state: Any, middle: ndarray) -> list[float]:
    """x, y of the box's middle, heading and speed; raises InputError where they are
    intervals. middle [2] m: of the box, from the state's origin."""
    if state.is_uncertain_position or state.is_uncertain_orientation:
        raise InputError(
            f"a state at time step {state.time_step} is uncertain; "
            "give exact positions and orientations"
        )
    cos = np.cos(state.orientation)
    sin = np.sin(state.orientation)
    x, y = state.position[:2] + np.array([[cos, -sin], [sin, cos]]) @ middle
    # velocity_y is a second component in some kinds of state, and derived in others
    parts = vars(state)
    along = parts.get("velocity") or 0.0
    speed = np.copysign(np.hypot(along, parts.get("velocity_y") or 0.0), along)
    return [x, y, state.orientation, float(speed)]


def _box(shape: Any) -> tuple[ndarray, ndarray]:
    """Length and width [2] of the box around a shape, and its middle [2] seen from the
    shape's origin."""
    pose = SimpleNamespace(
        position=np.zeros(2),
        orientation=0.0,
        hitch=0.0,
    )
    bounds = np.array(shape.compute_occupancy_for_state(pose).shapely_object.bounds)
    return bounds[2:] - bounds[:2], (bounds[:2] + bounds[2:]) / 2


def _map(network: Any) -> tuple[dict[str, Lane], list[ndarray]]:
    """Lanes for cars by lanelet id, and the polygons of what they could drive on."""
    lanes = {}
    drivable = []
    for lanelet in network.lanelets:
        kinds = FOR_OTHERS & {kind.value for kind in lanelet.lanelet_type or ()}
        users = [*(lanelet.user_one_way or ()), *(lanelet.user_bidirectional or ())]
        left = lanelet.left_vertices[:, :2]
        right = lanelet.right_vertices[:, :2]
        if kinds <= PAVED:
            drivable.append(np.concatenate([left, right[::-1]]))
        if kinds or (users and CARS.isdisjoint(user.value for user in users)):
            continue
        lanes[str(lanelet.lanelet_id)] = Lane(
            points=lanelet.center_vertices[:, :2],
            width=float(np.median(np.linalg.norm(left - right, axis=1))),
            speed_limit=_speed_limit(network, lanelet),
            exits=[str(other) for other in lanelet.successor],
            left=[str(lanelet.adj_left)] if lanelet.adj_left_same_direction else [],
            right=[str(lanelet.adj_right)] if lanelet.adj_right_same_direction else [],
        )
    return lanes, drivable


def _speed_limit(network: Any, lanelet: Any) -> float:
    """The lowest limit [m/s] of a lanelet's traffic signs, 0 for none."""
    limits = []
    for sign_id in lanelet.traffic_signs or ():
        sign = network.find_traffic_sign_by_id(sign_id)
        for element in sign.traffic_sign_elements if sign is not None else ():
            values = element.additional_values
            if element.traffic_sign_element_id.name == "MAX_SPEED" and values:
                limits.append(float(values[0]))
    return min(limits, default=0.0)


def _lights(
    network: Any,
    lanes: dict[str, Lane],
    steps: ndarray,
) -> dict[str, ndarray]:
    """Light states [F] at time steps [F], by the lanes that the light lets in: the
    successors of the lanelet at whose end it stands. A lanelet with several lights is
    left out, since each may be for another direction."""
    lights: dict[str, ndarray] = {}
    for lanelet in network.lanelets:
        if len(lanelet.traffic_lights) != 1:
            continue
        light = network.find_traffic_light_by_id(*lanelet.traffic_lights)
        if light is None or not light.active or light.traffic_light_cycle is None:
            continue
        colours = [light.get_state_at_time_step(int(step)).value for step in steps]
        states = np.array([light_colour(colour) for colour in colours], np.int8)
        lights |= {
            lane: states for lane in map(str, lanelet.successor) if lane in lanes
        }
    return lights
