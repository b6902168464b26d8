"""Small ScenarioDescription dicts with known answers: a road along +x that forks at x =
100 m."""

import pickle
import zipfile
from pathlib import Path

import numpy as np

from e2rl.scenes.log_files import LogFiles

FRAMES = 91
ALL = np.arange(FRAMES)


def track(
    position,
    heading,
    speed,
    kind: str = "VEHICLE",
    valid=None,
    size=(4.5, 1.9),
) -> dict:
    """A track through position [F, 2] m with heading [F] rad and speed [F] m/s (scalars
    broadcast)."""
    position = np.broadcast_to(np.asarray(position, float), (FRAMES, 2))
    heading, speed = (
        np.broadcast_to(np.asarray(value, float), (FRAMES,)).copy()
        for value in (heading, speed)
    )
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    return {
        "type": kind,
        "state": {
            "position": np.concatenate([position, np.zeros((FRAMES, 1))], 1),
            "heading": heading,
            "velocity": velocity,
            "valid": np.ones(FRAMES, bool) if valid is None else np.asarray(valid),
            "length": np.full(FRAMES, size[0]),
            "width": np.full(FRAMES, size[1]),
        },
    }


def straight(
    x: float,
    y: float,
    speed: float,
    **options,
) -> dict:
    """A track along +x at constant speed, at (x, y) at frame 0."""
    return track(
        np.stack([x + 0.1 * speed * ALL, np.full(FRAMES, y)], 1),
        0.0,
        speed=speed,
        **options,
    )


def lane(
    points,
    exits=(),
    speed_kmh: float = 50.0,
    width: float = 3.6,
    **more,
) -> dict:
    """A lane of constant width along points [P, 2]."""
    points = np.asarray(points, float)
    polyline = np.concatenate([points, np.zeros((len(points), 1))], 1)
    return {
        "type": "LANE_SURFACE_STREET",
        "polyline": polyline,
        "speed_limit_kmh": speed_kmh,
        "width": np.full((len(points), 2), width / 2),
        "exit_lanes": list(exits),
    } | more


def fork(connected: bool = True) -> dict:
    """`in` (x = 0..100, y = 0), then `on` straight to x = 400 and `left`, an arc of
    radius 20 m up to y = 320.

    `near` runs beside `in` at y = 3.5 and goes on in nothing.
    """
    angle = np.linspace(-np.pi / 2, 0, 16)
    arc = np.stack([100 + 20 * np.cos(angle), 20 + 20 * np.sin(angle)], 1)
    left = np.concatenate([arc, [[120.0, 320.0]]])
    return {
        "in": lane([[0, 0], [50, 0], [100, 0]], ["on", "left"] if connected else ()),
        "on": lane([[100, 0], [250, 0], [400, 0]], speed_kmh=72.0),
        "left": lane(left),
        "near": lane([[0, 3.5], [100, 3.5]]),
        "bike": lane([[0, -4], [100, -4]]) | {"type": "LANE_BIKE_LANE"},
        "dot": lane([[0, 0]]),
    }


def description(
    tracks: dict | None = None,
    lanes: dict | None = None,
    **metadata,
) -> dict:
    """A scenario of tracks (default: the ego at 8 m/s on `in`, a car ahead on `near`, a
    pedestrian) on the fork."""
    tracks = tracks or {
        "ego": straight(20, 0, speed=8),
        "7": straight(50, 3.5, speed=6),
        "p": straight(
            40,
            -6,
            speed=1,
            kind="PEDESTRIAN",
            size=(0.6, 0.6),
        ),
    }
    return {
        "id": "fork",
        "version": "test",
        "length": FRAMES,
        "tracks": tracks,
        "map_features": lanes or fork(),
        "dynamic_map_states": {},
        "metadata": {
            "sdc_id": "ego",
            "ts": ALL * 0.1,
            "dataset": "made",
            "scenario_id": "fork",
            "current_time_index": 10,
        }
        | metadata,
    }


def numbered(scenes: list[dict]) -> list[dict]:
    """The scenes with ids scene-0, scene-1, ..."""
    return [scene | {"id": f"scene-{index}"} for index, scene in enumerate(scenes)]


def write_folder(folder: Path, scenes: list) -> Path:
    """Pickle scenes (dicts, or bytes as they are) into a folder."""
    folder.mkdir(
        parents=True,
        exist_ok=True,
    )
    for index, scene in enumerate(scenes):
        content = scene if isinstance(scene, bytes) else pickle.dumps(scene)
        (folder / f"sd_{index:02d}.pkl").write_bytes(content)
    return folder


def write_zip(
    path: Path,
    scenes: list[dict],
    method: int = zipfile.ZIP_LZMA,
) -> Path:
    """The same in a zip."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for index, scene in enumerate(scenes):
            archive.writestr(f"part/sd_{index:02d}.pkl", pickle.dumps(scene))
    return path


class Malicious:
    """Pickles to a call of a function that is no data."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def recordings_in(
    kind: type[LogFiles],
    content: bytes,
    log: str = "made.pkl",
    place: str = "place",
    **settings,
) -> list:
    """What a source makes of one log."""
    source = kind("nowhere", **settings)
    vars(source).update(
        logs=lambda: [log],
        content=lambda _: content,
        locations={Path(log).stem: place},
    )
    return list(source.recordings())


def data_config(
    path,
    cache,
    **options,
) -> dict:
    """The scenarionet group with small fields."""
    group = {
        "_target_": "e2rl.scenes.scenarionet.ScenarioNetSource",
        "path": str(path),
        "cache": str(cache),
    }
    return group | {"workers": 1, "build": {"field_cells": 64}} | options
