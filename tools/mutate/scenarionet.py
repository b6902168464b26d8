"""Recorded logs of ScenarioNet: pickles of ScenarioDescriptions."""

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tools.mutate.log import RecordedLog


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
