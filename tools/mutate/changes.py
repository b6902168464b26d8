"""Changes of a recorded log, and what makes them: functions of the log, or of the ScenarioDescription that it holds."""

from collections.abc import Callable
from typing import Any

import numpy as np

from tools.mutate.log import RecordedLog

Change = Callable[[RecordedLog], None]


def mapped(log: RecordedLog, change: Callable[[np.ndarray], np.ndarray]) -> None:
    log.lines = [change(line) for line in log.lines]


def moved(log: RecordedLog, matrix: Any, about: np.ndarray, tracks: bool = True, headings: bool = True) -> None:
    """Apply a rotation or reflection about a point, to tracks or to the map."""
    matrix = np.asarray(matrix, float)
    if not tracks:
        mapped(log, lambda line: (line - about) @ matrix.T + about)
        return
    log.position = (log.position - about) @ matrix.T + about
    log.velocity = log.velocity @ matrix.T
    if headings:
        ahead = np.stack([np.cos(log.heading), np.sin(log.heading)], -1) @ matrix.T
        log.heading = np.arctan2(ahead[..., 1], ahead[..., 0])


MIRROR, SWAP, QUARTER = [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1], [1, 0]]
ORIGIN = np.zeros(2)


def middle(log: RecordedLog) -> np.ndarray:
    """Where the ego, or the vehicle that drives farthest, is in the middle of the log."""
    track = main_track(log)
    frames = np.flatnonzero(log.valid[:, track])
    return log.position[frames[len(frames) // 2], track]


def main_track(log: RecordedLog) -> int:
    return log.ego if log.ego >= 0 else int(way(log).argmax())


def way(log: RecordedLog) -> np.ndarray:
    """Metres that each track is driven [A]."""
    steps = np.linalg.norm(np.diff(log.position, axis=0), axis=-1) * (log.valid[1:] & log.valid[:-1])
    return np.where(steps < 5.0, steps, 0.0).sum(0)


def other_track(log: RecordedLog) -> int:
    """The track other than the main one that drives farthest."""
    ways = way(log)
    ways[main_track(log)] = -1.0
    return int(ways.argmax())


def scaled(factor: float, *parts: str) -> Change:
    def change(log: RecordedLog) -> None:
        for part in parts:
            if part == "lines":
                mapped(log, lambda line: line * factor)
            else:
                setattr(log, part, getattr(log, part) * factor)

    return change


def of_tracks(matrix: Any, headings: bool = True, here: bool = False) -> Change:
    return lambda log: moved(log, matrix, middle(log) if here else ORIGIN, True, headings)


def of_map(matrix: Any, here: bool = False) -> Change:
    return lambda log: moved(log, matrix, middle(log) if here else ORIGIN, False)


def of_all(matrix: Any) -> Change:
    def change(log: RecordedLog) -> None:
        moved(log, matrix, ORIGIN)
        moved(log, matrix, ORIGIN, False)

    return change


def shifted_map(away: tuple[float, float]) -> Change:
    """The map moved by metres along and across the way of the main track."""

    def change(log: RecordedLog) -> None:
        frames = np.flatnonzero(log.valid[:, main_track(log)])
        ahead = log.position[frames[-1], main_track(log)] - log.position[frames[0], main_track(log)]
        ahead = ahead / max(np.linalg.norm(ahead), 1e-6)
        offset = away[0] * ahead + away[1] * np.array([-ahead[1], ahead[0]])
        mapped(log, lambda line: line + offset)

    return change


def setting(name: str, value: Callable[[RecordedLog], Any]) -> Change:
    return lambda log: setattr(log, name, value(log))


def of_one(name: str, change: Callable[[np.ndarray], Any], ego: bool = False) -> Change:
    """Change a part of one track: the main one, or the farthest-driven other one."""

    def apply(log: RecordedLog) -> None:
        values, track = getattr(log, name), main_track(log) if ego else other_track(log)
        at = (track,) if name == "size" else (slice(None), track)
        values[at] = change(values[at])

    return apply


def at_frame(name: str, value: float, ego: bool = False) -> Change:
    """Set a part of one track to a value, at one frame of which it is recorded."""

    def apply(log: RecordedLog) -> None:
        track = main_track(log) if ego else other_track(log)
        frames = np.flatnonzero(log.valid[:, track])
        getattr(log, name)[frames[len(frames) // 2], track] = value

    return apply


def shuffled(log: RecordedLog) -> None:
    order = np.random.default_rng(0).permutation(len(log.position))
    for name in ("position", "heading", "velocity", "valid"):
        setattr(log, name, getattr(log, name)[order])


def noisy(metres: float) -> Change:
    def change(log: RecordedLog) -> None:
        log.position = log.position + np.random.default_rng(0).normal(0, metres, log.position.shape)

    return change


def stamped(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda log: setattr(log, "stamps", change(log.stamps))


def put(stamps: np.ndarray, at: int, value: float) -> np.ndarray:
    stamps[at] = value
    return stamps


def late(log: RecordedLog) -> None:
    """Every second other track appears two seconds after the start frame."""
    tracks = [track for track in range(log.valid.shape[1]) if track != main_track(log)]
    log.valid[:30, tracks[::2]] = False


def gap(log: RecordedLog) -> None:
    """Half a second in which only the main track is recorded."""
    tracks = np.arange(log.valid.shape[1]) != main_track(log)
    log.valid[40:45, tracks] = False


def alone(log: RecordedLog) -> None:
    tracks = np.arange(log.valid.shape[1]) != main_track(log)
    log.valid[:, tracks] = False


def everything_valid(log: RecordedLog) -> None:
    """Frames at which nothing is recorded are marked valid, at the origin."""
    log.position[~log.valid], log.heading[~log.valid] = 0.0, 0.0
    log.valid[:] = True


def invalid_garbage(log: RecordedLog) -> None:
    """Frames that are marked invalid hold NaN and huge numbers."""
    log.position[~log.valid], log.heading[~log.valid] = 1e9, np.nan


# --- what ScenarioDescriptions alone can say


def edit(change: Callable[[dict], None]) -> Change:
    return lambda log: log.edits.append(change)


def current(value: Any) -> Change:
    return edit(lambda data: data["metadata"].update(current_time_index=value))


def typed(name: str, some: bool) -> Change:
    """The type of all tracks but the ego's, or of one of them, is unknown."""

    def change(data: dict) -> None:
        keys = [key for key in data["tracks"] if str(key) != str(data["metadata"]["sdc_id"])]
        for key in keys[:1] if some else keys:
            data["tracks"][key] = {**data["tracks"][key], "type": name}

    return edit(change)


def with_lane(points: list) -> Change:
    lane = {"type": "LANE_SURFACE_STREET", "polyline": np.array(points, float), "exit_lanes": []}
    return edit(lambda data: data["map_features"].update(added=lane))


def lanes_of(change: Callable[[dict], None]) -> Change:
    def every(data: dict) -> None:
        for feature in data["map_features"].values():
            if str(feature["type"]).startswith("LANE_"):
                change(feature)

    return edit(every)


def twin(same_name: bool, ego: bool = False) -> Change:
    """A track a second time: under the number that is its name, or under another name."""

    def change(data: dict) -> None:
        own = str(data["metadata"]["sdc_id"])
        keys = [key for key, track in data["tracks"].items() if track["type"] == "VEHICLE"]
        key = max(
            keys, key=lambda key: _way(data["tracks"][key]) * ((str(key) == own) == ego) + (str(key) == own) * ego
        )
        if same_name:
            track = data["tracks"].pop(key)
            data["tracks"] |= {str(key) + "0": track, int(f"{key}0") if str(key).isdigit() else (key,): track}
            if str(key) == own:
                data["metadata"]["sdc_id"] = str(key) + "0"
        else:
            data["tracks"]["a twin"] = data["tracks"][key]

    return edit(change)


def _way(track: dict) -> float:
    state = track["state"]
    known = np.asarray(state["valid"]).reshape(-1).astype(bool)
    place = np.asarray(state["position"], float)[known, :2]
    return float(np.linalg.norm(np.diff(place, axis=0), axis=-1).sum())


def parked(count: int) -> Change:
    """So many standing vehicles, in rows beside the lanes."""

    def change(data: dict) -> None:
        first = data["tracks"][str(data["metadata"]["sdc_id"])]["state"]
        frames, place = len(first["position"]), np.asarray(first["position"], float)[0, :2] + [60.0, 60.0]
        for number in range(count):
            at = np.broadcast_to([*(place + [6.0 * (number // 50), 3.0 * (number % 50)]), 0.0], (frames, 3))
            state = {"position": at, "heading": np.zeros(frames), "velocity": np.zeros((frames, 2))}
            state |= {"valid": np.ones(frames, bool), "length": np.full(frames, 4.5), "width": np.full(frames, 1.9)}
            data["tracks"][f"parked {number}"] = {"type": "VEHICLE", "state": state}

    return edit(change)


def far(log: RecordedLog, away: float) -> None:
    log.position = log.position + away
    mapped(log, lambda line: line + away)


def reversed_lanes(data: dict) -> None:
    for feature in data["map_features"].values():
        if str(feature["type"]).startswith("LANE_") and "polyline" in feature:
            feature["polyline"] = np.asarray(feature["polyline"])[::-1]


def ego_on_foot(data: dict) -> dict:
    return {**data["tracks"][data["metadata"]["sdc_id"]], "type": "PEDESTRIAN"}


def purple(light: dict) -> dict:
    states = list(light["state"].get("object_state", ()))
    return {**light, "state": {**light["state"], "object_state": ["PURPLE"] * len(states)}}
