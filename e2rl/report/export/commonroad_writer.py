"""CommonRoad scenarios, format 2020a, by commonroad-io (extra `commonroad`;
docs/guide/export.md).

Obstacle 1 is the ego, obstacle n + 1 the agent of row n. An agent that comes back after
a gap is a further obstacle, since a CommonRoad trajectory has no gaps. Late agents have
a late initial state: commonroad-io and its tools read it, while the format's schema
admits only obstacles that are there from the start.
"""

import logging
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, count, groupby
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

from e2rl.report.export.episode import Episode
from e2rl.report.export.road_plan import RoadPlan, road_plan
from e2rl.scenes.paths import arc_length, shift_left, tangent_angle, wrap
from e2rl.scenes.recording import (
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    Lane,
)

# It warns of every successor that 2020a names so.
logging.getLogger(XMLFileWriter.__module__).setLevel(logging.ERROR)
TYPES = {  # of ObstacleType
    "vehicle": "CAR",
    "truck": "TRUCK",
    "pedestrian": "PEDESTRIAN",
    "cyclist": "BICYCLE",
    "other": "UNKNOWN",
}
LIGHTS = {
    LIGHT_RED: "RED",
    LIGHT_YELLOW: "YELLOW",
    LIGHT_GREEN: "GREEN",
    LIGHT_UNKNOWN: "INACTIVE",
}
GOAL_LENGTH = 10.0  # m
GOAL_WIDTH = 4.0  # m
STRAIGHT = 0.5  # rad that a lane may turn and still lead straight on
TURN = 60.0  # m at the beginning of a lane that say where it turns
MOST_CHARACTERS = 40  # of a map's name
OPPOSITE = {"left": "right", "right": "left"}
Ids = Iterator[int]


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write ZAM_<place>-<n>_1_T-1.xml of each episode; open_ego: the ego is a planning
    problem only, no obstacle."""
    for number, episode in enumerate(episodes, 1):
        scenario, problems = converted(episode, number, open_ego=open_ego)
        writer = XMLFileWriter(
            scenario,
            problems,
            author="",
            affiliation="",
            source="e2rl",
            tags={Tag.CRITICAL, Tag.SIMULATED},
            decimal_precision=6,
        )
        # A comment must not hold two dashes in a row.
        text = re.sub("-(?=-)", "- ", f" {episode.text()} ")
        writer.root_node.append(etree.Comment(text))
        path = folder / f"{scenario.scenario_id}.xml"
        writer.write_to_file(str(path), OverwriteExistingFile.ALWAYS)
        yield episode, path


def converted(episode: Episode, number: int, open_ego: bool) -> tuple[Any, Any]:
    """The Scenario, whose map is called `number`, and the PlanningProblemSet of an
    episode."""
    rollout = episode.rollout
    place = re.sub(r"[^A-Za-z0-9]", "", rollout.location)[:MOST_CHARACTERS]
    name = ScenarioID(
        map_name=place or "E2rl",
        map_id=number,
        configuration_id=1,
        obstacle_behavior="T",
        prediction_id=1,
    )
    scenario = Scenario(rollout.dt, name)
    ids = count(len(rollout.size) + 1)
    lanelets = lanelets_of(episode, ids)
    scenario.add_objects(list(lanelets.values()))
    scenario.add_objects(speed_limits(episode, lanelets, ids))
    signals = Signals(episode, road_plan(episode.lanes), lanelets, ids)
    scenario.add_objects(signals.traffic_lights())
    scenario.add_objects(signals.intersections())
    scenario.add_objects(obstacles(episode, ids, open_ego=open_ego))
    if episode.origin is not None:
        east, north = episode.origin.tolist()
        shift = GeoTransformation("", east, north, z_rotation=0.0, scaling=1.0)
        scenario.lanelet_network.location = Location(geo_transformation=shift)
    return scenario, PlanningProblemSet([planning_problem(episode, next(ids))])


# --- map


def lanelets_of(episode: Episode, ids: Ids) -> dict[str, Any]:
    """A lanelet for each lane, half its width to both sides of the centreline."""
    number = {name: next(ids) for name in episode.lanes}
    entries = episode.entries()
    lanelets = {}
    for name, lane in episode.lanes.items():
        left = beside(episode.lanes, name, side="left")
        right = beside(episode.lanes, name, side="right")
        lanelets[name] = Lanelet(
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
    return lanelets


def beside(lanes: dict[str, Lane], name: str, side: str) -> str | None:
    """The lane on a side, if this one is the first on the other side of it: tools
    follow both ways."""
    for other in getattr(lanes[name], side)[:1]:
        if name in getattr(lanes[other], OPPOSITE[side])[:1]:
            return other
    return None


def side_by_side(lanes: dict[str, Lane], names: Iterable[str]) -> list[list[str]]:
    """The lanes `names` in groups of neighbours."""
    groups: list[list[str]] = []
    for name in names:
        near = {beside(lanes, name, side=side) for side in OPPOSITE}
        touching = [group for group in groups if near & set(group)]
        groups = [group for group in groups if group not in touching]
        groups.append([*chain.from_iterable(touching), name])
    return groups


def speed_limits(episode: Episode, lanelets: dict[str, Any], ids: Ids) -> list:
    """A virtual sign for each speed limit; lanelets refer to theirs."""
    signs = {}
    for name, lane in episode.lanes.items():
        limit = lane.speed_limit
        if limit <= 0:
            continue
        if limit not in signs:
            element = TrafficSignElement(
                TrafficSignIDZamunda.MAX_SPEED, [f"{limit:.6g}"]
            )
            signs[limit] = TrafficSign(
                next(ids),
                [element],
                first_occurrence={lanelets[name].lanelet_id},
                position=lane.points[0],
                virtual=True,
            )
        lanelets[name].add_traffic_sign_to_lanelet(signs[limit].traffic_sign_id)
    return list(signs.values())


@dataclass(frozen=True)
class Signals:
    """Lights and intersections of an episode on its lanelets."""

    episode: Episode
    plan: RoadPlan
    lanelets: dict[str, Any]
    ids: Ids

    def traffic_lights(self) -> list:
        """A light at the end of each lanelet before one with a light; where it leads to
        several, one for each direction."""
        lights = []
        for name, lane in self.episode.lanes.items():
            by_states: dict[tuple[int, ...], list[str]] = {}  # lanes ahead
            for other in lane.exits:
                if other in self.episode.lights:
                    states = tuple(self.episode.lights[other].tolist())
                    by_states.setdefault(states, []).append(other)
            for states, others in by_states.items():
                turns = {"ALL"}
                if len(others) < len(lane.exits):
                    turns = set(map(self.turn, others))
                for direction in sorted(turns):
                    light = TrafficLight(
                        next(self.ids),
                        lane.points[-1],
                        cycle(states),
                        direction=TrafficLightDirection[direction],
                    )
                    lanelet = self.lanelets[name]
                    lanelet.add_traffic_light_to_lanelet(light.traffic_light_id)
                    lights.append(light)
        return lights

    def turn(self, name: str) -> str:
        """The direction in which a lane, or the connecting road that it begins, leads:
        LEFT, STRAIGHT or RIGHT."""
        lanes = self.episode.lanes
        last = name
        if name in self.plan.connecting:
            last = self.plan.roads[name][-1].lane
        points = lanes[last].points
        near = arc_length(points) <= TURN
        begin = tangent_angle(lanes[name].points)[0]
        turned = float(wrap(tangent_angle(points)[near][-1] - begin))
        if abs(turned) < STRAIGHT:
            return "STRAIGHT"
        return "LEFT" if turned > 0 else "RIGHT"

    def intersections(self) -> list:
        """An intersection for each junction with a light, or where a lane of one of
        several roads forks.

        commonroad-sumo takes a light before a fork only where an intersection says
        which way each lanelet leads.
        """
        lanes = self.episode.lanes
        crossings = []
        for junction in self.plan.junctions:
            entering = dict.fromkeys(self.plan.connecting[road][0] for road in junction)
            groups = side_by_side(lanes, entering)
            exits = [lanes[name].exits for name in entering]
            lit = any(
                other in self.episode.lights for other in chain.from_iterable(exits)
            )
            forks = any(len(others) > 1 for others in exits)
            if not lit and (len(groups) < 2 or not forks):
                continue
            incomings = []
            for group in groups:
                turns: dict[str, set[int]] = defaultdict(set)
                for other in chain(*(lanes[name].exits for name in group)):
                    turns[self.turn(other)].add(self.lanelets[other].lanelet_id)
                incoming = IncomingGroup(
                    next(self.ids),
                    incoming_lanelets={
                        self.lanelets[name].lanelet_id for name in group
                    },
                    outgoing_right=turns["RIGHT"],
                    outgoing_straight=turns["STRAIGHT"],
                    outgoing_left=turns["LEFT"],
                )
                incomings.append(incoming)
            crossings.append(Intersection(next(self.ids), incomings))
        return crossings


def cycle(states: Iterable[int]) -> Any:
    """Light states, one a time step, as a cycle."""
    return TrafficLightCycle(
        [
            TrafficLightCycleElement(TrafficLightState[LIGHTS[state]], len(list(run)))
            for state, run in groupby(states)
        ]
    )


# --- agents


def obstacles(episode: Episode, ids: Ids, open_ego: bool) -> list:
    """A dynamic obstacle for each appearance of an agent of at least two steps, which
    is the least of the format."""
    obstacles = []
    for row in episode.agents[1:] if open_ego else episode.agents:
        length, width = episode.size(row)
        kind = ObstacleType[TYPES[episode.kind(row)]]
        shape = RectObstacleShape(width=width, length=length)
        numbers = chain([row + 1], ids)
        for first, end in episode.appearances(row):
            if end - first < 2:
                continue
            begin, *states = [
                state(episode, step, row=row) for step in range(first, end)
            ]
            path = TrajectoryPrediction(Trajectory(first + 1, states), shape)
            obstacle = DynamicObstacle(next(numbers), kind, shape, begin, path)
            obstacles.append(obstacle)
    return obstacles


def state(episode: Episode, step: int, row: int, **motion: float) -> Any:
    """An agent's state at a step: the middle of its box, heading and speed."""
    x, y, heading, speed = episode.rollout.states[step, row].astype(float).tolist()
    return InitialState(
        time_step=step,
        position=np.array([x, y]),
        orientation=float(wrap(heading)),
        velocity=speed,
        **motion,
    )


def planning_problem(episode: Episode, number: int) -> Any:
    """From the ego's start to where its recording ends, at any time; the route between
    is the planner's."""
    rollout = episode.rollout
    last = int(np.flatnonzero(rollout.logged_valid[:, 0])[-1])
    x, y, heading, _ = rollout.logged[last, 0].astype(float).tolist()
    place = RectOccupancy(
        shapely.Point(x, y),
        GOAL_WIDTH,
        GOAL_LENGTH,
        float(wrap(heading)),
    )
    goal = CustomState(time_step=Interval(1, max(episode.steps, 1)), position=place)
    motion = {"yaw_rate": 0.0, "acceleration": 0.0}
    if episode.scene is not None:
        motion = {
            "yaw_rate": float(episode.scene["start_yaw_rate"][0]),
            "acceleration": float(episode.scene["start_accel"][0]),
        }
    # readers take the yaw rate for 0 where no acceleration is given
    begin = state(episode, 0, row=0, slip_angle=0.0, **motion)
    return PlanningProblem(number, begin, GoalRegion([goal]))
