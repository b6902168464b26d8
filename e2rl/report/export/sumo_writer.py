"""A scenario that `sumo NAME.sumocfg` plays: a net that netconvert makes of OpenDRIVE
roads, and trajectories that SUMO's fcd-replay device follows (extra `sumo`;
docs/guide/export.md).

The device inserts a vehicle on the lane and at the position of its first state, moves
it to the coordinates of each later state, and lets it drive on after the last, unless
it is beside its lane. So every vehicle begins one step early, on a lane outside of the
map.
"""

import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np
from sumolib import checkBinary

from e2rl.report import drawing
from e2rl.report.export.episode import Episode
from e2rl.report.export.opendrive import write_roads
from e2rl.report.export.road_plan import road_plan
from e2rl.run.errors import InputError
from e2rl.scenes.paths import direction
from e2rl.scenes.recording import Lane

OUTSIDE = "outside"  # the lane on which vehicles begin
AWAY = 100.0  # m from the map to it
SHAPES = {  # by kind; all are of the class `passenger`, which roads admit
    "vehicle": "passenger",
    "truck": "truck",
    "cyclist": "bicycle",
    "pedestrian": "pedestrian",
    "other": "passenger",
}


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.sumocfg, and NAME.net.xml, NAME.add.xml (vehicle types) and
    NAME.fcd.xml (trajectories), which it names."""
    for episode in episodes:
        path = folder / f"{episode.path.stem}.sumocfg"
        start = write_net(episode, path.with_suffix(".net.xml"))
        _write(path.with_suffix(".add.xml"), vehicle_types(episode))
        _write(path.with_suffix(".fcd.xml"), trajectories(episode, start))
        _write(path, configuration(episode, path.stem))
        yield episode, path


def write_net(episode: Episode, path: Path) -> str:
    """Write the net of an episode; returns the id of the lane on which vehicles begin.

    Raises:
        InputError: netconvert is not there, or fails.
    """
    states = episode.rollout.states[episode.rollout.valid]
    points = [lane.points for lane in episode.lanes.values()]
    right, top = np.concatenate([states[:, :2], *points]).max(0) + AWAY
    lane = Lane(np.array([[right, top], [right + AWAY, top]]), width=3.5)
    lanes = {**episode.lanes, OUTSIDE: lane}
    with TemporaryDirectory() as temporary:
        roads = Path(temporary) / "roads.xodr"
        write_roads(replace(episode, lanes=lanes), roads)
        command = [
            checkBinary("netconvert"),
            "--opendrive-files",
            str(roads),
            "--offset.disable-normalization",
            "--output-file",
            str(path),
        ]
        try:
            done = subprocess.run(command, capture_output=True, text=True)
        except OSError as error:
            raise InputError(
                "--to sumo: netconvert of SUMO is not there; pip install eclipse-sumo, "
                "or set SUMO_HOME"
            ) from error
    if done.returncode:
        raise InputError(f"--to sumo: netconvert fails: {done.stderr.strip()[-200:]}")
    return f"-{list(road_plan(lanes).roads).index(OUTSIDE) + 1}_0"


def vehicle_types(episode: Episode) -> ElementTree.Element:
    """The types of all agents, each with its size and colour."""
    rollout = episode.rollout
    root = ElementTree.Element("additional")
    for row in episode.agents:
        colour = drawing.BACKGROUND
        if row == 0:
            colour = drawing.EGO
        elif rollout.adversaries[row]:
            colour = drawing.ADVERSARY
        elif not rollout.simulated[row]:
            colour = drawing.REPLAYED
        length, width = episode.size(row)
        kind = {
            "id": episode.name(row),
            "guiShape": SHAPES[episode.kind(row)],
            "length": f"{length:.3f}",
            "width": f"{width:.3f}",
            "color": colour,
        }
        ElementTree.SubElement(root, "vType", kind)
    return root


def trajectories(episode: Episode, start: str) -> ElementTree.Element:
    """The states of all agents, the first of the rollout after one step; a later
    appearance is another vehicle.

    start: the lane on which all begin.
    """
    rollout = episode.rollout
    root = ElementTree.Element("fcd-export")
    frames = [
        ElementTree.SubElement(root, "timestep", time=f"{step * rollout.dt:.2f}")
        for step in range(episode.steps + 2)
    ]
    for row in episode.agents:
        for number, (first, end) in enumerate(episode.appearances(row)):
            states = rollout.states[first:end, row].astype(float)
            unit = direction(states[:, 2])
            front = states[:, :2] + episode.size(row)[0] / 2 * unit
            begin = front[0] - states[0, 3] * rollout.dt * unit[0]
            speed = np.abs(states[:, 3])
            places = np.column_stack([front, 90 - np.degrees(states[:, 2]), speed])
            begun = [*begin, *places[0, 2:]]
            for frame, (x, y, angle, along) in enumerate([begun, *places], first):
                vehicle = {
                    "id": episode.name(row) + (f"#{number + 1}" if number else ""),
                    "x": f"{x:.4f}",
                    "y": f"{y:.4f}",
                    "angle": f"{angle % 360:.4f}",
                    "type": episode.name(row),
                    "speed": f"{along:.3f}",
                    "pos": f"{AWAY / 2:.2f}",
                    "lane": start,
                }
                ElementTree.SubElement(frames[frame], "vehicle", vehicle)
    return root


def configuration(episode: Episode, name: str) -> ElementTree.Element:
    """The configuration that plays the files of an episode."""
    dt = episode.rollout.dt
    options = {
        "net-file": f"{name}.net.xml",
        "additional-files": f"{name}.add.xml",
        "device.fcd-replay.files": f"{name}.fcd.xml",
        "step-length": f"{dt:g}",
        "end": f"{(episode.steps + 2) * dt:.2f}",
        "insertion-checks": "none",  # of gaps: all begin at one place
        "collision.action": "none",
        "time-to-teleport": "-1",
        "no-warnings": "true",
        "no-step-log": "true",
        "delay": f"{1000 * dt:g}",  # ms that sumo-gui waits: real time
    }
    root = ElementTree.Element("configuration")
    root.append(ElementTree.Comment(episode.text().replace("--", "- -")))
    for key, value in options.items():
        ElementTree.SubElement(root, key, value=value)
    return root


def _write(path: Path, root: ElementTree.Element) -> None:
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, "utf-8", xml_declaration=True)
