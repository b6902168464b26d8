"""Source of ScenarioNet logs: ScenarioDescription pickles, which public converters make of Waymo, nuScenes, nuPlan,
Argoverse 2 and Lyft. They are read without ever executing what a file names."""

import csv
import io
import json
import lzma
import pickle
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.errors import InputError
from e2rl.scene.recording import AGENT_TYPES, DT, LIGHT_GREEN, LIGHT_RED, LIGHT_UNKNOWN, LIGHT_YELLOW, Lane, Recording
from e2rl.scene.smoothing import resample_uniform
from e2rl.scene.source import Source, hash_files

TYPES = {name.upper(): index for index, name in enumerate(AGENT_TYPES)}
LIGHTS = {  # by the last word of LANE_STATE_... (Waymo) or TRAFFIC_LIGHT_... (nuPlan)
    **dict.fromkeys(("GO", "GREEN"), LIGHT_GREEN),
    **dict.fromkeys(("CAUTION", "YELLOW"), LIGHT_YELLOW),
    **dict.fromkeys(("STOP", "RED"), LIGHT_RED),
}
INDEXES = ("dataset_summary.pkl", "dataset_mapping.pkl")  # pickles beside the scenarios that are none
BUILTINS = {"set", "frozenset", "list", "dict", "tuple", "int", "float", "bool", "str", "bytes", "bytearray", "complex"}
NUMPY = {  # what arrays and numbers of numpy 1 (numpy.core) and 2 (numpy._core) name
    "numpy": {"ndarray", "dtype"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}


@dataclass
class ScenarioNetSource(Source):
    """The ScenarioDescription pickles (*.pkl) in a folder or zip."""

    holds = "ScenarioDescription pickles"

    def logs(self) -> list[str]:
        root = self.root()
        if root.is_dir():
            names = [str(file.relative_to(root)) for file in sorted(root.rglob("*.pkl"))]
        elif zipfile.is_zipfile(root):
            with zipfile.ZipFile(root) as archive:
                names = [name for name in sorted(archive.namelist()) if name.endswith(".pkl")]
        else:
            raise InputError(f"data.path={root}: neither a folder nor a zip file")
        names = [name for name in names if Path(name).name not in INDEXES]
        if not names:
            raise InputError(f"data.path={root}: holds no .pkl scenario; convert the logs with ScenarioNet first")
        return names

    def read(self, log: str) -> Iterator[Recording]:
        yield read_recording(self.content(log), log, self.locations.get(Path(log).stem, ""))

    def fingerprint(self) -> bytes:
        root = self.root()
        files = [root] if root.is_file() else [root / log for log in self.logs()]
        return hash_files(files) + json.dumps(sorted(self.locations.items())).encode()

    def content(self, log: str) -> bytes:
        """The bytes of one pickle; raises InputError where they cannot be read."""
        root = self.root()
        try:
            if root.is_dir():
                return (root / log).read_bytes()
            with zipfile.ZipFile(root) as archive:
                return archive.read(log)
        except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as error:
            raise InputError(f"{log} in {root}: cannot be read: {error}; copy or export it again") from error

    @cached_property
    def locations(self) -> dict[str, str]:
        """Location by a log's name without ending, from `index.csv` (columns file, location_group) beside `path`."""
        index = self.root().parent / "index.csv"
        if not index.exists():
            return {}
        with index.open(newline="") as stream:
            rows = [row for row in csv.DictReader(stream) if {"file", "location_group"} <= set(row)]
        return {Path(row["file"]).stem: row["location_group"] for row in rows}


class _Unpickler(pickle.Unpickler):
    """Admits numpy arrays, plain builtins and defaultdict; anything else is refused by name, before it is run."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "builtins" and name in BUILTINS:
            return super().find_class(module, name)
        if (module, name) == ("collections", "defaultdict"):
            return defaultdict
        array_module = module.replace("numpy.core.", "numpy._core.")
        if name in NUMPY.get(array_module, ()):
            return super().find_class(array_module, name)
        raise pickle.UnpicklingError(f"names the forbidden class {module}.{name}")


def safe_load(content: bytes, name: str) -> dict:
    """The dict in a pickle; raises InputError naming the file where it is damaged or names a forbidden class."""
    try:
        data = _Unpickler(io.BytesIO(content)).load()
    except Exception as error:  # damaged bytes raise anything, from EOFError to MemoryError
        reason = str(error) or type(error).__name__
        mend = "only numpy arrays and plain containers are read, so export the scenario again"
        raise InputError(f"{name}: cannot be read: {reason}; {mend}") from error
    if not isinstance(data, dict):
        raise InputError(f"{name}: holds a {type(data).__name__}, expected a ScenarioDescription dict")
    return data


def read_recording(content: bytes, name: str, location: str = "") -> Recording:
    """The whole log in a pickle, at 10 Hz, with its own start frame if it names one; raises InputError naming it."""
    data = safe_load(content, name)
    try:
        return _recording(data, location)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        problem = f"{type(error).__name__} {error}; export the scenario again or leave it out"
        raise InputError(f"{name}: not a ScenarioDescription: {problem}") from error


def _recording(data: dict, location: str) -> Recording:
    metadata, tracks = data["metadata"], data["tracks"]
    keys, ego = [str(key) for key in tracks], metadata.get("sdc_id")
    if str(ego) not in keys:
        raise InputError(f"no ego: metadata.sdc_id={ego!r} is none of its {len(tracks)} tracks; leave it out")
    states, valid, size = _tracks(tracks)
    frames = len(states)
    ts = np.asarray(metadata.get("ts", np.arange(frames) * DT), float)
    if len(ts) != frames:
        raise InputError(f"{len(ts)} time stamps for {frames} frames; repair metadata.ts")
    states, valid = resample_uniform(states, valid, ts)
    seconds, current = ts - ts[0], metadata.get("current_time_index")
    lanes, drivable = _map(data["map_features"])
    return Recording(
        scene_id=str(data.get("id") or metadata.get("scenario_id")),
        location=location or str(metadata.get("map", "")),
        dataset=str(metadata.get("dataset", "scenarionet")),
        states=states,
        valid=valid,
        size=size,
        agent_type=np.array([TYPES.get(track["type"], TYPES["OTHER"]) for track in tracks.values()]),
        ego=keys.index(str(ego)),
        lanes=lanes,
        drivable=drivable,
        lights=_lights(data.get("dynamic_map_states", {}), lanes, seconds, len(states)),
        current=None if current is None else int(round(seconds[int(current)] / DT)),
    )


def _tracks(tracks: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States [F, A, 4], valid [F, A] and size [A, 2] of tracks; raises InputError where a valid state is not finite."""
    frames = len(next(iter(tracks.values()))["state"]["position"])
    states, valid = np.zeros((frames, len(tracks), 4)), np.zeros((frames, len(tracks)), bool)
    size = np.ones((len(tracks), 2))
    for index, (key, track) in enumerate(tracks.items()):
        state = track["state"]
        known = np.asarray(state["valid"]).astype(bool).reshape(-1)
        states[:, index, :2], states[:, index, 2] = np.asarray(state["position"])[:, :2], state["heading"]
        states[:, index, 3] = np.linalg.norm(np.asarray(state["velocity"])[:, :2], axis=1)
        valid[:, index] = known
        bad = known & ~np.isfinite(states[:, index]).all(-1)
        if bad.any():
            raise InputError(f"track {key} is NaN or infinite at frame {bad.argmax()}, where it is marked valid")
        if known.any():
            size[index] = [np.median(np.asarray(state[key]).reshape(-1)[known]) for key in ("length", "width")]
        if track["type"] == "VEHICLE":  # some logs swap length and width
            size[index] = sorted(size[index], reverse=True)
    states[~valid] = 0.0
    return states, valid, size


def _map(features: dict) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the drivable polygons that belong to them."""
    lanes, drivable = {}, []
    for key, feature in features.items():
        kind = str(feature["type"])
        if not kind.startswith("LANE_") or "BIKE" in kind or len(feature.get("polyline", ())) < 2:
            continue
        line = np.asarray(feature["polyline"], float)
        width = np.asarray(feature.get("width", ()), float)
        lanes[str(key)] = Lane(
            points=line[:, :2],
            width=float(np.median(width.sum(-1))) if width.ndim == 2 and len(width) else 0.0,
            speed_limit=float(feature.get("speed_limit_kmh") or 0.0) / 3.6,
            exits=[str(other) for other in feature.get("exit_lanes", ())],
            left=_ids(feature.get("left_neighbor", ())),
            right=_ids(feature.get("right_neighbor", ())),
            heights=line[:, 2] if line.shape[1] > 2 and "polygon" not in feature else None,
        )
        if len(feature.get("polygon", ())) >= 3:
            drivable.append(np.asarray(feature["polygon"], float)[:, :2])
    return lanes, drivable


def _ids(items: Iterable) -> list[str]:
    return [str(item["feature_id"] if isinstance(item, dict) else item) for item in items]


def _lights(dynamic: dict, lanes: dict[str, Lane], seconds: np.ndarray, frames: int) -> dict[str, np.ndarray]:
    """Light states [frames] at 10 Hz by the lane they control, from states stamped `seconds`; where a state is unknown,
    the last known one goes on."""
    now = np.searchsorted(seconds, np.arange(frames) * DT + DT / 2) - 1
    lights = {}
    for key, light in dynamic.items():
        lane = str(light.get("lane", key))
        if lane not in lanes:
            continue
        states, last = np.zeros(len(seconds), np.int8), LIGHT_UNKNOWN
        given = list(light["state"].get("object_state", ()))[: len(seconds)]
        for frame, state in enumerate(given):
            last = states[frame] = LIGHTS.get(str(state).rsplit("_", 1)[-1], last)
        states[len(given) :] = last
        lights[lane] = states[now]
    return lights
