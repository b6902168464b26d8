"""netconvert and SUMO: from a layout to its lane graph and raw 0.1 s traces."""

import subprocess
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import libsumo
import numpy as np
import sumo

from e2rl.scenes.paths import arc_length, resample, shift_left
from e2rl.scenes.recording import (
    DT,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    Lane,
)
from scenegen.layout import Layout
from scenegen.traffic import write_demand

NETCONVERT = """--no-turnarounds true --junctions.internal-link-detail 15 --junctions.limit-turn-speed 2.0
--default.junctions.radius 6 --junctions.corner-detail 8 --rectangular-lane-cut false --junctions.scurve-stretch 1.0
--tls.default-type actuated --tls.left-green.time 8 --offset.disable-normalization true --no-warnings true"""
SUMO = f"""--step-length {DT} --lateral-resolution 0.3 --time-to-teleport -1 --collision.action warn
--collision.check-junctions true --no-warnings true --no-step-log true"""
WARM_UP, RECORDED, LEAD = (
    60.0,
    100.0,
    8.0,
)  # s; tracks begin LEAD s before the recorded time, for the smoothers
STATES = {
    "r": LIGHT_RED,
    "u": LIGHT_RED,
    "y": LIGHT_YELLOW,
    "Y": LIGHT_YELLOW,
    "g": LIGHT_GREEN,
    "G": LIGHT_GREEN,
}
SHORTEST = 1.0  # m: shorter lanes are bridged by their neighbours


@dataclass
class Net:
    """A built net: lanes by id, junction and lane polygons, kerb lanes of parking
    edges, border points [Q, 2]."""

    lanes: dict[str, Lane]
    drivable: list[np.ndarray]
    kerbs: list[str]
    border: np.ndarray


@dataclass
class Track:
    """Raw trace of a vehicle: first frame (0: begin of the recorded time, may be
    negative), bumpers [T, 2], heading [T], length and width [m]."""

    first: int
    size: tuple[float, float]
    bumper: list[tuple[float, float]] = field(default_factory=list)
    heading: list[float] = field(default_factory=list)


def convert(layout: Layout, folder: Path) -> tuple[Path, Net]:
    """Build the net with netconvert and read it back."""
    path = folder / f"{layout.name}.net.xml"
    program = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    command = [
        program,
        *layout.write(folder),
        "--output-file",
        path,
        *NETCONVERT.split(),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"netconvert failed on {layout.name}: {done.stderr}")
    return path, read_net(ET.parse(path).getroot(), layout)


def _points(text: str) -> np.ndarray:
    return np.array([[float(v) for v in pair.split(",")[:2]] for pair in text.split()])


def read_net(root: ET.Element, layout: Layout) -> Net:
    """Lanes (junction lanes included) with exits and neighbours; polygons of junctions
    and of lanes between them."""
    lanes: dict[str, Lane] = {}
    ribbons = []
    for edge in root.iter("edge"):
        ids = [lane.get("id") for lane in edge.iter("lane")]
        inside = edge.get("function") == "internal"
        for k, lane in enumerate(edge.iter("lane")):
            points = _points(lane.get("shape"))
            width = float(lane.get("width", layout.lane_width))
            lanes[ids[k]] = Lane(points, width, float(lane.get("speed")))
            if not inside:
                lanes[ids[k]].left, lanes[ids[k]].right = (
                    ids[k + 1 : k + 2],
                    ids[max(k - 1, 0) : k],
                )
                ribbons.append(ribbon(points, width))
    for link in root.iter("connection"):
        target = link.get("via") or f"{link.get('to')}_{link.get('toLane')}"
        exits = lanes[f"{link.get('from')}_{link.get('fromLane')}"].exits
        if target not in exits:
            exits.append(target)
    for a, i, b, j in layout.tapers:
        taper = add_taper(lanes, f"{a}_{i}", f"{b}_{j}")
        ribbons.append(ribbon(taper.points, taper.width))
    bridge_short_lanes(lanes)
    shapes = [
        _points(node.get("shape"))
        for node in root.iter("junction")
        if node.get("shape")
    ]
    junctions = [
        shape
        for shape in shapes
        if len(shape) >= 3 and np.ptp(shape, axis=0).min() > 0.5
    ]
    kerbs = [f"{edge}_0" for edge in layout.parking]
    return Net(lanes, junctions + ribbons, kerbs, np.array(layout.border))


def ribbon(points: np.ndarray, width: float) -> np.ndarray:
    """Polygon of a lane: its centreline widened to both sides."""
    return np.concatenate(
        [shift_left(points, width / 2), shift_left(points, -width / 2)[::-1]]
    )


def add_taper(lanes: dict[str, Lane], ending: str, target: str) -> Lane:
    """Add the merging lane from a lane that ends to the lane beside its end, as a
    smooth shift; returns it."""
    first = lanes[ending]
    last = lanes[target]
    a = first.points[-1]
    b = last.points[0]
    u = first.points[-1] - first.points[-2]
    w = last.points[1] - last.points[0]
    reach = np.linalg.norm(b - a)
    t = np.linspace(0, 1, 16)[:, None]
    hermite = (
        (2 * t**3 - 3 * t**2 + 1) * a
        + (t**3 - 2 * t**2 + t) * reach * u / np.linalg.norm(u)
        + (3 * t**2 - 2 * t**3) * b
        + (t**3 - t**2) * reach * w / np.linalg.norm(w)
    )
    lane = Lane(hermite, first.width, last.speed_limit, [target])
    lanes[f"taper_{ending}"] = lane
    first.exits.append(f"taper_{ending}")
    return lane


def bridge_short_lanes(lanes: dict[str, Lane]) -> None:
    """Take out lanes shorter than SHORTEST; their predecessors lead to their
    successors."""
    for name in [
        n for n, lane in lanes.items() if arc_length(lane.points)[-1] < SHORTEST
    ]:
        exits = lanes.pop(name).exits
        for lane in lanes.values():
            if name in lane.exits:
                lane.exits = list(
                    dict.fromkeys([e for e in lane.exits if e != name] + exits)
                )
            lane.left = [n for n in lane.left if n != name]
            lane.right = [n for n in lane.right if n != name]


def run(
    layout: Layout, path: Path, net: Net, folder: Path, seed: int, rng
) -> tuple[list[Track], dict]:
    """Simulate; returns the tracks and the light states (lane id -> [RECORDED / DT]) of
    the controlled lanes."""
    demand = write_demand(layout, folder, WARM_UP + RECORDED, rng)
    libsumo.start(
        ["sumo", "-n", str(path), "-r", str(demand), "--seed", str(seed), *SUMO.split()]
    )
    try:
        return _trace(net)
    finally:
        libsumo.close()


def _trace(net: Net) -> tuple[list[Track], dict[str, np.ndarray]]:
    tracks: dict[str, Track] = {}
    controlled = {
        tls: _controlled(tls, net) for tls in libsumo.trafficlight.getIDList()
    }
    lights: dict[str, list[int]] = {
        lane: [] for links in controlled.values() for lane, _ in links
    }
    begin = round(WARM_UP / DT)
    for step in range(begin + round(RECORDED / DT)):
        libsumo.simulationStep()
        frame = step - begin
        if frame < -LEAD / DT:
            continue
        for name in libsumo.vehicle.getIDList():
            if name not in tracks:
                tracks[name] = Track(
                    frame,
                    (libsumo.vehicle.getLength(name), libsumo.vehicle.getWidth(name)),
                )
            tracks[name].bumper.append(libsumo.vehicle.getPosition(name))
            tracks[name].heading.append(
                np.pi / 2 - np.radians(libsumo.vehicle.getAngle(name))
            )
        if frame >= 0:
            for tls, links in controlled.items():
                state = libsumo.trafficlight.getRedYellowGreenState(tls)
                for lane, index in links:
                    lights[lane].append(STATES.get(state[index], LIGHT_UNKNOWN))
    return list(tracks.values()), {
        lane: np.array(states, np.int8) for lane, states in lights.items()
    }


def _controlled(tls: str, net: Net) -> list[tuple[str, int]]:
    """(junction lane, index in the state string) of a signal's links."""
    links = [
        (group[0][2], index)
        for index, group in enumerate(libsumo.trafficlight.getControlledLinks(tls))
        if group
    ]
    return [(lane, index) for lane, index in links if lane in net.lanes]


def densify(lanes: dict[str, Lane], spacing: float = 4.0) -> None:
    """Give every lane a vertex at least every `spacing` m, so curves and straights read
    alike."""
    for lane in lanes.values():
        steps = np.diff(arc_length(lane.points))
        parts = [
            resample(lane.points[k : k + 2], spacing)[:-1]
            if steps[k] > spacing
            else lane.points[k : k + 1]
            for k in range(len(steps))
        ]
        lane.points = np.concatenate([*parts, lane.points[-1:]])
