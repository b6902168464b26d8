"""Recorded logs of Argoverse 2: forecasting scenarios and sensor logs."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tools.mutate.log import FIELDS, RecordedLog


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
