"""Source of ScenarioNet logs: ScenarioDescription pickles, which public converters make
of Waymo, nuScenes, nuPlan, Argoverse 2 and Lyft. They are read without ever executing
what a file names.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import (
    Iterable,
    Iterator,
)
from dataclasses import (
    dataclass,
    replace,
)
from functools import cached_property
from pathlib import Path

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import read_regular
from e2rl.scenes.log_files import (
    MAX_BYTES,
    LogFiles,
    bounded_memory,
)
from e2rl.scenes.paths import (
    tangent_angle,
    wrap,
)
from e2rl.scenes.plain_pickle import load_plain
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    AGENT_TYPES,
    DT,
    LIGHT_UNKNOWN,
    Lane,
    Recording,
    light_colour,
)
from e2rl.scenes.resampling import (
    latest_frames,
    resample_uniform,
)
from e2rl.scenes.smoothing import signed_speed

TYPES = {name.upper(): index for index, name in enumerate(AGENT_TYPES)}
OBSTACLES = (
    "UNSET TRAFFIC_CONE TRAFFIC_BARRIER TRAFFIC_OBJECT TRAFFIC_LIGHT BUILDING GROUND"
)
LIMIT_UNITS = {  # key: m/s
    "speed_limit_kmh": 1 / 3.6,
    "speed_limit_mps": 1.0,
    "speed_limit_mph": 0.44704,
}
NO_SIZE = "missing sizes, for which the usual one of the type is taken"
TYPES |= dict.fromkeys(
    OBSTACLES.split(), TYPES["OTHER"]
)  # MetaDrive's further names of tracks
SIZES = {  # m: usual length and width by a track's type, for those that say none
    "VEHICLE": (4.6, 1.9),
    "PEDESTRIAN": (0.7, 0.7),
    "CYCLIST": (1.8, 0.7),
    "TRAFFIC_CONE": (0.4, 0.4),
    "TRAFFIC_BARRIER": (2.0, 0.5),
}
SMALL = (0.7, 0.7)  # m: of every other type
IS_HEADING = 0.3  # rad at most from the lanes' directions, where heights are headings


@dataclass
class ScenarioNetSource(LogFiles):
    """The ScenarioDescription pickles (*.pkl) in a folder or zip."""

    holds = "ScenarioDescription pickles"
    ending = ".pkl"
    mend = "export the scenario again or leave it out"
    ignored = ("dataset_summary.pkl", "dataset_mapping.pkl")  # lie beside scenarios

    def read(self, log: str) -> Iterator[Recording]:
        content = self.content(log)
        with bounded_memory():
            data = safe_load(content, log)
        yield recording_of(data, self.locations.get(Path(log).stem, ""))

    def fingerprint(self) -> bytes:
        return (
            super().fingerprint()
            + json.dumps(sorted(self.locations.items()) or "places unknown").encode()
        )

    @cached_property
    def locations(self) -> dict[str, str]:
        """The place of each log by its name without ending: `index.csv` (columns file,
        location_group) beside `path`.

        The name of a log's map is no place: it is a city's.
        """
        index = self.root().parent / "index.csv"
        if not index.is_file():
            return {}
        try:
            lines = io.StringIO(read_regular(index, MAX_BYTES).decode(), newline="")
            rows = [
                row
                for row in csv.DictReader(lines)
                if row.get("file") and row.get("location_group")
            ]
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(
                f"{index}: cannot be read: {error}; write it again, or remove it"
            ) from error
        return {Path(row["file"]).stem: row["location_group"] for row in rows}


def safe_load(content: bytes, name: str) -> dict:
    """Returns the dict in a pickle; raises InputError where it is damaged or holds more
    than plain data."""
    try:
        data = load_plain(content)
    except Exception as error:  # damaged bytes raise anything
        reason = str(error) or type(error).__name__
        mend = "only numpy arrays and plain containers are read, so export the scenario again"
        raise InputError(f"{name}: cannot be read: {reason}; {mend}") from error
    if not isinstance(data, dict):
        raise InputError(
            f"{name}: holds a {type(data).__name__}, expected a ScenarioDescription dict"
        )
    return data


def recording_of(data: dict, location: str = "") -> Recording:
    """Returns the whole log of a ScenarioDescription at 10 Hz, with its own start frame
    if it names one."""
    metadata = data["metadata"]
    tracks = data["tracks"]
    ids = [str(key) for key in tracks]
    ego = metadata.get("sdc_id")
    if str(ego) not in ids:
        raise InputError(
            f"no ego: metadata.sdc_id={ego!r} is none of its {len(tracks)} tracks; "
            "leave it out"
        )
    if len(set(ids)) < len(ids):
        twice = next(key for key, count in Counter(ids).items() if count > 1)
        raise InputError(f"two of its tracks have the id {twice!r}; give each its own")
    log = _Log(tracks)
    frames = len(log.states)
    scene_id = _text(data.get("id") or metadata.get("scenario_id"))
    ts = np.asarray(metadata.get("ts", np.arange(frames) * DT), float)
    if len(ts) != frames:
        raise InputError(
            f"{len(ts)} time stamps for {frames} frames; repair metadata.ts"
        )
    # of the grid, whose size they give
    check({"states": (ts.max() - ts.min()) / DT * len(ids)}, scene_id)
    states, valid, heights = resample_uniform(
        log.states,
        log.valid,
        ts,
        log.heights,
    )
    seconds = ts - ts[0]
    current = metadata.get("current_time_index")
    if current is not None:
        if not (
            np.isreal(current) and 0 <= current < frames and current == int(current)
        ):
            raise InputError(
                f"current_time_index={current!r} is no frame of {frames}; repair it"
            )
        current = int(round(seconds[int(current)] / DT))
    lanes, drivable = _map(data["map_features"])
    recording = Recording(
        scene_id=scene_id,
        location=location or _text(metadata.get("e2rl", {}).get("location", "")),
        dataset=_text(metadata.get("dataset", "scenarionet")),
        states=states,
        valid=valid,
        size=log.size,
        agent_type=log.agent_type,
        ego=ids.index(str(ego)),
        lanes=lanes,
        drivable=drivable,
        current=current,
        repairs=+log.repairs,
        heights=heights,
    )
    frames_of_grid = latest_frames(seconds, len(states))
    for key, light in data.get("dynamic_map_states", {}).items():
        lane = str(light.get("lane", key))
        if lane in lanes:
            recording.lights[lane] = _light_states(light, len(ts))[frames_of_grid]
    return recording


def _text(value: object) -> str:
    """A name; "" for what is none."""
    return str(value) if isinstance(value, str | int | float) else ""


class _Log:
    """The tracks of a ScenarioDescription at its own time stamps.

    states [F, A, 4], 0 where they are not valid [F, A]; heights [F, A] m, NaN unknown;
    size [A, 2] m; agent_type [A]; repairs.
    """

    def __init__(self, tracks: dict) -> None:
        """Raises InputError where a valid state is not finite, or a type not known."""
        frames = len(next(iter(tracks.values()))["state"]["position"])
        check({"states": frames * len(tracks)}, "of this log")
        self.states = np.zeros((frames, len(tracks), 4))
        self.valid = np.zeros((frames, len(tracks)), bool)
        self.heights = np.full((frames, len(tracks)), np.nan)
        self.size = np.ones((len(tracks), 2))
        self.agent_type = np.zeros(len(tracks), int)
        self.repairs: Counter[str] = Counter()
        for index, (key, track) in enumerate(tracks.items()):
            kind = track["type"]
            if not isinstance(kind, str) or kind not in TYPES:
                raise InputError(
                    f"track {key} is of the unknown type {str(kind)[:40]!r}; "
                    f"known are {', '.join(TYPES)}"
                )
            self.agent_type[index] = TYPES[kind]
            self._read(index, track)
            bad = ~np.isfinite(self.states[:, index]).all(-1) & self.valid[:, index]
            if bad.any():
                raise InputError(
                    f"track {key} is NaN or infinite at frame {bad.argmax()}, "
                    "where it is marked valid"
                )
        self.states[~self.valid] = 0.0

    def _read(self, index: int, track: dict) -> None:
        state = track["state"]
        position = np.asarray(state["position"], float)
        heading = np.asarray(state["heading"], float)
        velocity = np.asarray(state["velocity"], float)[:, :2]
        valid = np.asarray(state["valid"]).astype(bool).reshape(-1)
        self.states[:, index, :2] = position[:, :2]
        self.states[:, index, 2] = heading
        self.states[:, index, 3] = signed_speed(velocity, self.states[:, index, 2])
        self.valid[:, index] = valid
        if position.shape[1] > 2:
            self.heights[:, index] = position[:, 2]
        if valid.any():
            size = _recorded_size(track, valid)
            self.repairs[NO_SIZE] += size is None
            self.size[index] = size or SIZES.get(track["type"], SMALL)
        if track["type"] == "VEHICLE":  # some logs swap length and width
            self.size[index] = sorted(self.size[index], reverse=True)


def _recorded_size(track: dict, valid: np.ndarray) -> list[float] | None:
    """Returns the median length and width [m] that a track says; None where it says
    none that is positive.

    Each comes from the first of these that has it: `length` and `width`, or the first
    two columns of `size`, of the state (a value, or one a frame) or of the metadata.
    valid [F]: the frames at which the track is there.
    """
    size: list[float] = []
    for column, name in enumerate(("length", "width")):
        for part in (track["state"], track.get("metadata") or {}):
            pairs = np.atleast_2d(np.asarray(part.get("size"), float))
            pairs = pairs[:, column : column + 1]
            values = np.asarray(part.get(name, pairs), float).reshape(-1)
            values = values[valid] if len(values) == len(valid) else values
            values = values[np.isfinite(values) & (values > 0)]
            if len(values):
                size.append(float(np.median(values)))
                break
    return size if len(size) == 2 else None


def _map(features: dict) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the drivable polygons that belong to them."""
    lanes = {}
    drivable = []
    for key, feature in features.items():
        kind = str(feature["type"])
        polyline = feature.get("polyline", ())
        if not kind.startswith("LANE_") or "BIKE" in kind or len(polyline) < 2:
            continue
        line = np.array(polyline, float)
        width = np.asarray(feature.get("width", ()), float)
        has_width = width.ndim == 2 and len(width)
        has_heights = line.shape[1] > 2 and "polygon" not in feature
        lanes[str(key)] = Lane(
            points=line[:, :2],
            width=float(np.median(width.sum(-1))) if has_width else 0.0,
            speed_limit=_speed_limit(feature),
            exits=[str(other) for other in feature.get("exit_lanes", ())],
            left=_ids(feature.get("left_neighbor", ())),
            right=_ids(feature.get("right_neighbor", ())),
            heights=line[:, 2] if has_heights else None,
        )
        if len(feature.get("polygon", ())) >= 3:
            drivable.append(np.array(feature["polygon"], float)[:, :2])
    if _are_headings(lanes.values()):
        lanes = {name: replace(lane, heights=None) for name, lane in lanes.items()}
    return lanes, drivable


def _are_headings(lanes: Iterable[Lane]) -> bool:
    """Returns whether the heights of lanes are none but headings, as ScenarioNet's
    converter of nuScenes writes them."""
    lifted = [lane for lane in lanes if lane.heights is not None]
    if not lifted:
        return False
    numbers = np.concatenate([lane.heights for lane in lifted])
    tangents = np.concatenate([tangent_angle(lane.points) for lane in lifted])
    return bool(numbers.any() and np.abs(wrap(numbers - tangents)).max() < IS_HEADING)


def _speed_limit(feature: dict) -> float:
    """The limit [m/s] of a lane in the first unit that tells one, 0 for none; of
    several, the lowest.

    Converters write numbers, texts and lists of either, and none for lanes whose limit
    they do not know.
    """
    for key, factor in LIMIT_UNITS.items():
        values = np.atleast_1d(np.asarray(feature.get(key), object)).tolist()
        limits = [limit for limit in map(_number, values) if 0 < limit < np.inf]
        if limits:
            return min(limits) * factor
    return 0.0


def _number(value: object) -> float:
    """The number that a value is or that a text begins with, NaN for none."""
    words = str(value).split() or [""]
    try:
        return float(words[0])
    except ValueError:
        return float("nan")


def _ids(items: Iterable) -> list[str]:
    return [
        str(item["feature_id"] if isinstance(item, dict) else item) for item in items
    ]


def _light_states(light: dict, frames: int) -> np.ndarray:
    """States [frames] of a light, named LANE_STATE_... (Waymo) or TRAFFIC_LIGHT_...
    (nuPlan); where one is unknown, the last known one goes on."""
    words = light["state"].get("object_state")
    words = [] if words is None else list(words)
    states = np.zeros(frames, np.int8)
    colour = LIGHT_UNKNOWN
    for frame in range(frames):
        if frame < len(words):
            colour = light_colour(words[frame], otherwise=colour)
        states[frame] = colour
    return states
