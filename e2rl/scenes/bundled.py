"""Source of the scenes that come with the package: synthetic traffic on synthetic maps,
one archive per split.

Format e2rl-scenes/1 (npz, readable without pickle; written by
tools/scenegen/archive.py): positions in mm, headings in 1e-4 rad and speeds in mm/s as
int32; states as second differences over time, which compress well; ragged parts one
after another, with counts.
"""

import hashlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy import ndarray

from e2rl.run.errors import InputError
from e2rl.run.files import read_arrays
from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)
from e2rl.scenes.source import (
    Source,
    default_of,
)

SHA256 = {  # of the archives of the splits, as tools/generate_scenes.py prints them
    "train": "1cea380fbf9246395a7a4514e7a1d8e2d7acd83b82ba34e6a01e6411e0aafb3d",
    "tune": "78e4ec78fe3ee1c11458b47a6bcea8e00671bbed6e186687ead1c32c905bbe1a",
    "test": "2cf8f86f8aa91d05eeee83db7f5a2629aafb501dfeef40f0548480e3564a9b67",
}
SPLITS = tuple(SHA256)
FORMAT = "e2rl-scenes/1"
FRAMES = 111
CURRENT = 10
MILLI = 1e-3
# m, m, rad, m/s per stored step of x, y, heading, speed
UNIT = np.array([MILLI, MILLI, 1e-4, MILLI])
MEND = "restore the file from git, or write it again with tools/generate_scenes.py"


@dataclass
class SceneMap:
    """The map of one synthetic place.

    drivable: polygons; lights: lane id -> [T] states over the whole simulation of the
    place at 10 Hz.
    """

    name: str
    lanes: dict[str, Lane]
    drivable: list[ndarray]
    lights: dict[str, ndarray]

    def recording(
        self,
        scene_id: str,
        *,
        first: int,
        states: ndarray,
        valid: ndarray,
        size: ndarray,
        ego: int,
    ) -> Recording:
        """Returns a recording of vehicles on this map.

        Args:
            scene_id: of the recording.
            first: frame of the lights at its first frame.
            states: [F, A, 4] of the vehicles.
            valid: [F, A] where they are recorded.
            size: [A, 2] m.
            ego: index of its track.
        """
        frames = slice(first, first + len(states))
        return Recording(
            scene_id=scene_id,
            location=self.name,
            dataset="bundled",
            states=states,
            valid=valid,
            size=size,
            agent_type=np.full(len(size), VEHICLE),
            ego=ego,
            lanes=self.lanes,
            drivable=self.drivable,
            lights={lane: state[frames] for lane, state in self.lights.items()},
            current=CURRENT,
        )


@dataclass
class BundledSource(Source):
    """The bundled scenes of split train, tune or test."""

    split: str | None = default_of("split", "data/bundled")

    has_splits = True

    def logs(self) -> list[str]:
        return list(_recordings_by_id(self.split_name))

    def read(self, log: str) -> Iterator[Recording]:
        yield _recordings_by_id(self.split_name)[log]

    def fingerprint(self) -> bytes:
        return asset_bytes(self.split_name)


def asset_bytes(split: str) -> bytes:
    """Returns the archive of a split; raises InputError where the split is unknown, or
    its file missing or altered."""
    if split not in SPLITS:
        raise InputError(
            f"split {split!r} of the bundled scenes: "
            f"expected one of {', '.join(SPLITS)}"
        )
    path = files("e2rl") / "assets" / "scenes" / f"{split}.npz"
    if not path.is_file():
        raise InputError(
            f"bundled scenes: {path} is missing; "
            "reinstall the package or restore the file from git"
        )
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != SHA256[split]:
        raise InputError(
            f"bundled scenes: {path} is damaged: not what comes with the package; "
            f"{MEND}"
        )
    return content


def unpack(split: str) -> dict[str, ndarray]:
    """Returns the arrays of a split's archive; raises InputError where they are damaged
    or of another format."""
    try:
        arrays = read_arrays(io.BytesIO(asset_bytes(split)))
        if str(arrays.get("format")) != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
    except ValueError as error:
        raise InputError(
            f"bundled scenes {split}: damaged ({error}); {MEND}"
        ) from error
    return arrays


def _split(values: ndarray, counts: ndarray) -> list[ndarray]:
    return np.split(values, np.cumsum(counts)[:-1]) if len(counts) else []


def read_maps(arrays: dict[str, ndarray]) -> list[SceneMap]:
    """Returns the maps of an archive; what is parked there is among the tracks of
    recordings."""
    ids = [str(name) for name in arrays["lane_id"]]
    lines = _split(arrays["lane_points"] * MILLI, arrays["lane_counts"])
    widths = (arrays["lane_width"] * MILLI).tolist()
    limits = (arrays["lane_speed"] * MILLI).tolist()
    lanes = list(
        map(
            Lane,
            lines,
            widths,
            limits,
        )
    )
    for side in ("exits", "left", "right"):
        for lane, other in arrays[side]:
            getattr(lanes[lane], side).append(ids[other])
    polygons = _split(arrays["polygon_points"] * MILLI, arrays["polygon_counts"])
    parts = {
        key: _split(np.arange(arrays[f"map_{key}"].sum()), arrays[f"map_{key}"])
        for key in ("lanes", "polygons", "lights")
    }
    lamps = [ids[lane] for lane in arrays["light_lane"]]
    return [
        SceneMap(
            name=str(name),
            lanes={ids[k]: lanes[k] for k in parts["lanes"][index]},
            drivable=[polygons[k] for k in parts["polygons"][index]],
            lights={
                lamps[k]: arrays["light_states"][k] for k in parts["lights"][index]
            },
        )
        for index, name in enumerate(arrays["map_name"])
    ]


def read_recordings(arrays: dict[str, ndarray]) -> list[Recording]:
    """Returns the recordings of an archive."""
    maps = read_maps(arrays)
    states = np.cumsum(np.cumsum(arrays["states"], axis=1), axis=1) * UNIT
    states[..., 2] = wrap(states[..., 2])
    states[~arrays["valid"]] = 0.0
    size = arrays["size"] * MILLI
    ends = np.cumsum(arrays["scene_agents"])
    recordings = []
    for scene, end in enumerate(ends):
        rows = slice(end - arrays["scene_agents"][scene], end)
        recording = maps[arrays["scene_map"][scene]].recording(
            str(arrays["scene_id"][scene]),
            first=arrays["scene_first"][scene],
            states=states[rows].swapaxes(0, 1),
            valid=arrays["valid"][rows].T,
            size=size[rows],
            ego=int(arrays["scene_ego"][scene]),
        )
        recordings.append(recording)
    return recordings


@lru_cache(maxsize=1)
def _recordings_by_id(split: str) -> dict[str, Recording]:
    return {
        recording.scene_id: recording for recording in read_recordings(unpack(split))
    }
