"""CommonRoad scenarios, format 2020a, by commonroad-io (extra `commonroad`;
docs/guide/export.md).

Obstacle 1 is the ego, obstacle n + 1 the agent of row n. An agent that comes back after
a gap is a further obstacle, since a CommonRoad trajectory has no gaps. Late agents have
a late initial state: commonroad-io and its tools read it, while the format's schema
admits only obstacles that are there from the start.
"""

import logging
import re
from collections.abc import Iterable, Iterator
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from commonroad.common.common_scenario import GeoTransformation, Location, ScenarioID
from commonroad.common.util import Interval
from commonroad.common.writer.file_writer_interface import OverwriteExistingFile
from commonroad.common.writer.file_writer_xml import XMLFileWriter
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.geometry.occupancy.rect_occupancy import RectOccupancy
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem, PlanningProblemSet
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.intersection import IncomingGroup, Intersection
from commonroad.scenario.lanelet import Lanelet, LaneletType
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario, Tag
from commonroad.scenario.state import CustomState, InitialState
from commonroad.scenario.traffic_light import (
    TrafficLight,
    TrafficLightCycle,
    TrafficLightCycleElement,
    TrafficLightDirection,
    TrafficLightState,
)
from commonroad.scenario.traffic_sign import (
    TrafficSign,
    TrafficSignElement,
    TrafficSignIDZamunda,
)
from commonroad.scenario.trajectory import Trajectory
from lxml import etree

from e2rl.report.export.episode import LONG, Episode
from e2rl.report.export.road_plan import RoadPlan, road_plan
from e2rl.scenes.paths import arc_length, shift_left, tangent_angle, wrap
from e2rl.scenes.recording import (
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    Lane,
)

logging.getLogger(XMLFileWriter.__module__).setLevel(
    logging.ERROR
)  # it warns of every successor that 2020a names so
TYPES = {
    "vehicle": "CAR",
    "pedestrian": "PEDESTRIAN",
    "cyclist": "BICYCLE",
    "other": "UNKNOWN",
}  # of ObstacleType
LIGHTS = {
    LIGHT_RED: "RED",
    LIGHT_YELLOW: "YELLOW",
    LIGHT_GREEN: "GREEN",
    LIGHT_UNKNOWN: "INACTIVE",
}
GOAL_LENGTH, GOAL_WIDTH = 10.0, 4.0  # m
STRAIGHT = 0.5  # rad that a lane may turn and still lead straight on
TURN = 60.0  # m at the beginning of a lane that say where it turns
MOST_CHARACTERS = 40  # of a map's name


def write(
    episodes: Iterable[Episode], folder: Path, open_ego: bool = False
) -> Iterator[tuple[Episode, Path]]:
    """Write ZAM_<place>-<n>_1_T-1.xml of each episode; open_ego: the ego is a planning
    problem only, no obstacle."""
    for number, episode in enumerate(episodes, 1):
        made, problems = scenario(episode, number, open_ego=open_ego)
        known = {
            "author": "",
            "affiliation": "",
            "source": "e2rl",
            "tags": {Tag.CRITICAL, Tag.SIMULATED},
        }
        writer = XMLFileWriter(made, problems, **known, decimal_precision=6)
        text = re.sub(
            "-(?=-)", "- ", f" {episode.text()} "
        )  # a comment must not hold two dashes in a row
        writer.root_node.append(etree.Comment(text))
        path = folder / f"{made.scenario_id}.xml"
        writer.write_to_file(str(path), OverwriteExistingFile.ALWAYS)
        yield episode, path


def scenario(episode: Episode, number: int, open_ego: bool) -> tuple[Any, Any]:
    """The Scenario, whose map is called `number`, and the PlanningProblemSet of an
    episode."""
    place = (
        re.sub(r"[^A-Za-z0-9]", "", episode.rollout.location)[:MOST_CHARACTERS]
        or "E2rl"
    )
    name = ScenarioID(
        map_name=place,
        map_id=number,
        configuration_id=1,
        obstacle_behavior="T",
        prediction_id=1,
    )
    made = Scenario(episode.rollout.dt, name)
    ids = count(len(episode.rollout.size) + 1)
    made.add_objects(lanelets(episode, ids))
    plan = road_plan(episode.lanes)
    made.add_objects(speed_limits(episode, made, ids=ids))
    made.add_objects(traffic_lights(episode, plan, made=made, ids=ids))
    made.add_objects(intersections(episode, plan, made=made, ids=ids))
    made.add_objects(obstacles(episode, ids, open_ego=open_ego))
    if episode.origin is not None:
        shift = episode.origin.tolist()
        made.lanelet_network.location = Location(
            geo_transformation=GeoTransformation("", *shift, 0.0, 1.0)
        )
    return made, PlanningProblemSet([planning_problem(episode, next(ids))])


# --- map


def lanelets(episode: Episode, ids: Iterator[int]) -> list:
    """A lanelet for each lane, half its width to both sides of the centreline."""
    number = {name: next(ids) for name in episode.lanes}
    entries = episode.entries()
    made = []
    for name, lane in episode.lanes.items():
        left = beside(episode.lanes, name, side="left", other_side="right")
        right = beside(episode.lanes, name, side="right", other_side="left")
        made.append(
            Lanelet(
                left_vertices=shift_left(lane.points, lane.width / 2),
                center_vertices=lane.points,
                right_vertices=shift_left(lane.points, -lane.width / 2),
                lanelet_id=number[name],
                predecessor=[number[other] for other in entries[name]],
                successor=[number[other] for other in lane.exits],
                adjacent_left=number[left] if left else None,
                adjacent_left_same_direction=True if left else None,
                adjacent_right=number[right] if right else None,
                adjacent_right_same_direction=True if right else None,
                lanelet_type={LaneletType.UNKNOWN},
            )
        )
    return made


def beside(lanes: dict[str, Lane], name: str, side: str, other_side: str) -> str | None:
    """Returns the lane on a side, if this one is the first on the other side of it:
    tools follow both ways."""
    other = next(iter(getattr(lanes[name], side)), None)
    mutual = (
        other is not None
        and next(iter(getattr(lanes[other], other_side)), None) == name
    )
    return other if mutual else None


def speed_limits(episode: Episode, made: Any, ids: Iterator[int]) -> list:
    """A virtual sign for each speed limit; lanelets refer to theirs."""
    signs = {}
    for lane, lanelet in zip(
        episode.lanes.values(), made.lanelet_network.lanelets, strict=True
    ):
        if lane.speed_limit <= 0:
            continue
        if lane.speed_limit not in signs:
            element = TrafficSignElement(
                TrafficSignIDZamunda.MAX_SPEED, [f"{lane.speed_limit:.6g}"]
            )
            first = {lanelet.lanelet_id}, lane.points[0]
            signs[lane.speed_limit] = TrafficSign(
                next(ids), [element], *first, virtual=True
            )
        lanelet.add_traffic_sign_to_lanelet(signs[lane.speed_limit].traffic_sign_id)
    return list(signs.values())


def traffic_lights(
    episode: Episode, plan: RoadPlan, made: Any, ids: Iterator[int]
) -> list:
    """A light at the end of each lanelet before one with a light; where it leads to
    several, one for each direction."""
    number = dict(zip(episode.lanes, made.lanelet_network.lanelets, strict=True))
    found = []
    for name, lane in episode.lanes.items():
        groups: dict[
            tuple[int, ...], list[str]
        ] = {}  # lanes ahead by the states of their light
        for other in lane.exits:
            if other in episode.lights:
                groups.setdefault(tuple(episode.lights[other].tolist()), []).append(
                    other
                )
        for states, others in groups.items():
            turns = (
                {"ALL"}
                if len(others) == len(lane.exits)
                else {turn(episode, plan, name=other) for other in others}
            )
            for direction in map(TrafficLightDirection.__getitem__, sorted(turns)):
                light = TrafficLight(
                    next(ids), lane.points[-1], cycle(states), direction=direction
                )
                number[name].add_traffic_light_to_lanelet(light.traffic_light_id)
                found.append(light)
    return found


def cycle(states: Iterable[int]) -> Any:
    """Light states, one a time step, as a cycle."""
    runs = [
        (TrafficLightState[LIGHTS[state]], len(list(group)))
        for state, group in groupby(states)
    ]
    return TrafficLightCycle(
        [TrafficLightCycleElement(state, length) for state, length in runs]
    )


def turn(episode: Episode, plan: RoadPlan, name: str) -> str:
    """Returns the direction in which a lane, or the connecting road that it begins,
    leads: LEFT, STRAIGHT or RIGHT."""
    names = (
        [span.lane for span in plan.roads.get(name, ())]
        if name in plan.connecting
        else [name]
    )
    last = episode.lanes[names[-1]].points
    near = arc_length(last) <= TURN
    begin = tangent_angle(episode.lanes[name].points)[0]
    turned = float(wrap(tangent_angle(last)[near][-1] - begin))
    return "STRAIGHT" if abs(turned) < STRAIGHT else "LEFT" if turned > 0 else "RIGHT"


def intersections(
    episode: Episode, plan: RoadPlan, made: Any, ids: Iterator[int]
) -> list:
    """Returns an intersection for each junction with a light, or where a lane of one of
    several roads forks.

    commonroad-sumo takes a light before a fork only where an intersection says which
    way each lanelet leads.
    """
    number = dict(
        zip(
            episode.lanes,
            (lanelet.lanelet_id for lanelet in made.lanelet_network.lanelets),
            strict=True,
        )
    )
    crossings = []
    for junction in plan.junctions:
        entering = list(dict.fromkeys(plan.connecting[road][0] for road in junction))
        groups = side_by_side(episode.lanes, entering)
        exits = {name: episode.lanes[name].exits for name in entering}
        lit = any(
            other in episode.lights for others in exits.values() for other in others
        )
        forks = any(len(others) > 1 for others in exits.values())
        if not lit and (len(groups) < 2 or not forks):
            continue
        incomings = []
        for group in groups:
            ways: dict[str, set[int]] = {
                "LEFT": set(),
                "STRAIGHT": set(),
                "RIGHT": set(),
            }
            for other in (other for name in group for other in exits[name]):
                ways[turn(episode, plan, name=other)].add(number[other])
            incoming = IncomingGroup(
                next(ids),
                incoming_lanelets={number[name] for name in group},
                outgoing_right=ways["RIGHT"],
                outgoing_straight=ways["STRAIGHT"],
                outgoing_left=ways["LEFT"],
            )
            incomings.append(incoming)
        crossings.append(Intersection(next(ids), incomings))
    return crossings


def side_by_side(lanes: dict[str, Lane], names: list[str]) -> list[list[str]]:
    """Returns the lanes `names` in groups of neighbours."""
    groups: list[list[str]] = []
    for name in names:
        near = {
            beside(lanes, name, side="left", other_side="right"),
            beside(lanes, name, side="right", other_side="left"),
        }
        touching = [group for group in groups if near & set(group)]
        groups = [group for group in groups if group not in touching]
        groups.append([other for group in touching for other in group] + [name])
    return groups


# --- agents


def obstacles(episode: Episode, ids: Iterator[int], open_ego: bool) -> list:
    """A dynamic obstacle for each appearance of an agent of at least two steps, which
    is the least of the format."""
    made = []
    for row in episode.agents[1:] if open_ego else episode.agents:
        kind, (length, width) = str(episode.rollout.agent_type[row]), episode.size(row)
        name = "TRUCK" if kind == "vehicle" and length > LONG else TYPES[kind]
        shape = RectObstacleShape(width=width, length=length)
        spans = [span for span in episode.appearances(row) if span[1] - span[0] >= 2]
        for index, (first, end) in enumerate(spans):
            begin, *states = [
                state(episode, step, row=row) for step in range(first, end)
            ]
            prediction = TrajectoryPrediction(Trajectory(first + 1, states), shape)
            number = row + 1 if index == 0 else next(ids)
            made.append(
                DynamicObstacle(number, ObstacleType[name], shape, begin, prediction)
            )
    return made


def state(episode: Episode, step: int, row: int, **more: float) -> Any:
    """An agent's state at a step: the middle of its box, heading and speed."""
    x, y, heading, speed = episode.rollout.states[step, row].astype(float).tolist()
    position = np.array([x, y])
    turned = float(wrap(heading))
    return InitialState(
        time_step=step, position=position, orientation=turned, velocity=speed, **more
    )


def planning_problem(episode: Episode, number: int) -> Any:
    """From the ego's start to where its recording ends, at any time; the route between
    is the planner's."""
    last = int(np.flatnonzero(episode.rollout.logged_valid[:, 0])[-1])
    x, y, heading, _ = episode.rollout.logged[last, 0].astype(float).tolist()
    there = RectOccupancy(
        shapely.Point(x, y), GOAL_WIDTH, GOAL_LENGTH, float(wrap(heading))
    )
    goal = CustomState(time_step=Interval(1, max(episode.steps, 1)), position=there)
    turning = (
        0.0 if episode.scene is None else float(episode.scene["start_yaw_rate"][0])
    )
    begin = state(episode, 0, row=0, yaw_rate=turning, slip_angle=0.0)
    return PlanningProblem(number, begin, GoalRegion([goal]))
