"""ScenarioNet: a ScenarioDescription pickle of each episode, and the summary of the
folder (docs/guide/export.md).

Pickles hold python containers and numpy arrays only. Where the scene is known, the
second before the start comes first, so the start is frame 10 as in Waymo's files.
"""

import pickle
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.report.export.episode import Episode, past_of
from e2rl.run.files import write_atomically
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED, LIGHT_UNKNOWN, LIGHT_YELLOW
from e2rl.scenes.smoothing import PAST

VERSION = "MetaDrive v0.3.0.1"  # of the format
SUMMARY = "dataset_summary.pkl"
MAPPING = "dataset_mapping.pkl"
MOVES = 1.0  # m that an object moves at least that counts as moving in ScenarioNet
PROTOCOL = 4  # of pickle, which every Python 3 reads
LIGHTS = {
    LIGHT_UNKNOWN: "LANE_STATE_UNKNOWN",
    LIGHT_RED: "LANE_STATE_STOP",
    LIGHT_YELLOW: "LANE_STATE_CAUTION",
    LIGHT_GREEN: "LANE_STATE_GO",
}


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write sd_NAME.pkl of each episode, then the summary and the mapping that
    MetaDrive reads a folder by."""
    summary = {}
    for episode in episodes:
        path = folder / f"sd_{episode.path.stem}.pkl"
        content = description(episode)
        summary[path.name] = content["metadata"]
        write_pickle(path, content)
        yield episode, path
    write_pickle(folder / SUMMARY, summary)
    write_pickle(folder / MAPPING, dict.fromkeys(summary, ""))


def write_pickle(path: Path, content: dict[str, Any]) -> None:
    write_atomically(path, pickle.dumps(content, PROTOCOL))


def description(episode: Episode) -> dict[str, Any]:
    """The ScenarioDescription of an episode; track n is the agent of row n, and 0 the
    ego."""
    history = 0 if episode.scene is None else PAST
    frames = history + episode.steps + 1
    past = dict(past_of(episode))
    scene_id = episode.path.stem
    tracks = {
        str(row): track(episode, row, history=history, past=past.get(row))
        for row in episode.agents
    }
    objects = {name: object_summary(name, entry) for name, entry in tracks.items()}
    lights = {name: light(episode, name, history=history) for name in episode.lights}
    metadata: dict[str, Any] = {
        "id": scene_id,
        "scenario_id": scene_id,
        "dataset": "e2rl",
        "source_file": episode.path.name,
        "map": episode.rollout.location,
        "coordinate": "metadrive",
        "metadrive_processed": False,
        "ts": np.arange(frames) * episode.rollout.dt,
        "track_length": frames,
        "sdc_id": "0",
        "sdc_track_index": 0,
        "object_summary": objects,
        "number_summary": number_summary(objects, lights, lanes=len(episode.lanes)),
        "map_height_diff": 0.0,  # beside the numbers: the filter of overpasses looks here
        "e2rl": episode.facts,
    }
    if episode.origin is not None:
        metadata |= {"current_time_index": history, "origin": episode.origin.tolist()}
    return {
        "id": scene_id,
        "version": VERSION,
        "length": frames,
        "metadata": metadata,
        "tracks": tracks,
        "dynamic_map_states": lights,
        "map_features": map_features(episode),
    }


def track(
    episode: Episode,
    row: int,
    history: int,
    past: np.ndarray | None,
) -> dict[str, Any]:
    """The track of an agent, zero where it is absent.

    Args:
        episode: the rollout.
        row: of the agent.
        history: frames before the start.
        past: [history, 4] its states in them; None: it was not there.
    """
    rollout = episode.rollout
    length, width = episode.size(row)
    kind = str(rollout.agent_type[row])
    frames = history + episode.steps + 1
    states = np.zeros((frames, 4))
    valid = np.zeros(frames, bool)
    present = rollout.valid[:, row]
    valid[history:] = present
    states[history:][present] = rollout.states[present, row]
    if past is not None:
        states[:history] = past
        valid[:history] = True
    heading = states[:, 2]
    direction = np.stack([np.cos(heading), np.sin(heading)], -1)
    return {
        "type": kind.upper(),
        "state": {
            "position": np.pad(states[:, :2], ((0, 0), (0, 1))),
            "heading": heading,
            "velocity": states[:, 3:] * direction,
            "valid": valid,
            "length": length * valid,
            "width": width * valid,
            "height": episode.height(row) * valid,
        },
        "metadata": {
            "type": kind.upper(),
            "object_id": str(row),
            "track_length": frames,
            "dataset": "e2rl",
            "simulated": bool(rollout.simulated[row]),
            "adversary": bool(rollout.adversaries[row]),
        },
    }


def object_summary(name: str, entry: dict[str, Any]) -> dict[str, Any]:
    """What ScenarioNet's filters know of a track: how long it is there, and how far it
    moves."""
    valid = entry["state"]["valid"]
    moves = np.diff(entry["state"]["position"][valid, :2], axis=0)
    distance = np.linalg.norm(moves, axis=1).sum()
    first = int(valid.argmax())
    return {
        "type": entry["type"],
        "object_id": name,
        "track_length": len(valid),
        "moving_distance": float(distance),
        "valid_length": int(valid.sum()),
        "continuous_valid_length": int(np.logical_and.accumulate(valid[first:]).sum()),
    }


def number_summary(
    objects: dict[str, dict],
    lights: dict[str, dict],
    lanes: int,
) -> dict[str, Any]:
    """Returns what ScenarioNet's filters know of a scenario: how many there are of
    everything.

    Args:
        objects: the summary of each track.
        lights: dynamic_map_states.
        lanes: number of map features.
    """
    moving = [
        entry["type"] for entry in objects.values() if entry["moving_distance"] > MOVES
    ]
    states = Counter(
        state for entry in lights.values() for state in entry["state"]["object_state"]
    )
    types = Counter(entry["type"] for entry in objects.values())
    return {
        "num_objects": len(objects),
        "object_types": sorted(types),
        "num_objects_each_type": dict(types),
        "num_moving_objects": len(moving),
        "num_moving_objects_each_type": dict(Counter(moving)),
        "num_traffic_lights": len(lights),
        "num_traffic_light_types": sorted(states),
        "num_traffic_light_each_step": dict(states),
        "num_map_features": lanes,
        "map_height_diff": 0.0,
    }


def light(episode: Episode, name: str, history: int) -> dict[str, Any]:
    """The light that lets into a lane; unknown before the recording begins."""
    past = episode.light_past[name][-history:].tolist() if history else []
    states = [LIGHT_UNKNOWN] * (history - len(past))
    states += [*past, *episode.lights[name].tolist()]
    return {
        "type": "TRAFFIC_LIGHT",
        "lane": name,
        "stop_point": np.array([*episode.lanes[name].points[0], 0.0]),
        "state": {"object_state": [LIGHTS[int(state)] for state in states]},
        "metadata": {
            "type": "TRAFFIC_LIGHT",
            "object_id": name,
            "track_length": len(states),
            "dataset": "e2rl",
        },
    }


def map_features(episode: Episode) -> dict[str, dict[str, Any]]:
    """The lanes."""
    entries = episode.entries()
    return {
        name: {
            "type": "LANE_SURFACE_STREET",
            "polyline": np.pad(
                lane.points, ((0, 0), (0, 1))
            ),  # z is 0: MetaDrive and ScenarioNet expect [P, 3]
            "width": np.full((len(lane.points), 2), lane.width / 2),
            "entry_lanes": entries[name],
            "exit_lanes": list(lane.exits),
            "left_neighbor": [{"feature_id": other} for other in lane.left],
            "right_neighbor": [{"feature_id": other} for other in lane.right],
            **(
                {"speed_limit_kmh": lane.speed_limit * 3.6}
                if lane.speed_limit > 0
                else {}
            ),
        }
        for name, lane in episode.lanes.items()
    }
