"""ASAM OpenSCENARIO XML 1.2 with its road in OpenDRIVE, by scenariogeneration (extra
`openscenario`; docs/guide/export.md).

Every agent follows a polyline with a time at every vertex (FollowTrajectoryAction,
following mode `position`). A vertex is the place of an entity's reference point, which
for vehicles is the middle of the rear axle; BoundingBox.Center says where the box lies
from there.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scenariogeneration import xosc

from e2rl.report.export.episode import Episode
from e2rl.report.export.opendrive import write_roads
from e2rl.scenes.paths import WHEELBASE

MINOR_VERSION = 2
TRACK = 0.8  # of the width, between the wheels
WHEEL = 0.6  # m, diameter
STEERING = 0.6  # rad, of the front axle
SPEED = 70.0  # m/s, highest; trajectories ask neither for it nor for the next two
ACCELERATION = 5.0  # m/s^2
BRAKING = 8.0  # m/s^2


class Kind(NamedTuple):
    """What a rollout does not hold of an agent; `drives`: it has axles."""

    name: str
    mass: float  # kg
    drives: bool


KINDS = {
    "vehicle": Kind("car", mass=1500.0, drives=True),
    "truck": Kind("truck", mass=10000.0, drives=True),
    "cyclist": Kind("bicycle", mass=90.0, drives=True),
    "pedestrian": Kind("pedestrian", mass=75.0, drives=False),
    "other": Kind("other", mass=100.0, drives=False),
}


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.xosc, and NAME.xodr where there are lanes; open_ego: the ego has a
    start, no trajectory."""
    for episode in episodes:
        path = folder / f"{episode.path.stem}.xosc"
        road = None
        if episode.lanes:
            write_roads(episode, path.with_suffix(".xodr"))
            road = path.with_suffix(".xodr").name
        scenario(episode, road, open_ego=open_ego).write_xml(str(path))
        yield episode, path


def scenario(episode: Episode, road: str | None, open_ego: bool) -> Any:
    """The xosc.Scenario of an episode on the roads in the file `road`."""
    rollout = episode.rollout
    entities = xosc.Entities()
    init = xosc.Init()
    act = xosc.Act("replay", at(0.0, "replay begins"))
    at_once = xosc.TransitionDynamics(
        xosc.DynamicsShapes.step,
        xosc.DynamicsDimension.time,
        0,
    )
    for row in episode.agents:
        name = episode.name(row)
        entities.add_scenario_object(name, entity(episode, row))
        if rollout.valid[0, row]:
            (start,) = places(episode, row, 0, 1)
            speed = float(rollout.states[0, row, 3])
            init.add_init_action(name, xosc.TeleportAction(start))
            init.add_init_action(name, xosc.AbsoluteSpeedAction(speed, at_once))
        events = [] if row == 0 and open_ego else events_of(episode, row)
        if events:
            manoeuvre = xosc.Maneuver(f"{name} drives")
            for event in events:
                manoeuvre.add_event(event)
            group = xosc.ManeuverGroup(name).add_actor(name).add_maneuver(manoeuvre)
            act.add_maneuver_group(group)
    end = at(episode.steps * rollout.dt, "replay ends", point="stop")
    board = xosc.StoryBoard(init, end)
    board.add_story(xosc.Story("rollout").add_act(act))
    facts = xosc.Properties()
    for key, value in episode.facts.items():
        facts.add_property(key, str(value))
    return xosc.Scenario(
        episode.text(),
        "e2rl",
        parameters=xosc.ParameterDeclarations(),
        entities=entities,
        storyboard=board,
        roadnetwork=xosc.RoadNetwork(roadfile=road),
        catalog=xosc.Catalog(),
        osc_minor_version=MINOR_VERSION,
        header_properties=facts,
    )


def rear_axle(episode: Episode, row: int) -> float:
    """How far [m] the reference point of an agent lies behind the middle of its box."""
    if not KINDS[episode.kind(row)].drives:
        return 0.0
    return WHEELBASE / 2 * episode.size(row)[0]


def entity(episode: Episode, row: int) -> Any:
    """The Vehicle, Pedestrian or MiscObject of an agent."""
    rollout = episode.rollout
    kind = KINDS[episode.kind(row)]
    length, width = episode.size(row)
    back = rear_axle(episode, row)
    name = f"{episode.name(row)} {kind.name}"
    height = episode.height(row)
    box = xosc.BoundingBox(width, length, height, back, 0.0, z_center=height / 2)
    entity: Any
    if kind.drives:
        front = xosc.Axle(STEERING, WHEEL, TRACK * width, 2 * back, WHEEL / 2)
        rear = xosc.Axle(0.0, WHEEL, TRACK * width, 0.0, WHEEL / 2)
        entity = xosc.Vehicle(
            name,
            xosc.VehicleCategory[kind.name],
            boundingbox=box,
            frontaxle=front,
            rearaxle=rear,
            max_speed=SPEED,
            max_acceleration=ACCELERATION,
            max_deceleration=BRAKING,
            mass=kind.mass,
        )
    elif kind.name == "pedestrian":
        category = xosc.PedestrianCategory.pedestrian
        entity = xosc.Pedestrian(name, kind.mass, category, box)
    else:
        category = xosc.MiscObjectCategory.obstacle
        entity = xosc.MiscObject(name, kind.mass, category, box)
    role = "adversary" if rollout.adversaries[row] else "simulated"
    if row == 0:
        role = "ego"
    elif not rollout.simulated[row]:
        role = "replayed"
    entity.add_property("role", role)
    entity.add_property("row", str(row))
    return entity


def events_of(episode: Episode, row: int) -> list:
    """The events of an agent: it appears and follows its polyline, and it vanishes, as
    often as the rollout has it."""
    name = episode.name(row)
    dt = episode.rollout.dt
    events = []
    for first, end in episode.appearances(row):
        begin = f"{round(first * dt, 6):g} s"
        gone = f"{round(end * dt, 6):g} s"
        path = places(episode, row, first, end)
        drives = xosc.Event(f"{name} from {begin}", xosc.Priority.parallel)
        if first > 0:
            appears = xosc.AddEntityAction(name, path[0])
            drives.add_action(f"{name} appears at {begin}", appears)
        if len(path) > 1:  # a polyline needs two vertices
            times = np.round(np.arange(first, end) * dt, 6).tolist()
            trajectory = xosc.Trajectory(f"{name} from {begin}", False)
            follow = xosc.FollowTrajectoryAction(
                trajectory.add_shape(xosc.Polyline(times, path)),
                xosc.FollowingMode.position,
                reference_domain=xosc.ReferenceContext.absolute,
                scale=1,
                offset=0,
            )
            drives.add_action(f"{name} drives from {begin}", follow)
        if first > 0 or len(path) > 1:
            events.append(drives.add_trigger(at(round(first * dt, 6), begin)))
        if end <= episode.steps:
            vanishes = xosc.Event(f"{name} until {gone}", xosc.Priority.parallel)
            action = xosc.DeleteEntityAction(name)
            vanishes.add_action(f"{name} vanishes at {gone}", action)
            events.append(vanishes.add_trigger(at(round(end * dt, 6), gone)))
    return events


def places(episode: Episode, row: int, first: int, end: int) -> list:
    """WorldPositions of an agent's reference point; headings are continuous.

    Args:
        episode: the rollout.
        row: of the agent.
        first: step.
        end: step after the last one.
    """
    states = episode.rollout.states[first:end, row].astype(float)
    heading = np.unwrap(states[:, 2])
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    points = states[:, :2] - rear_axle(episode, row) * ahead
    rounded = np.column_stack([points, heading]).tolist()
    return [
        xosc.WorldPosition(x=round(x, 6), y=round(y, 6), z=0, h=round(angle, 6))
        for x, y, angle in rounded
    ]


def at(seconds: float, name: str, point: str = "start") -> Any:
    """The trigger of a simulation time."""
    condition = xosc.SimulationTimeCondition(seconds, xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(
        name,
        0,
        conditionedge=xosc.ConditionEdge.none,
        valuecondition=condition,
        triggeringpoint=point,
    )
