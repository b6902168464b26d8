"""Rollout files as they are, and their scenes (docs/export.md)."""

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.report.export.episode import Episode
from e2rl.run.files import write_atomically
from e2rl.scenes.scene import KEYS
from e2rl.sim.rollout_file import ROLLOUTS, file_stem

SCENES = "scenes"  # the folder of scenes, beside the one of rollouts


def write(episodes: Iterable[Episode], folder: Path, open_ego: bool = False) -> Iterator[tuple[Episode, Path]]:
    """Write rollouts/NAME.npz, a copy, and scenes/SCENE_ID.npz of each episode."""
    for episode in episodes:
        path = episode.rollout.write(folder / ROLLOUTS)
        if episode.scene is not None:
            scene = folder / SCENES / f"{file_stem(episode.rollout.scene_id)}.npz"
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **scene_arrays(episode))
            write_atomically(scene, buffer.getvalue())
        yield episode, path


def scene_arrays(episode: Episode) -> dict[str, Any]:
    """The arrays of a scene (e2rl/scenes/scene.py), the ids and speed limits [m/s] of its lanes, and its origin [m] in
    the recording's coordinates."""
    assert episode.scene is not None and episode.origin is not None
    return {
        **{key: episode.scene[key].numpy() for key in KEYS},
        "lane_id": np.array(list(episode.lanes)),
        "lane_limit": np.array([lane.speed_limit for lane in episode.lanes.values()]),
        "origin": episode.origin,
    }
