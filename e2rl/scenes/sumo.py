"""Source of SUMO runs: the FCD output of a simulation with its net, which sumolib reads
(extra `sumo`).

FCD gives the middle of the front bumper, and degrees clockwise from north; sizes stand
in the vehicle types of the route files. The ego is who is called so, else the vehicle
that drives farthest.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import nan, radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.egos import with_egos
from e2rl.scenes.log_files import LogFiles, bounded_memory, xml_parser
from e2rl.scenes.paths import direction, shift_left, wrap
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    CYCLIST,
    DT,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
)
from e2rl.scenes.resampling import latest_frames, resample_uniform

NET = ".net.xml"
TYPES = (".rou.xml", ".add.xml")  # files that may hold vehicle types
EGO = "vehicle ego"  # who is called so is the ego
LIGHTS = "tls.xml"  # of an output of type SaveTLSStates
CAR = (5.0, 1.8)
# SUMO's usual length and width [m] by class; tracks of other classes (on rails, on
# water, in the air) are left out
SIZES = {
    "passenger": CAR,
    "private": CAR,
    "taxi": CAR,
    "hov": CAR,
    "evehicle": CAR,
    "army": CAR,
    "authority": CAR,
    "vip": CAR,
    "custom1": CAR,
    "custom2": CAR,
    "delivery": (6.5, 2.16),
    "emergency": (6.5, 2.16),
    "truck": (7.1, 2.4),
    "trailer": (16.5, 2.55),
    "bus": (12.0, 2.5),
    "coach": (14.0, 2.6),
    "tram": (22.0, 2.4),
    "motorcycle": (2.2, 0.9),
    "moped": (2.1, 0.78),
    "bicycle": (1.6, 0.65),
    "scooter": (1.2, 0.5),
    "pedestrian": (0.215, 0.478),
    "wheelchair": (1.2, 0.72),
}
KINDS = {  # of classes; others are vehicles
    "bicycle": CYCLIST,
    "scooter": CYCLIST,
    "pedestrian": PEDESTRIAN,
    "wheelchair": PEDESTRIAN,
}
DEFAULT_CLASSES = {  # of the types that SUMO knows without a file
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_RAILTYPE": "rail",
}
COLOURS = {
    **dict.fromkeys("ru", LIGHT_RED),
    **dict.fromkeys("yY", LIGHT_YELLOW),
    **dict.fromkeys("gG", LIGHT_GREEN),
}
# functions of edges that are no lanes
WALKED = {"crossing", "walkingarea", "connector"}
CARS = {"passenger", "bus"}  # whose lanes are drivable
TELEPORT = 5.0  # m beyond what a speed makes, which no change of lanes explains
SIDEWAYS = 1.0  # m from one frame to the next, which no vehicle steers
JUMPED = "sideways jumps of vehicles, such as SUMO's changes of lanes in a single step"


class Kind(NamedTuple):
    """A vehicle type: its class, length and width [m]."""

    name: str
    length: float
    width: float


class State(NamedTuple):
    """A vehicle or person at a frame: front x, y and height z [m], heading [rad], speed
    [m/s]."""

    frame: int
    x: float
    y: float
    z: float
    heading: float
    speed: float


@dataclass
class SumoSource(LogFiles):
    """The FCD outputs (*fcd.xml) in a folder or zip, each beside its net."""

    holds = "FCD outputs of SUMO"
    ending = "fcd.xml"
    mend = "run SUMO again or leave it out"
    extra = "sumo"

    def read(self, log: str) -> Iterator[Recording]:
        nets = self._beside(log, NET)
        if len(nets) != 1:
            raise InputError(f"{len(nets)} files {NET} beside it; keep that of its run")
        with bounded_memory():
            net = Net(self.content(nets[0]))
            kinds = {
                name: Kind(kind, *SIZES.get(kind, CAR))
                for name, kind in DEFAULT_CLASSES.items()
            }
            for ending in TYPES:
                for name in self._beside(log, ending):
                    kinds |= vehicle_types(self.content(name))
            lights: dict[str, list[tuple[float, str]]] = {}
            for name in self._beside(log, LIGHTS):
                lights |= light_programs(self.content(name))
            recording, names = read_run(
                self.content(log),
                net,
                kinds=kinds,
                lights=lights,
            )
        named = replace(
            recording,
            scene_id=log.removesuffix(".xml").removesuffix(".fcd"),
            location=nets[0].removesuffix(NET),
        )
        egos = [track for track, name in enumerate(names) if name.lower() == EGO]
        yield with_egos(named, self.starts, steps=self.build.steps, started=egos)

    def fingerprint(self) -> bytes:
        root = self.root()
        endings = (self.ending, NET, *TYPES, LIGHTS)
        names = {name for ending in endings for name in self.names(ending)}
        return hash_files(
            [root] if root.is_file() else map(root.joinpath, sorted(names))
        )

    def _beside(self, log: str, ending: str) -> list[str]:
        """Returns the files of an ending in the folder of a log: that of its own name,
        else all."""
        path = Path(log)
        names = [
            name for name in self.names(ending) if Path(name).parent == path.parent
        ]
        own = str(
            path.with_name(path.name.removesuffix(self.ending).rstrip(".") + ending)
        )
        return [own] if own in names else names


class Net:
    """The lanes, drivable polygons and controlled links of a net.

    controlled: by (traffic light, index in its state) the lanes that the link leads to.
    """

    def __init__(self, content: bytes) -> None:
        from sumolib.net import NetReader  # not loaded where no net is read

        reader = NetReader(withInternal=True, withFoes=False)
        lefthand = False

        def begin(name: str, attributes: dict[str, str]) -> None:
            nonlocal lefthand
            lefthand |= name == "net" and attributes.get("lefthand") == "true"
            reader.startElement(name, attributes)

        parser = xml_parser()
        parser.StartElementHandler = begin
        parser.EndElementHandler = reader.endElement
        parser.Parse(content, True)
        net = reader.getNet()
        self.lanes: dict[str, Lane] = {}
        self.drivable = [
            np.array(node.getShape())[:, :2]
            for node in net.getNodes()
            if len(node.getShape()) > 2
        ]
        self.controlled: dict[tuple[str, int], list[str]] = {}
        for edge in net.getEdges(withInternal=True):
            if edge.getFunction() not in WALKED:
                self._add(edge, lefthand)

    def _add(self, edge: Any, lefthand: bool) -> None:
        """Add the lanes of an edge; those of `lefthand` nets are numbered from the left."""
        ordered = edge.getLanes()[::-1] if lefthand else edge.getLanes()
        cars = {lane.getID(): lane.allows("passenger") for lane in ordered}
        ids = list(cars)
        for number, lane in enumerate(ordered):
            points = np.array(lane.getShape3D())
            width = lane.getWidth()
            line = points[:, :2]
            if any(map(lane.allows, CARS)) and not edge.isSpecial():
                sides = [
                    shift_left(line, width / 2),
                    shift_left(line, -width / 2)[::-1],
                ]
                self.drivable.append(np.concatenate(sides))
            if not cars[ids[number]]:
                continue
            exits = []
            for link in lane.getOutgoing():
                after = link.getViaLaneID() or link.getToLane().getID()
                exits.append(after)
                if link.getTLSID():
                    key = (link.getTLSID(), link.getTLLinkIndex())
                    self.controlled.setdefault(key, []).append(after)
            beside = [] if edge.isSpecial() else ids
            self.lanes[ids[number]] = Lane(
                points=line,
                width=width,
                speed_limit=lane.getSpeed(),
                exits=exits,
                left=[name for name in beside[number + 1 : number + 2] if cars[name]],
                right=[name for name in beside[:number][-1:] if cars[name]],
                heights=points[:, 2],
            )


def vehicle_types(content: bytes) -> dict[str, Kind]:
    """Returns the vehicle types of a route or additional file by their id."""
    kinds = {}

    def begin(name: str, attributes: dict[str, str]) -> None:
        if name == "vType":
            kind = attributes.get("vClass", "passenger")
            shape = attributes.get("guiShape")  # tells who is driven as a car
            kind = shape if shape in KINDS else kind
            length, width = SIZES.get(kind, CAR)
            kinds[attributes["id"]] = Kind(
                kind,
                length=float(attributes.get("length", length)),
                width=float(attributes.get("width", width)),
            )

    _parse(content, begin)
    return kinds


def light_programs(content: bytes) -> dict[str, list[tuple[float, str]]]:
    """Returns by traffic light its (time [s], state of all links), in order."""
    states: dict[str, list[tuple[float, str]]] = {}

    def begin(name: str, attributes: dict[str, str]) -> None:
        if name == "tlsState":
            state = (float(attributes["time"]), attributes["state"])
            states.setdefault(attributes["id"], []).append(state)

    _parse(content, begin)
    return states


def _parse(content: bytes, begin: Any) -> None:
    parser = xml_parser()
    parser.StartElementHandler = begin
    parser.Parse(content, True)


def read_run(
    content: bytes,
    net: Net,
    *,
    kinds: dict[str, Kind],
    lights: dict[str, list[tuple[float, str]]],
) -> tuple[Recording, list[str]]:
    """Returns the recording in an FCD output at 10 Hz, without an ego and names, and by
    track the element and id of its vehicle or person.

    Args:
        content: of the output.
        net: of the run.
        kinds: vehicle types by id.
        lights: see `light_programs`.

    Raises:
        InputError: an unknown vehicle type, nobody on the road, bad time stamps.
    """
    times, tracks, types = _read_tracks(content, kinds)
    if not tracks:
        raise InputError("nobody on the road; leave it out")
    seconds = np.array(times) - times[0]
    split = [
        (name, part)
        for name, track in tracks.items()
        for part in _parts(np.array(track), seconds)
    ]
    shape = (len(times), len(split))
    check({"states": max(len(times), seconds[-1] / DT) * len(split)}, "the run")
    states = np.zeros((*shape, 4))
    heights = np.full(shape, nan)
    valid = np.zeros(shape, bool)
    jumps = 0
    names = [name for name, _ in split]
    for index, (name, track) in enumerate(split):
        frames = track[:, 0].astype(int)
        middle = track[:, 1:3] - types[name].length / 2 * direction(track[:, 4])
        states[frames, index] = np.column_stack([middle, track[:, 4:]])
        heights[frames, index] = track[:, 3]
        valid[frames, index] = True
        jumps += _jumps(states[frames, index])
    states, valid, levels = resample_uniform(states, valid, seconds, heights)
    grid = times[0] + seconds[latest_frames(seconds, len(states))]
    recording = Recording(
        scene_id="",
        location="",
        dataset="sumo",
        states=states,
        valid=valid,
        size=np.array([types[name][1:] for name in names]),
        agent_type=np.array([KINDS.get(types[name].name, VEHICLE) for name in names]),
        ego=-1,
        lanes=net.lanes,
        drivable=net.drivable,
        lights=_lights(net, lights, grid),
        current=None,
        repairs=Counter({JUMPED: jumps} if jumps else {}),
        heights=levels,
    )
    return recording, names


def _read_tracks(
    content: bytes, kinds: dict[str, Kind]
) -> tuple[list[float], dict[str, list[State]], dict[str, Kind]]:
    """Returns the times [s] of frames, and by vehicle or person the states and the
    type. Persons in a vehicle are written as well, at its bumper: they are left out."""
    times: list[float] = []
    tracks: dict[str, list[State]] = {}
    types: dict[str, Kind] = {}
    bumpers: set[tuple[int, str, str]] = set()
    persons: list[tuple[str, tuple[int, str, str], State]] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        if name == "timestep":
            times.append(float(attributes["time"]))
        if name not in ("vehicle", "person"):
            return
        kind = attributes["type"]
        if kind not in kinds:
            raise InputError(
                f"vehicle type {kind[:60]!r} is in no {' or '.join(TYPES)} beside it; "
                "copy the file that defines it there"
            )
        if kinds[kind].name not in SIZES:
            return
        track = f"{name} {attributes['id']}"
        types[track] = kinds[kind]
        frame = len(times) - 1
        state = State(
            frame,
            x=float(attributes["x"]),
            y=float(attributes["y"]),
            z=float(attributes.get("z", nan)),
            heading=float(wrap(radians(90 - float(attributes["angle"])))),
            speed=float(attributes["speed"]),
        )
        place = (frame, attributes["x"], attributes["y"])
        if name == "person":
            persons.append((track, place, state))
        else:
            bumpers.add(place)
            tracks.setdefault(track, []).append(state)

    _parse(content, begin)
    for track, place, state in persons:
        if place not in bumpers:
            tracks.setdefault(track, []).append(state)
    return times, tracks, types


def _parts(track: ndarray, seconds: ndarray) -> list[ndarray]:
    """Returns a track [K, 6] cut where it teleports.

    seconds [F]: of the frames.
    """
    span = np.diff(seconds[track[:, 0].astype(int)])
    reach = np.maximum(track[1:, 5], track[:-1, 5]) * span + TELEPORT
    moved = np.linalg.norm(np.diff(track[:, 1:3], axis=0), axis=1)
    return np.split(track, np.flatnonzero(moved > reach) + 1)


def _jumps(states: ndarray) -> int:
    """Returns how often a track [K, 4] is moved sideways from one frame to the next."""
    moved = np.diff(states[:, :2], axis=0)
    turned = wrap(np.diff(states[:, 2]))
    left = direction(states[:-1, 2] + turned / 2 + np.pi / 2)
    return int((np.abs((moved * left).sum(-1)) > SIDEWAYS).sum())


def _lights(
    net: Net,
    programs: dict[str, list[tuple[float, str]]],
    grid: ndarray,
) -> dict[str, ndarray]:
    """Returns light states [F] by lane at the times grid [F] s; unknown before the first
    that is recorded."""
    lights: dict[str, ndarray] = {}
    for (light, index), lanes in net.controlled.items():
        if light not in programs:
            continue
        times = np.array([time for time, _ in programs[light]])
        colours = [
            COLOURS.get(state[index], LIGHT_UNKNOWN) for _, state in programs[light]
        ]
        latest = np.searchsorted(times, grid + DT / 100, side="right")
        states = np.array([LIGHT_UNKNOWN, *colours], np.int8)[latest]
        lights |= {lane: states for lane in lanes if lane in net.lanes}
    return lights
