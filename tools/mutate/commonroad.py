"""Recorded logs of CommonRoad: XML."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tools.mutate.log import RecordedLog


@dataclass
class CommonRoadLog(RecordedLog):
    content: bytes = b""

    @staticmethod
    def of(name: str, content: bytes) -> "CommonRoadLog":
        root = ElementTree.fromstring(content)
        tracks = [list(_states(obstacle)) for obstacle in _obstacles(root)]
        steps = [[int(_exact(state, "time").text) for state in track] for track in tracks]
        first, count = min(map(min, steps)), max(map(max, steps)) - min(map(min, steps)) + 1
        arrays = {"position": (2,), "heading": (), "velocity": (2,)}
        found = {key: np.zeros((count, len(tracks), *shape)) for key, shape in arrays.items()}
        valid = np.zeros((count, len(tracks)), bool)
        for index, track in enumerate(tracks):
            for at, state in zip(steps[index], track, strict=True):
                heading = float(_exact(state, "orientation").text)
                found["position"][at - first, index] = [float(part.text) for part in state.find("position/point")]
                found["heading"][at - first, index], valid[at - first, index] = heading, True
                speed = float(_exact(state, "velocity").text)
                found["velocity"][at - first, index] = speed * np.array([np.cos(heading), np.sin(heading)])
        stamps = np.arange(count) * float(root.get("timeStepSize"))
        size = np.array([[float(part.text) for part in _box(obstacle)] for obstacle in _obstacles(root)])
        lines = [np.array([[float(part.text) for part in point] for point in bound]) for bound in _bounds(root)]
        return CommonRoadLog(
            Path(name).name, **found, valid=valid, size=size, stamps=stamps, lines=lines, ego=-1, content=content
        )

    def write(self, folder: Path) -> None:
        root = ElementTree.fromstring(self.content)
        tracks = [list(_states(obstacle)) for obstacle in _obstacles(root)]
        first = min(int(_exact(state, "time").text) for track in tracks for state in track)
        for index, track in enumerate(tracks):
            for state in track:
                at = int(_exact(state, "time").text) - first
                _put(state.find("position/point"), self.position[at, index])
                _exact(state, "orientation").text = str(self.heading[at, index])
                _exact(state, "velocity").text = str(np.linalg.norm(self.velocity[at, index]))
        for index, obstacle in enumerate(_obstacles(root)):
            _put(_box(obstacle), self.size[index])
        for bound, line in zip(_bounds(root), self.lines, strict=True):
            for point, place in zip(bound, line, strict=True):
                _put(point, place)
        root.set("timeStepSize", str(np.median(np.diff(self.stamps))))
        for edit in self.edits:
            edit(root)
        (folder / self.file).write_bytes(ElementTree.tostring(root))


def _obstacles(root: Any) -> list:
    return [one for one in root if one.tag in ("obstacle", "dynamicObstacle") and one.find("trajectory") is not None]


def _states(obstacle: Any) -> Iterator:
    yield obstacle.find("initialState")
    yield from obstacle.find("trajectory")


def _exact(state: Any, name: str) -> Any:
    return state.find(f"{name}/exact")


def _box(obstacle: Any) -> list:
    shape = obstacle.find("shape/rectangle")
    return [shape.find("length"), shape.find("width")]


def _bounds(root: Any) -> list:
    return [
        lane.find(side).findall("point") for lane in root.findall("lanelet") for side in ("leftBound", "rightBound")
    ]


def _put(parts: Any, values: np.ndarray) -> None:
    for part, value in zip(parts, values, strict=True):
        part.text = str(value)
