"""Source `scenarionet`: a folder or zip of ScenarioDescription pickles (Waymo, nuScenes, nuPlan, Argoverse 2, Lyft
through their public converters), read without ever executing what a file names."""

import csv
import io
import lzma
import pickle
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from e2rl.errors import InputError
from e2rl.scene.recording import (
    CYCLIST,
    DT,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
)
from e2rl.scene.smoothing import resample_uniform

TYPES = {"VEHICLE": VEHICLE, "PEDESTRIAN": PEDESTRIAN, "CYCLIST": CYCLIST}
LIGHTS = {  # by the last word of LANE_STATE_... (Waymo) or TRAFFIC_LIGHT_... (nuPlan)
    "GO": LIGHT_GREEN,
    "CAUTION": LIGHT_YELLOW,
    "STOP": LIGHT_RED,
    "GREEN": LIGHT_GREEN,
    "YELLOW": LIGHT_YELLOW,
    "RED": LIGHT_RED,
}
BUILTINS = {"set", "frozenset", "list", "dict", "tuple", "int", "float", "bool", "str", "bytes", "bytearray", "complex"}
NUMPY = {  # what arrays and numbers of numpy 1 (numpy.core) and 2 (numpy._core) name
    "numpy": {"ndarray", "dtype"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}


class _Unpickler(pickle.Unpickler):
    """Admits numpy arrays, plain builtins and defaultdict; anything else is refused by name, before it is run."""

    def find_class(self, module: str, name: str):
        if module == "builtins" and name in BUILTINS:
            return super().find_class(module, name)
        if (module, name) == ("collections", "defaultdict"):
            return defaultdict
        array_module = module.replace("numpy.core.", "numpy._core.")
        if name in NUMPY.get(array_module, ()):
            return super().find_class(array_module, name)
        raise pickle.UnpicklingError(f"names the forbidden class {module}.{name}")


def safe_load(stream, name: str) -> dict:
    """The dict in a pickle stream; InputError naming the file where it is damaged or names a forbidden class."""
    try:
        content = _Unpickler(stream).load()
    except Exception as error:  # damaged bytes raise anything, from EOFError to MemoryError
        raise InputError(
            f"{name}: cannot be read: {str(error) or type(error).__name__}; only numpy arrays and plain "
            "containers are read, so export the scenario again"
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{name}: holds a {type(content).__name__}, expected a ScenarioDescription dict")
    return content


def list_files(path: str) -> list[tuple[str, str]]:
    """(container, member) of every scenario pickle under a folder or in a zip, sorted by name.

    InputError where the path is missing, is no folder or zip, or holds no scenario.
    """
    root = Path(path)
    if not root.exists():
        raise InputError(f"data.path={path}: no such file or folder; pass one that holds ScenarioDescription pickles")
    if root.is_dir():
        files = [(str(root), str(p.relative_to(root))) for p in sorted(root.rglob("*.pkl"))]
    elif zipfile.is_zipfile(root):
        with zipfile.ZipFile(root) as archive:
            files = [(str(root), name) for name in sorted(archive.namelist()) if name.endswith(".pkl")]
    else:
        raise InputError(f"data.path={path}: neither a folder nor a zip file")
    files = [
        (root, name) for root, name in files if Path(name).name not in ("dataset_summary.pkl", "dataset_mapping.pkl")
    ]
    if not files:
        raise InputError(f"data.path={path}: holds no .pkl scenario; convert the logs with ScenarioNet first")
    return files


def read_bytes(container: str, member: str) -> bytes:
    """The content of one member of a folder or zip; InputError naming it where it cannot be read."""
    try:
        if Path(container).is_dir():
            return (Path(container) / member).read_bytes()
        with zipfile.ZipFile(container) as archive:
            return archive.read(member)
    except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as error:
        raise InputError(f"{member} in {container}: cannot be read: {error}; copy or export it again") from error


def read_locations(path: str) -> dict[str, str]:
    """Scene file stem -> place, from an `index.csv` (columns `file`, `location_group`) beside the data, if any."""
    index = Path(path).parent / "index.csv"
    if not index.exists():
        return {}
    with index.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    if not rows or not {"file", "location_group"} <= set(rows[0]):
        return {}
    return {Path(row["file"]).stem: row["location_group"] for row in rows}


def read_recordings(
    content: bytes, name: str, location: str, starts: list[int] | None, window: int
) -> Iterator[Recording]:
    """The recordings in one scenario file: one at its current frame, or, for `starts` or a log without a current frame,
    one for each start frame that leaves half a window of future.

    content: the pickle; window: simulated steps. Raises InputError naming the file.
    """
    data = safe_load(io.BytesIO(content), name)
    try:
        recording, given = _parse(data, name, location)
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(name) else f"{name}: {error}") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{name}: not a ScenarioDescription: {type(error).__name__} {error}; export the scenario "
            "again or leave it out"
        ) from error
    frames = len(recording.states)
    if starts is None:
        starts = [given] if given is not None else list(range(10, frames - window, window + 11)) or [10]
        names = [recording.scene_id] if len(starts) == 1 else [f"{recording.scene_id}@{s}" for s in starts]
    else:
        starts = [s for s in starts if s <= frames - window // 2]
        names = [f"{recording.scene_id}@{s}" for s in starts]
    for start, scene_id in zip(starts, names, strict=True):
        yield Recording(**{**vars(recording), "current": start, "scene_id": scene_id})


def _parse(data: dict, name: str, location: str) -> tuple[Recording, int | None]:
    """The whole log at 10 Hz and its own start frame, if it names one."""
    metadata = data["metadata"]
    tracks, sdc = list(data["tracks"].items()), metadata.get("sdc_id")
    keys = [str(key) for key, _ in tracks]
    if not tracks or str(sdc) not in keys:
        raise InputError(f"{name}: no ego: metadata.sdc_id={sdc!r} is none of its {len(tracks)} tracks; leave it out")
    frames = len(tracks[0][1]["state"]["position"])
    states, valid, size = np.zeros((frames, len(tracks), 4)), np.zeros((frames, len(tracks)), bool), []
    for index, (_, track) in enumerate(tracks):
        state = track["state"]
        known = np.asarray(state["valid"]).astype(bool).reshape(-1)
        states[:, index, :2], states[:, index, 2] = np.asarray(state["position"])[:, :2], state["heading"]
        states[:, index, 3] = np.linalg.norm(np.asarray(state["velocity"])[:, :2], axis=1)
        valid[:, index] = known
        box = [
            np.median(np.asarray(state[key]).reshape(-1)[known]) if known.any() else 1.0 for key in ("length", "width")
        ]
        size.append(sorted(box, reverse=True) if track["type"] == "VEHICLE" else box)
    bad = valid & ~np.isfinite(states).all(-1)
    if bad.any():
        frame, agent = np.argwhere(bad)[0]
        raise InputError(f"{name}: track {keys[agent]} is NaN or infinite at frame {frame}, where it is marked valid")
    states[~valid] = 0.0
    ts = np.asarray(metadata.get("ts", np.arange(frames) * DT), float)
    if len(ts) != frames:
        raise InputError(f"{name}: {len(ts)} time stamps for {frames} frames; repair metadata.ts")
    states, valid = resample_uniform(states, valid, ts)
    seconds = ts - ts[0]
    given = metadata.get("current_time_index")
    lanes, drivable = _map(data["map_features"])
    recording = Recording(
        scene_id=str(data.get("id") or metadata.get("scenario_id")),
        location=location or str(metadata.get("map", "")),
        dataset=str(metadata.get("dataset", "scenarionet")),
        states=states,
        valid=valid,
        size=np.array(size),
        agent_type=np.array([TYPES.get(track["type"], OTHER) for _, track in tracks]),
        ego=keys.index(str(sdc)),
        lanes=lanes,
        drivable=drivable,
        lights=_lights(data.get("dynamic_map_states", {}), lanes, seconds, len(states)),
    )
    return recording, None if given is None else int(round(seconds[int(given)] / DT))


def _map(features: dict) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the drivable polygons that belong to them."""
    lanes, drivable = {}, []
    for key, feature in features.items():
        kind = str(feature["type"])
        if not kind.startswith("LANE_") or "BIKE" in kind or len(feature.get("polyline", ())) < 2:
            continue
        line = np.asarray(feature["polyline"], float)
        width = np.asarray(feature.get("width", ()), float)
        ids = {
            side: [
                str(item["feature_id"] if isinstance(item, dict) else item)
                for item in feature.get(f"{side}_neighbor", ())
            ]
            for side in ("left", "right")
        }
        heights = line[:, 2] if line.shape[1] > 2 and "polygon" not in feature else None
        lanes[str(key)] = Lane(
            points=line[:, :2],
            width=float(np.median(width.sum(-1))) if width.ndim == 2 and len(width) else 0.0,
            speed_limit=float(feature.get("speed_limit_kmh") or 0.0) / 3.6,
            exits=[str(other) for other in feature.get("exit_lanes", ())],
            heights=heights,
            **ids,
        )
        if "polygon" in feature and len(feature["polygon"]) >= 3:
            drivable.append(np.asarray(feature["polygon"], float)[:, :2])
    return lanes, drivable


def _lights(dynamic: dict, lanes: dict[str, Lane], seconds: np.ndarray, frames: int) -> dict[str, np.ndarray]:
    """Light states [frames] at 10 Hz by the lane they control, from states stamped `seconds`; what is unknown keeps the
    last known state."""
    now = np.searchsorted(seconds, np.arange(frames) * DT + DT / 2) - 1
    lights = {}
    for key, light in dynamic.items():
        lane = str(light.get("lane", key))
        if lane not in lanes:
            continue
        states, last = np.zeros(len(seconds), np.int8), LIGHT_UNKNOWN
        given = list(light["state"].get("object_state", ()))
        for frame in range(len(seconds)):
            last = LIGHTS.get(str(given[frame]).rsplit("_", 1)[-1], last) if frame < len(given) else last
            states[frame] = last
        lights[lane] = states[now]
    return lights
