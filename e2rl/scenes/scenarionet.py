"""Source of ScenarioNet logs: ScenarioDescription pickles, which public converters make
of Waymo, nuScenes, nuPlan, Argoverse 2 and Lyft. They are read without ever executing
what a file names.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import read_regular
from e2rl.scenes.log_files import MAX_BYTES, LogFiles
from e2rl.scenes.paths import tangent_angle, wrap
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
from e2rl.scenes.smoothing import (
    latest_frames,
    resample_heights,
    resample_uniform,
    signed_speed,
)

TYPES = {name.upper(): index for index, name in enumerate(AGENT_TYPES)}
OBSTACLES = (
    "UNSET",
    "TRAFFIC_CONE",
    "TRAFFIC_BARRIER",
    "TRAFFIC_OBJECT",
    "TRAFFIC_LIGHT",
    "BUILDING",
    "GROUND",
)
LIMIT_UNITS = {
    "speed_limit_kmh": 1 / 3.6,
    "speed_limit_mps": 1.0,
    "speed_limit_mph": 0.44704,
}  # key: m/s
TYPES |= dict.fromkeys(OBSTACLES, TYPES["OTHER"])  # MetaDrive's further names of tracks
SIZES = {  # m: usual length and width by a track's type, for those that say none
    "VEHICLE": (4.6, 1.9),
    "PEDESTRIAN": (0.7, 0.7),
    "CYCLIST": (1.8, 0.7),
    "TRAFFIC_CONE": (0.4, 0.4),
    "TRAFFIC_BARRIER": (2.0, 0.5),
}
SMALL = (0.7, 0.7)  # m: of every other type
IS_HEADING = 0.3  # rad at most from the lanes' directions at all their points: their third numbers are headings


@dataclass
class ScenarioNetSource(LogFiles):
    """The ScenarioDescription pickles (*.pkl) in a folder or zip."""

    holds = "ScenarioDescription pickles"
    ending = ".pkl"
    mend = "export the scenario again or leave it out"
    ignored = (
        "dataset_summary.pkl",
        "dataset_mapping.pkl",
    )  # pickles beside the scenarios that are none

    def read(self, log: str) -> Iterator[Recording]:
        yield recording_of(
            safe_load(self.content(log), log), self.locations.get(Path(log).stem, "")
        )

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
    keys = [str(key) for key in tracks]
    ego = metadata.get("sdc_id")
    if str(ego) not in keys:
        raise InputError(
            f"no ego: metadata.sdc_id={ego!r} is none of its {len(tracks)} tracks; leave it out"
        )
    if len(set(keys)) < len(keys):
        twice = next(key for key, count in Counter(keys).items() if count > 1)
        raise InputError(f"two of its tracks have the id {twice!r}; give each its own")
    states, valid, size, repairs = _tracks(tracks)
    frames = len(states)
    scene_id = _text(data.get("id") or metadata.get("scenario_id"))
    ts = np.asarray(metadata.get("ts", np.arange(frames) * DT), float)
    if len(ts) != frames:
        raise InputError(
            f"{len(ts)} time stamps for {frames} frames; repair metadata.ts"
        )
    check(
        {"states": (ts.max() - ts.min()) / DT * len(keys)}, scene_id
    )  # of the grid, whose size they give
    heights = resample_heights(_heights(tracks, valid), valid, ts=ts)
    states, valid = resample_uniform(states, valid, ts=ts)
    seconds = ts - ts[0]
    current = metadata.get("current_time_index")
    if current is not None and not (
        np.isreal(current) and 0 <= current < frames and current == int(current)
    ):
        raise InputError(
            f"current_time_index={current!r} is no frame of {frames}; repair it"
        )
    lanes, drivable = _map(data["map_features"])
    return Recording(
        scene_id=scene_id,
        location=location or _text(metadata.get("e2rl", {}).get("location", "")),
        dataset=_text(metadata.get("dataset", "scenarionet")),
        states=states,
        valid=valid,
        size=size,
        agent_type=np.array(
            [_type(key, track["type"]) for key, track in tracks.items()]
        ),
        ego=keys.index(str(ego)),
        lanes=lanes,
        drivable=drivable,
        lights=_lights(
            data.get("dynamic_map_states", {}),
            lanes,
            seconds=seconds,
            frames=len(states),
        ),
        current=None if current is None else int(round(seconds[int(current)] / DT)),
        repairs=repairs,
        heights=heights,
    )


def _text(value: object) -> str:
    """A name; "" for what is none."""
    return str(value) if isinstance(value, str | int | float) else ""


def _type(key: object, name: object) -> int:
    """The agent type that a track's type stands for; InputError for one that is not
    known."""
    if not isinstance(name, str) or name not in TYPES:
        raise InputError(
            f"track {key} is of the unknown type {str(name)[:40]!r}; known are {', '.join(TYPES)}"
        )
    return TYPES[name]


def _tracks(tracks: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray, Counter[str]]:
    """States [F, A, 4], valid [F, A], size [A, 2] and repairs of tracks.

    Raises InputError where a valid state is not finite.
    """
    frames = len(next(iter(tracks.values()))["state"]["position"])
    check({"states": frames * len(tracks)}, "of this log")
    states = np.zeros((frames, len(tracks), 4))
    valid = np.zeros((frames, len(tracks)), bool)
    size = np.ones((len(tracks), 2))
    repairs: Counter[str] = Counter()
    for index, (key, track) in enumerate(tracks.items()):
        state = track["state"]
        known = np.asarray(state["valid"]).astype(bool).reshape(-1)
        states[:, index, :2], states[:, index, 2] = (
            np.asarray(state["position"])[:, :2],
            state["heading"],
        )
        states[:, index, 3] = signed_speed(
            np.asarray(state["velocity"], float)[:, :2], states[:, index, 2]
        )
        valid[:, index] = known
        bad = known & ~np.isfinite(states[:, index]).all(-1)
        if bad.any():
            raise InputError(
                f"track {key} is NaN or infinite at frame {bad.argmax()}, where it is marked valid"
            )
        if known.any():
            recorded = _recorded_size(track, known)
            repairs["missing sizes, for which the usual one of the type is taken"] += (
                recorded is None
            )
            size[index] = (
                SIZES.get(track["type"], SMALL) if recorded is None else recorded
            )
        if track["type"] == "VEHICLE":  # some logs swap length and width
            size[index] = sorted(size[index], reverse=True)
    states[~valid] = 0.0
    return states, valid, size, +repairs


def _heights(tracks: dict, valid: np.ndarray) -> np.ndarray:
    """Heights [F, A] m of tracks that are valid [F, A]; NaN where they are unknown."""
    heights = np.full(valid.shape, np.nan)
    for index, track in enumerate(tracks.values()):
        position = np.asarray(track["state"]["position"], float)
        if position.shape[1] > 2:
            heights[:, index] = position[:, 2]
    return heights


def _recorded_size(track: dict, known: np.ndarray) -> list[float] | None:
    """Returns the median length and width [m] that a track says; None where it says
    none that is positive.

    Each comes from the first of these that has it: `length` and `width`, or the first
    two columns of `size`, of the state (a value, or one a frame) or of the metadata.

    Args:
        track: of a ScenarioDescription.
        known: [F] bool, the frames at which it is there.
    """
    size: list[float] = []
    for column, name in enumerate(("length", "width")):
        for part in (track["state"], track.get("metadata") or {}):
            both = np.atleast_2d(np.asarray(part.get("size"), float))[
                :, column : column + 1
            ]
            values = np.asarray(part.get(name, both), float).reshape(-1)
            values = values[known] if len(values) == len(known) else values
            values = values[np.isfinite(values) & (values > 0)]
            if len(values):
                size.append(_median(values))
                break
    return size if len(size) == 2 else None


def _are_headings(lines: list[np.ndarray]) -> bool:
    """Returns whether the third numbers of lanes [P, 3] are no heights but headings, as
    ScenarioNet's converter of nuScenes writes them."""
    numbers = np.concatenate([np.zeros(0), *(line[:, 2] for line in lines)])
    tangents = np.concatenate(
        [np.zeros(0), *(tangent_angle(line[:, :2]) for line in lines)]
    )
    return bool(numbers.any() and np.abs(wrap(numbers - tangents)).max() < IS_HEADING)


def _map(features: dict) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the drivable polygons that belong to them."""
    lanes = {}
    drivable = []
    for key, feature in features.items():
        kind = str(feature["type"])
        if (
            not kind.startswith("LANE_")
            or "BIKE" in kind
            or len(feature.get("polyline", ())) < 2
        ):
            continue
        line = np.array(feature["polyline"], float)
        width = np.asarray(feature.get("width", ()), float)
        lanes[str(key)] = Lane(
            points=line[:, :2],
            width=_median(width.sum(-1)) if width.ndim == 2 and len(width) else 0.0,
            speed_limit=_speed_limit(feature),
            exits=[str(other) for other in feature.get("exit_lanes", ())],
            left=_ids(feature.get("left_neighbor", ())),
            right=_ids(feature.get("right_neighbor", ())),
            heights=line[:, 2]
            if line.shape[1] > 2 and "polygon" not in feature
            else None,
        )
        if len(feature.get("polygon", ())) >= 3:
            drivable.append(np.array(feature["polygon"], float)[:, :2])
    lines = [
        np.column_stack([lane.points, lane.heights])
        for lane in lanes.values()
        if lane.heights is not None
    ]
    if _are_headings(lines):
        lanes = {name: replace(lane, heights=None) for name, lane in lanes.items()}
    return lanes, drivable


def _speed_limit(feature: dict) -> float:
    """The limit [m/s] of a lane in the first unit that tells one, 0 for none; of
    several, the lowest.

    Converters write numbers, texts and lists of either, and none for lanes whose limit
    they do not know.
    """
    for key, factor in LIMIT_UNITS.items():
        recorded = feature.get(key)
        numbers = [
            _number(value)
            for value in np.atleast_1d(np.asarray(recorded, object)).tolist()
        ]
        known = [value for value in numbers if 0 < value < np.inf]
        if known:
            return min(known) * factor
    return 0.0


def _number(value: object) -> float:
    """The number that a value is or that a text begins with, NaN for none."""
    words = str(value).split() or [""]
    try:
        return float(words[0])
    except ValueError:
        return float("nan")


def _median(values: np.ndarray) -> float:
    """`np.median` of values [n], n > 0, in a tenth of its time; NaN where one of them
    is."""
    ordered = np.sort(values)
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    return float("nan") if np.isnan(ordered[-1]) else float(middle)


def _ids(items: Iterable) -> list[str]:
    return [
        str(item["feature_id"] if isinstance(item, dict) else item) for item in items
    ]


def _lights(
    dynamic: dict, lanes: dict[str, Lane], seconds: np.ndarray, frames: int
) -> dict[str, np.ndarray]:
    """Light states [frames] at 10 Hz by the lane they control, from states stamped
    `seconds`; where a state is unknown, the last known one goes on."""
    now = latest_frames(seconds, frames)
    lights = {}
    for key, light in dynamic.items():
        lane = str(light.get("lane", key))
        if lane not in lanes:
            continue
        states = np.zeros(len(seconds), np.int8)
        last = LIGHT_UNKNOWN
        words = light["state"].get("object_state")
        words = [] if words is None else list(words)[: len(seconds)]
        for frame, word in enumerate(
            words
        ):  # LANE_STATE_... (Waymo) or TRAFFIC_LIGHT_... (nuPlan)
            last = states[frame] = light_colour(word, otherwise=last)
        states[len(words) :] = last
        lights[lane] = states[now]
    return lights
