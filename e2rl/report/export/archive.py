"""Rollout files as they are, and their scenes (docs/guide/export.md)."""

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.report.export.episode import Episode
from e2rl.run.files import write_atomically
from e2rl.scenes.scene import KEYS
from e2rl.sim.rollout_file import ROLLOUTS, file_stem

FORMAT = "e2rl-scene/1"  # of a scene's file
SCENES = "scenes"  # the folder of scenes, beside the one of rollouts


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write rollouts/NAME.npz, a copy, and scenes/SCENE_ID.npz of each episode: the
    arrays of its scene (e2rl/scenes/scene.py), the ids and speed limits [m/s] of its
    lanes, and its origin [m] in the recording's coordinates."""
    for episode in episodes:
        path = episode.rollout.write(folder / ROLLOUTS)
        if episode.scene is not None:
            arrays: dict[str, Any] = {key: episode.scene[key].numpy() for key in KEYS}
            arrays["lane_id"] = np.array(list(episode.lanes))
            arrays["lane_limit"] = np.array(
                [lane.speed_limit for lane in episode.lanes.values()]
            )
            arrays["origin"] = episode.origin
            buffer = io.BytesIO()
            np.savez_compressed(buffer, format=np.array(FORMAT), **arrays)
            write_atomically(
                folder / SCENES / f"{file_stem(episode.rollout.scene_id)}.npz",
                buffer.getvalue(),
            )
        yield episode, path
