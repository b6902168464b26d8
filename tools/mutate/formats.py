"""Recorded logs of every format as arrays that can be changed, and written again in their own format."""

import copy
import json
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from e2rl.scene.argoverse2 import Argoverse2Source
from e2rl.scene.commonroad import CommonRoadSource
from e2rl.scene.log_files import LogFiles
from e2rl.scene.scenarionet import ScenarioNetSource, safe_load
from e2rl.scene.source import Source

FIELDS = ("position", "heading", "velocity", "valid", "size", "stamps", "lines")


@dataclass
class RecordedLog:
    """position [F, A, 2] m, heading [F, A] rad, velocity [F, A, 2] m/s, valid [F, A], size [A, 2] m, stamps [F] s;
    lines: the points [P, 2] m of everything in the map; ego: its track, -1 where the file names none.

    file: its name, relative to the folder that it is written into; holds: those of FIELDS that the format has; edits:
    changes of the format's own content.
    """

    file: str
    position: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    valid: np.ndarray
    size: np.ndarray
    stamps: np.ndarray
    lines: list[np.ndarray]
    ego: int
    holds: frozenset[str] = frozenset(FIELDS)
    edits: list[Callable[[Any], None]] = field(default_factory=list)
    resized: bool = False

    def changed(self, change: Callable[["RecordedLog"], None]) -> "RecordedLog":
        """A copy with a change."""
        own = copy.copy(self)
        for name in FIELDS[:-1]:
            setattr(own, name, np.array(getattr(self, name)))
        own.lines, own.edits = [line.copy() for line in self.lines], []
        change(own)
        own.resized = not np.array_equal(own.size, self.size)
        return own

    def write(self, folder: Path) -> None:
        """Write the log's files into a folder."""
        raise NotImplementedError


# --- ScenarioDescription pickles


@dataclass
class ScenarioNetLog(RecordedLog):
    data: dict = field(default_factory=dict)

    @staticmethod
    def of(name: str, data: dict) -> "ScenarioNetLog":
        states = [track["state"] for track in data["tracks"].values()]
        frames = len(states[0]["position"])

        def columns(key: str, width: int) -> np.ndarray:
            parts = [np.asarray(state[key], float).reshape(frames, -1)[:, :width] for state in states]
            return np.stack(parts, 1)

        stamps = np.asarray(data["metadata"].get("ts", 0.1 * np.arange(frames)), float)
        known = columns("valid", 1)[..., 0] > 0
        sizes = [columns(key, 1)[..., 0] for key in ("length", "width")]
        size = np.stack(
            [
                [np.median(part[there]) if there.any() else 1.0 for part, there in zip(each.T, known.T, strict=True)]
                for each in sizes
            ],
            -1,
        )
        return ScenarioNetLog(
            file=Path(name).name,
            position=columns("position", 2),
            heading=columns("heading", 1)[..., 0],
            velocity=columns("velocity", 2),
            valid=known,
            size=size,
            stamps=stamps,
            lines=[np.asarray(line, float)[:, :2] for line in _lines(data)],
            ego=[str(key) for key in data["tracks"]].index(str(data["metadata"]["sdc_id"])),
            data=data,
        )

    def description(self) -> dict:
        """The changed ScenarioDescription."""
        tracks, count = {}, len(self.position)
        for index, (key, track) in enumerate(self.data["tracks"].items()):
            state = dict(track["state"])
            height = np.asarray(state["position"], float)[:count, 2:]
            state["position"] = np.concatenate([self.position[:, index], height], 1)
            state |= {"heading": self.heading[:, index], "velocity": self.velocity[:, index]}
            state["valid"] = self.valid[:, index]
            for side, name in enumerate(("length", "width")):
                state[name] = np.asarray(state[name])[:count]
                if self.resized:
                    state[name] = np.full(count, self.size[index, side])
            tracks[key] = {**track, "state": state}
        features = {key: dict(feature) for key, feature in self.data["map_features"].items()}
        data = {**self.data, "tracks": tracks, "map_features": features}
        data["metadata"] = {**self.data["metadata"], "ts": self.stamps}
        data["dynamic_map_states"] = dict(self.data.get("dynamic_map_states", {}))
        for (feature, name), line in zip(_places(features), self.lines, strict=True):
            feature[name] = np.concatenate([line, np.asarray(feature[name], float)[:, 2:]], 1)
        for edit in self.edits:
            edit(data)
        return data

    def write(self, folder: Path) -> None:
        (folder / self.file).write_bytes(pickle.dumps(self.description()))


def _places(features: dict) -> Iterator[tuple[dict, str]]:
    for feature in features.values():
        for name in ("polyline", "polygon"):
            if np.ndim(feature.get(name)) == 2:
                yield feature, name


def _lines(data: dict) -> Iterator[np.ndarray]:
    return (feature[name] for feature, name in _places(data["map_features"]))


# --- CommonRoad XML


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


# --- Argoverse 2


@dataclass
class ScenarioLog(RecordedLog):
    """A motion-forecasting scenario."""

    table: Any = None
    map_file: Path = Path()

    @staticmethod
    def of(path: Path) -> "ScenarioLog":
        import pandas

        table = pandas.read_parquet(path)
        names, track = np.unique(table["track_id"], return_inverse=True)
        shape, at = (int(table["num_timestamps"].iloc[0]), len(names)), (table["timestep"].to_numpy(), track)
        arrays = {"position": np.zeros((*shape, 2)), "heading": np.zeros(shape), "velocity": np.zeros((*shape, 2))}
        for name, columns in SCENARIO_COLUMNS.items():
            arrays[name][at] = table[columns].to_numpy() if len(columns) > 1 else table[columns[0]].to_numpy()
        valid = np.zeros(shape, bool)
        valid[at] = True
        return ScenarioLog(
            path.name,
            **arrays,
            valid=valid,
            size=np.ones((len(names), 2)),
            stamps=0.1 * np.arange(shape[0]),
            lines=map_lines(map_of(path.parent)),
            ego=list(names).index("AV"),
            holds=frozenset(FIELDS) - {"size"},
            table=table,
            map_file=map_of(path.parent),
        )

    def write(self, folder: Path) -> None:
        table = self.table.copy()
        _, track = np.unique(table["track_id"], return_inverse=True)
        step = table["timestep"].to_numpy()
        for name, columns in SCENARIO_COLUMNS.items():
            values = getattr(self, name)[step, track].reshape(len(step), -1)
            for column, part in zip(columns, values.T, strict=True):
                table[column] = part
        factor = np.median(np.diff(self.stamps)) / 0.1
        table["end_timestamp"] = table["start_timestamp"] + factor * (table["end_timestamp"] - table["start_timestamp"])
        table = table[self.valid[step, track]]
        for edit in self.edits:
            edit(table)
        table.to_parquet(folder / self.file)
        write_map(self.map_file, self.lines, folder)


SCENARIO_COLUMNS = {
    "position": ["position_x", "position_y"],
    "heading": ["heading"],
    "velocity": ["velocity_x", "velocity_y"],
}


@dataclass
class SensorLog(RecordedLog):
    """An annotated sensor log, whose boxes are written from the ego's pose; track 0 is the ego."""

    folder: Path = Path()

    @staticmethod
    def of(path: Path) -> "SensorLog":
        import pandas

        boxes, poses = pandas.read_feather(path), pandas.read_feather(path.parent / POSES).set_index("timestamp_ns")
        stamps, frame = np.unique(boxes["timestamp_ns"], return_inverse=True)
        names, track = np.unique(boxes["track_uuid"].astype(str), return_inverse=True)
        ego = poses.loc[stamps]
        place, turn = ego[["tx_m", "ty_m"]].to_numpy(), _yaw(ego)
        position, heading = np.zeros((len(stamps), len(names) + 1, 2)), np.zeros((len(stamps), len(names) + 1))
        valid = np.zeros(heading.shape, bool)
        position[:, 0], heading[:, 0], valid[:, 0] = place, turn, True
        position[frame, track + 1] = place[frame] + _turned(boxes[["tx_m", "ty_m"]].to_numpy(), turn[frame])
        heading[frame, track + 1], valid[frame, track + 1] = turn[frame] + _yaw(boxes), True
        size = np.ones((len(names) + 1, 2))
        size[track + 1] = boxes[["length_m", "width_m"]].to_numpy()
        given = {"position": position, "heading": heading, "velocity": np.zeros_like(position), "valid": valid}
        return SensorLog(
            path.name,
            **given,
            size=size,
            stamps=(stamps - stamps[0]) / 1e9,
            lines=map_lines(map_of(path.parent)),
            ego=0,
            holds=frozenset(FIELDS) - {"velocity"},
            folder=path.parent,
        )

    def write(self, folder: Path) -> None:
        import pandas

        boxes, poses = pandas.read_feather(self.folder / self.file), pandas.read_feather(self.folder / POSES)
        stamps, frame = np.unique(boxes["timestamp_ns"], return_inverse=True)
        _, track = np.unique(boxes["track_uuid"].astype(str), return_inverse=True)
        now = (stamps[0] + np.round(self.stamps * 1e9)).astype("int64")
        poses = poses.set_index("timestamp_ns").loc[stamps].reset_index()
        poses["timestamp_ns"], boxes["timestamp_ns"] = now, now[frame]
        _set_pose(poses, self.position[:, 0], self.heading[:, 0])
        away = self.position[frame, track + 1] - self.position[frame, 0]
        turn = self.heading[frame, 0]
        _set_pose(boxes, _turned(away, -turn), self.heading[frame, track + 1] - turn)
        boxes[["length_m", "width_m"]] = self.size[track + 1]
        boxes = boxes[self.valid[frame, track + 1]].reset_index(drop=True)
        for edit in self.edits:
            edit(boxes)
        boxes.to_feather(folder / self.file)
        poses.to_feather(folder / POSES)
        write_map(map_of(self.folder), self.lines, folder)


POSES = "city_SE3_egovehicle.feather"


def _yaw(table: Any) -> np.ndarray:
    w, x, y, z = table[["qw", "qx", "qy", "qz"]].to_numpy().T
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def _turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    x, y = points.T
    return np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], -1)


def _set_pose(table: Any, place: np.ndarray, heading: np.ndarray) -> None:
    table[["tx_m", "ty_m"]] = place
    table[["qw", "qx", "qy", "qz"]] = 0.0
    table["qw"], table["qz"] = np.cos(heading / 2), np.sin(heading / 2)


def map_of(folder: Path) -> Path:
    return next(iter([*folder.glob("log_map_archive_*.json"), *folder.glob("map/log_map_archive_*.json")]))


def _point_lists(value: Any) -> Iterator[list]:
    if isinstance(value, list) and value and isinstance(value[0], dict) and "x" in value[0]:
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _point_lists(part)


def map_lines(file: Path) -> list[np.ndarray]:
    return [
        np.array([[point["x"], point["y"]] for point in line]) for line in _point_lists(json.loads(file.read_text()))
    ]


def write_map(file: Path, lines: list[np.ndarray], folder: Path) -> None:
    data = json.loads(file.read_text())
    for points, line in zip(_point_lists(data), lines, strict=True):
        for point, (x, y) in zip(points, line, strict=True):
            point |= {"x": float(x), "y": float(y)}
    (folder / file.name).write_text(json.dumps(data))


# --- all of them


def source_of(path: str) -> Source:
    """The source of the logs at a path, by their names."""
    root = Path(path)
    if root.is_dir() and list(root.rglob("log_map_archive_*.json")):
        return Argoverse2Source(path)
    kinds: tuple[type[LogFiles], ...] = (ScenarioNetSource, CommonRoadSource)
    names = [file.name for file in root.rglob("*")] if root.is_dir() else _names(root)
    kind = next((kind for kind in kinds if any(name.endswith(kind.ending) for name in names)), ScenarioNetSource)
    return kind(path)


def _names(archive: Path) -> list[str]:
    import zipfile

    with zipfile.ZipFile(archive) as opened:
        return opened.namelist()


def opened(source: Source, log: str) -> RecordedLog:
    """A log of a source."""
    if isinstance(source, ScenarioNetSource):
        return ScenarioNetLog.of(log, safe_load(source.content(log), log))
    if isinstance(source, CommonRoadSource):
        return CommonRoadLog.of(log, source.content(log))
    path = source.root() / log
    return ScenarioLog.of(path) if path.suffix == ".parquet" else SensorLog.of(path)
