"""Writes the archive of a split that e2rl/scenes/bundled.py reads (format
e2rl-scenes/1)."""

from dataclasses import dataclass

import numpy as np

from e2rl.scenes.bundled import FORMAT, MILLI, UNIT, SceneMap
from e2rl.scenes.recording import Recording


@dataclass
class Place(SceneMap):
    """A map with the cars parked there, their poses [Q, 3] and sizes [Q, 2]."""

    parked: np.ndarray
    parked_size: np.ndarray


def pack(
    maps: list[Place], scenes: list[tuple[Recording, int]]
) -> dict[str, np.ndarray]:
    """Arrays of an archive from maps and (recording, first frame on its map's light
    programme) on them."""
    lanes = [
        (scene_map.name, name, lane)
        for scene_map in maps
        for name, lane in scene_map.lanes.items()
    ]
    number = {
        (scene_map, name): index for index, (scene_map, name, _) in enumerate(lanes)
    }
    pairs = {
        kind: [
            (number[m, n], number[m, other])
            for m, n, lane in lanes
            for other in getattr(lane, kind)
        ]
        for kind in ("exits", "left", "right")
    }
    points = [lane.points for _, _, lane in lanes]
    polygons = [ring for scene_map in maps for ring in scene_map.drivable]
    lights = [
        (number[m.name, name], state) for m in maps for name, state in m.lights.items()
    ]
    states = [np.moveaxis(_steady(recording), 0, 1) for recording, _ in scenes]
    names = [scene_map.name for scene_map in maps]
    return {
        "format": np.array(FORMAT),
        "map_name": np.array(names),
        "map_lanes": _counts([scene_map.lanes for scene_map in maps]),
        "map_polygons": _counts([scene_map.drivable for scene_map in maps]),
        "map_lights": _counts([scene_map.lights for scene_map in maps]),
        "map_parked": _counts([scene_map.parked for scene_map in maps]),
        "lane_id": np.array([name for _, name, _ in lanes]),
        "lane_counts": _counts(points),
        "lane_points": _quantise(_join(points, 2), MILLI),
        "lane_width": _quantise([lane.width for _, _, lane in lanes], MILLI),
        "lane_speed": _quantise([lane.speed_limit for _, _, lane in lanes], MILLI),
        **{
            kind: np.array(rows, np.int32).reshape(-1, 2)
            for kind, rows in pairs.items()
        },
        "polygon_counts": _counts(polygons),
        "polygon_points": _quantise(_join(polygons, 2), MILLI),
        "light_lane": np.array([index for index, _ in lights], np.int32),
        "light_states": np.array([state for _, state in lights], np.int8),
        "parked": _quantise(
            _join([scene_map.parked for scene_map in maps], 3), UNIT[:3]
        ),
        "parked_size": _quantise(
            _join([scene_map.parked_size for scene_map in maps], 2), MILLI
        ),
        "scene_id": np.array([recording.scene_id for recording, _ in scenes]),
        "scene_map": np.array(
            [names.index(recording.location) for recording, _ in scenes], np.int32
        ),
        "scene_first": np.array([first for _, first in scenes], np.int32),
        "scene_ego": np.array([recording.ego for recording, _ in scenes], np.int32),
        "scene_agents": _counts(states),
        "states": np.concatenate(
            [_second_difference(_quantise(part, UNIT)) for part in states]
        ),
        "valid": np.concatenate([recording.valid.T for recording, _ in scenes]),
        "size": _quantise(
            np.concatenate([recording.size for recording, _ in scenes]), MILLI
        ),
    }


def _quantise(values: np.ndarray | list[float], unit: np.ndarray | float) -> np.ndarray:
    return np.round(np.asarray(values, float) / unit).astype(np.int32)


def _counts(parts: list) -> np.ndarray:
    return np.array([len(part) for part in parts], np.int32)


def _join(parts: list[np.ndarray], columns: int) -> np.ndarray:
    return np.concatenate([*parts, np.zeros((0, columns))])


def _steady(recording: Recording) -> np.ndarray:
    """States with unwrapped headings; frames outside a track repeat a valid one of it,
    which costs no space."""
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
