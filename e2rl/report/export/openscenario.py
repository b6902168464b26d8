"""ASAM OpenSCENARIO XML 1.2 with its road in OpenDRIVE, by scenariogeneration (extra
`openscenario`; docs/guide/export.md).

Every agent follows a polyline with a time at every vertex (FollowTrajectoryAction,
following mode `position`). A vertex is the place of an entity's reference point, which
for vehicles is the middle of the rear axle; BoundingBox.Center says where the box lies
from there.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scenariogeneration import xosc

from e2rl.report.export.episode import LONG, Episode
from e2rl.report.export.opendrive import write_roads
from e2rl.scenes.paths import WHEELBASE

MINOR_VERSION = 2
EGO = "Ego"
HEIGHT = {
    "car": 1.6,
    "truck": 3.0,
    "bicycle": 1.75,
    "pedestrian": 1.75,
    "other": 1.0,
}  # m; rollouts hold none
MASS = {
    "car": 1500.0,
    "truck": 10000.0,
    "bicycle": 90.0,
    "pedestrian": 75.0,
    "other": 100.0,
}  # kg
TRACK, WHEEL, STEERING = 0.8, 0.6, 0.6  # of the width; m, diameter; rad: of axles
PERFORMANCE = (
    70.0,
    5.0,
    8.0,
)  # m/s, m/s^2, m/s^2: top speed, acceleration, braking; trajectories do not ask for them


def write(
    episodes: Iterable[Episode], folder: Path, open_ego: bool = False
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.xosc, and NAME.xodr where there are lanes; open_ego: the ego has a
    start, no trajectory."""
    for episode in episodes:
        path = folder / f"{episode.path.stem}.xosc"
        road = path.with_suffix(".xodr") if episode.lanes else None
        if road is not None:
            write_roads(episode, road)
        scenario(episode, road.name if road else None, open_ego=open_ego).write_xml(
            str(path)
        )
        yield episode, path


def scenario(episode: Episode, road: str | None, open_ego: bool) -> Any:
    """The xosc.Scenario of an episode on the roads in the file `road`."""
    entities = xosc.Entities()
    init = xosc.Init()
    act = xosc.Act("replay", at(0.0, "replay begins"))
    for row in episode.agents:
        name = name_of(row)
        entities.add_scenario_object(name, entity(episode, row))
        if episode.rollout.valid[0, row]:
            init.add_init_action(
                name, xosc.TeleportAction(places(episode, row, first=0, end=1)[0])
            )
            speed = float(episode.rollout.states[0, row, 3])
            change = xosc.TransitionDynamics(
                xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0
            )
            init.add_init_action(name, xosc.AbsoluteSpeedAction(speed, change))
        events = [] if row == 0 and open_ego else events_of(episode, row)
        if events:
            manoeuvre = xosc.Maneuver(f"{name} drives")
            for event in events:
                manoeuvre.add_event(event)
            act.add_maneuver_group(
                xosc.ManeuverGroup(name).add_actor(name).add_maneuver(manoeuvre)
            )
    end = at(episode.steps * episode.rollout.dt, "replay ends", point="stop")
    board = xosc.StoryBoard(init, end)
    board.add_story(xosc.Story("rollout").add_act(act))
    facts = xosc.Properties()
    for key, value in episode.facts.items():
        facts.add_property(key, str(value))
    parts = (
        xosc.ParameterDeclarations(),
        entities,
        board,
        xosc.RoadNetwork(roadfile=road),
        xosc.Catalog(),
    )
    how = {"osc_minor_version": MINOR_VERSION, "header_properties": facts}
    return xosc.Scenario(episode.text(), "e2rl", *parts, **how)


def name_of(row: int) -> str:
    """The name of an agent's entity."""
    return EGO if row == 0 else f"agent_{row}"


def kind_of(episode: Episode, row: int) -> str:
    """car, truck, bicycle, pedestrian or other."""
    kind = str(episode.rollout.agent_type[row])
    if kind == "vehicle":
        return "truck" if episode.size(row)[0] > LONG else "car"
    return {"cyclist": "bicycle"}.get(kind, kind)


def rear_axle(episode: Episode, row: int) -> float:
    """How far [m] the reference point of an agent lies behind the middle of its box."""
    return (
        WHEELBASE / 2 * episode.size(row)[0]
        if kind_of(episode, row) in ("car", "truck", "bicycle")
        else 0.0
    )


def entity(episode: Episode, row: int) -> Any:
    """The Vehicle, Pedestrian or MiscObject of an agent."""
    kind, (length, width), back = (
        kind_of(episode, row),
        episode.size(row),
        rear_axle(episode, row),
    )
    name = f"{name_of(row)} {kind}"
    height = HEIGHT[kind]
    box = xosc.BoundingBox(width, length, height, back, 0.0, height / 2)
    made: Any
    if kind == "pedestrian":
        made = xosc.Pedestrian(
            name, MASS[kind], xosc.PedestrianCategory.pedestrian, box
        )
    elif kind == "other":
        made = xosc.MiscObject(name, MASS[kind], xosc.MiscObjectCategory.obstacle, box)
    else:
        front = xosc.Axle(STEERING, WHEEL, TRACK * width, 2 * back, WHEEL / 2)
        rear = xosc.Axle(0.0, WHEEL, TRACK * width, 0.0, WHEEL / 2)
        made = xosc.Vehicle(
            name,
            xosc.VehicleCategory[kind],
            box,
            front,
            rear,
            *PERFORMANCE,
            mass=MASS[kind],
        )
    rollout = episode.rollout
    role = (
        "ego" if row == 0 else "adversary" if rollout.adversaries[row] else "simulated"
    )
    made.add_property(
        "role", role if row == 0 or rollout.simulated[row] else "replayed"
    )
    made.add_property("row", str(row))
    return made


def events_of(episode: Episode, row: int) -> list:
    """The events of an agent: it appears and follows its polyline, and it vanishes, as
    often as the rollout has it."""
    name = name_of(row)
    events = []
    for first, end in episode.appearances(row):
        begin, gone = (round(step * episode.rollout.dt, 6) for step in (first, end))
        path = places(episode, row, first=first, end=end)
        drives = xosc.Event(f"{name} from {begin:g} s", xosc.Priority.parallel)
        if first > 0:
            drives.add_action(
                f"{name} appears at {begin:g} s", xosc.AddEntityAction(name, path[0])
            )
        if end - first >= 2:  # a polyline needs two vertices
            times = np.round(np.arange(first, end) * episode.rollout.dt, 6).tolist()
            trajectory = xosc.Trajectory(f"{name} from {begin:g} s", False).add_shape(
                xosc.Polyline(times, path)
            )
            how = (xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0)
            drives.add_action(
                f"{name} drives from {begin:g} s",
                xosc.FollowTrajectoryAction(trajectory, *how),
            )
        if first > 0 or end - first >= 2:
            events.append(drives.add_trigger(at(begin, f"{begin:g} s")))
        if end <= episode.steps:
            vanishes = xosc.Event(f"{name} until {gone:g} s", xosc.Priority.parallel)
            vanishes.add_action(
                f"{name} vanishes at {gone:g} s", xosc.DeleteEntityAction(name)
            )
            events.append(vanishes.add_trigger(at(gone, f"{gone:g} s")))
    return events


def places(episode: Episode, row: int, first: int, end: int) -> list:
    """WorldPositions of an agent's reference point at steps first to end - 1; headings
    are continuous."""
    states = episode.rollout.states[first:end, row].astype(float)
    heading = np.unwrap(states[:, 2])
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    points = states[:, :2] - rear_axle(episode, row) * ahead
    return [
        xosc.WorldPosition(x=round(x, 6), y=round(y, 6), z=0, h=round(h, 6))
        for x, y, h in zip(*points.T.tolist(), heading.tolist(), strict=True)
    ]


def at(seconds: float, name: str, point: str = "start") -> Any:
    """The trigger of a simulation time."""
    condition = xosc.SimulationTimeCondition(seconds, xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, point)
