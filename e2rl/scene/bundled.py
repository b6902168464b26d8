"""The scenes that come with the package: synthetic traffic on synthetic maps, one archive of maps and scenes per split.

Format e2rl-scenes/1 (npz, readable without pickle): positions in mm, headings in 1e-4 rad and speeds in mm/s as int32;
states as second differences over time, which compress well; ragged parts one after another, with counts.
"""

import io
import zipfile
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files

import numpy as np

from e2rl.errors import InputError
from e2rl.scene.recording import VEHICLE, Lane, Recording

SPLITS = ("train", "tune", "test")
FORMAT = "e2rl-scenes/1"
FRAMES, CURRENT = 111, 10
MILLI = 1e-3
UNIT = np.array([MILLI, MILLI, 1e-4, MILLI])  # m, m, rad, m/s per stored step of x, y, heading, speed


@dataclass
class SceneMap:
    """One place: lanes, drivable polygons, lights lane id -> [T] states over its whole simulation at 10 Hz, and the
    cars parked there: poses [Q, 3], sizes [Q, 2]."""

    name: str
    lanes: dict[str, Lane]
    drivable: list[np.ndarray]
    lights: dict[str, np.ndarray]
    parked: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    parked_size: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


def _quantise(values: np.ndarray, unit) -> np.ndarray:
    return np.round(np.asarray(values, float) / unit).astype(np.int32)


def _counts(parts) -> np.ndarray:
    return np.array([len(part) for part in parts], np.int32)


def _join(parts, shape: tuple[int, ...]) -> np.ndarray:
    return np.concatenate([*parts, np.zeros((0, *shape))])


def pack(maps: list[SceneMap], scenes: list[tuple[Recording, int]]) -> dict[str, np.ndarray]:
    """Arrays of an archive from maps and (recording, first frame on its map's light programme) on them."""
    lanes = [(place.name, name, lane) for place in maps for name, lane in place.lanes.items()]
    number = {(place, name): index for index, (place, name, _) in enumerate(lanes)}
    pairs = {
        kind: np.array(
            [(number[p, n], number[p, other]) for p, n, lane in lanes for other in getattr(lane, kind)], np.int32
        ).reshape(-1, 2)
        for kind in ("exits", "left", "right")
    }
    polygons = [ring for place in maps for ring in place.drivable]
    lights = [(number[place.name, name], state) for place in maps for name, state in place.lights.items()]
    states = [np.moveaxis(_steady(rec), 0, 1) for rec, _ in scenes]
    return {
        "format": np.array(FORMAT),
        "map_name": np.array([place.name for place in maps]),
        "map_lanes": _counts([place.lanes for place in maps]),
        "map_polygons": _counts([place.drivable for place in maps]),
        "map_lights": _counts([place.lights for place in maps]),
        "map_parked": _counts([place.parked for place in maps]),
        "lane_id": np.array([name for _, name, _ in lanes]),
        "lane_counts": _counts([row[2].points for row in lanes]),
        "lane_points": _quantise(_join([row[2].points for row in lanes], (2,)), MILLI),
        "lane_width": _quantise([row[2].width for row in lanes], MILLI),
        "lane_speed": _quantise([row[2].speed_limit for row in lanes], MILLI),
        **pairs,
        "polygon_counts": _counts(polygons),
        "polygon_points": _quantise(_join(polygons, (2,)), MILLI),
        "light_lane": np.array([row[0] for row in lights], np.int32),
        "light_states": np.array([row[1] for row in lights], np.int8),
        "parked": _quantise(_join([place.parked for place in maps], (3,)), UNIT[:3]),
        "parked_size": _quantise(_join([place.parked_size for place in maps], (2,)), MILLI),
        "scene_id": np.array([rec.scene_id for rec, _ in scenes]),
        "scene_map": np.array([[p.name for p in maps].index(rec.location) for rec, _ in scenes], np.int32),
        "scene_first": np.array([first for _, first in scenes], np.int32),
        "scene_ego": np.array([rec.ego for rec, _ in scenes], np.int32),
        "scene_agents": _counts(states),
        "states": np.concatenate([_second_difference(_quantise(part, UNIT)) for part in states]),
        "valid": np.concatenate([rec.valid.T for rec, _ in scenes]),
        "size": _quantise(np.concatenate([rec.size for rec, _ in scenes]), MILLI),
    }


def _steady(recording: Recording) -> np.ndarray:
    """States with unwrapped headings; frames outside a track repeat a valid one of it, which costs no space."""
    frames, agents = recording.valid.shape
    index = np.where(recording.valid, np.arange(frames)[:, None], -1)
    last = np.maximum.accumulate(index, 0)
    first = recording.valid.argmax(0)
    states = recording.states[np.where(last < 0, first, last), np.arange(agents)]
    states[..., 2] = np.unwrap(states[..., 2], axis=0)
    return states


def _second_difference(values: np.ndarray) -> np.ndarray:
    """Inverse of summing twice along axis 1."""
    zero = np.zeros_like(values[:, :1])
    return np.diff(np.diff(values, axis=1, prepend=zero), axis=1, prepend=zero)


def asset_bytes(split: str) -> bytes:
    """The archive of a split; raises InputError where the split is unknown or its file is missing."""
    if split not in SPLITS:
        raise InputError(f"split {split!r} of the bundled scenes: expected one of {', '.join(SPLITS)}")
    path = files("e2rl") / "assets" / "scenes" / f"{split}.npz"
    if not path.is_file():
        raise InputError(f"bundled scenes: {path} is missing; reinstall the package or restore the file from git")
    return path.read_bytes()


def unpack(content: bytes, name: str) -> dict[str, np.ndarray]:
    """Arrays of an archive's bytes; raises InputError where they are damaged or of another format."""
    mend = "restore the file from git, or write it again with tools/generate_scenes.py"
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"bundled scenes {name}: damaged ({error}); {mend}") from error
    if str(arrays.get("format")) != FORMAT:
        raise InputError(f"bundled scenes {name}: format {arrays.get('format')}, expected {FORMAT}; {mend}")
    return arrays


def _split(values: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
    return np.split(values, np.cumsum(counts)[:-1]) if len(counts) else []


def read_maps(arrays: dict[str, np.ndarray]) -> list[SceneMap]:
    """The maps of an archive."""
    ids = [str(name) for name in arrays["lane_id"]]
    lanes = [
        Lane(points * MILLI, float(width * MILLI), float(speed * MILLI))
        for points, width, speed in zip(
            _split(arrays["lane_points"], arrays["lane_counts"]),
            arrays["lane_width"],
            arrays["lane_speed"],
            strict=True,
        )
    ]
    for kind in ("exits", "left", "right"):
        for a, b in arrays[kind]:
            getattr(lanes[a], kind).append(ids[b])
    polygons = [ring * MILLI for ring in _split(arrays["polygon_points"], arrays["polygon_counts"])]
    own = {
        key: _split(np.arange(arrays[f"map_{key}"].sum()), arrays[f"map_{key}"])
        for key in ("lanes", "polygons", "lights", "parked")
    }
    return [
        SceneMap(
            str(name),
            {ids[k]: lanes[k] for k in own["lanes"][m]},
            [polygons[k] for k in own["polygons"][m]],
            {ids[arrays["light_lane"][k]]: arrays["light_states"][k] for k in own["lights"][m]},
            arrays["parked"][own["parked"][m]] * UNIT[:3],
            arrays["parked_size"][own["parked"][m]] * MILLI,
        )
        for m, name in enumerate(arrays["map_name"])
    ]


def read_recordings(arrays: dict[str, np.ndarray], name: str) -> list[Recording]:
    """The validated recordings of an archive; raises InputError where they do not fit together."""
    try:
        maps = read_maps(arrays)
        agents = arrays["scene_agents"]
        states = np.cumsum(np.cumsum(arrays["states"], axis=1), axis=1) * UNIT
        states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
        rows = zip(
            arrays["scene_id"],
            arrays["scene_map"],
            arrays["scene_first"],
            arrays["scene_ego"],
            _split(states, agents),
            _split(arrays["valid"], agents),
            _split(arrays["size"] * MILLI, agents),
            strict=True,
        )
        return [_recording(maps[place], *row).validate() for row in rows for place in [row[1]]]
    except (KeyError, IndexError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"bundled scenes {name}: arrays do not fit together ({error!r}); restore the file from git, "
            "or write it again with tools/generate_scenes.py"
        ) from error


def _recording(place: SceneMap, scene_id, _, first, ego, states, valid, size) -> Recording:
    states = np.where(valid.T[..., None], np.moveaxis(states, 0, 1), 0.0)
    lights = {lane: state[first : first + FRAMES] for lane, state in place.lights.items()}
    return Recording(
        str(scene_id),
        place.name,
        "bundled",
        states,
        valid.T,
        size,
        np.full(len(size), VEHICLE),
        int(ego),
        place.lanes,
        place.drivable,
        lights,
        CURRENT,
    )


@lru_cache(maxsize=3)
def load_maps(split: str) -> list[SceneMap]:
    """The maps of a split, read once."""
    return read_maps(unpack(asset_bytes(split), split))


def load_recordings(split: str) -> list[Recording]:
    """The bundled recordings of split train, tune or test. Raises InputError for a missing or damaged asset."""
    return read_recordings(unpack(asset_bytes(split), split), split)
