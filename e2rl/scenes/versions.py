"""Versions of a log: as recorded, mirrored, or with another vehicle as ego
(`data.versions`), so that what a policy learns carries over to other maps."""

from collections.abc import (
    Callable,
    Sequence,
)
from dataclasses import replace

import numpy as np

from e2rl.run.errors import InputError
from e2rl.scenes.recording import (
    VEHICLE,
    Recording,
)

RECORDED = "recorded"  # the log itself
MARK = "~"  # stands before the version in the ids of all others
MOVES = 1.0  # m between places of a track from which on it moves


def check_versions(names: Sequence[str]) -> None:
    """Raises InputError where there is none, one is not known, or one is named twice."""
    all_names = ", ".join((RECORDED, *VERSIONS))
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"data.versions={list(names)}: name one or several different ones of "
            f"{all_names}"
        )
    for name in names:
        if name not in (RECORDED, *VERSIONS):
            raise InputError(f"data.versions: {name!r} is none of {all_names}")


def version_of(recording: Recording, name: str) -> Recording | None:
    """The version of a log, whose id ends in its name unless it is the log itself; None
    where there is no such version of it. Raises InputError for a log that makes no
    scene."""
    if name == RECORDED:
        return recording
    version = VERSIONS[name](recording.validate_log())
    if version is None:
        return None
    scene_id = f"{recording.scene_id}{MARK}{name}"
    return replace(version, scene_id=scene_id).validate_names()


def mirrored(recording: Recording) -> Recording:
    """The mirrored traffic, y to -y: left turns become right turns, and left-hand
    traffic keeps right."""
    mirror = np.array([1.0, -1.0])
    lanes = {
        name: replace(
            lane,
            points=lane.points * mirror,
            left=lane.right,
            right=lane.left,
        )
        for name, lane in recording.lanes.items()
    }
    rings = [ring[:, :2] * mirror for ring in recording.drivable]
    return replace(
        recording,
        states=recording.states * [1.0, -1.0, -1.0, 1.0],
        lanes=lanes,
        drivable=rings,
    )


def other_ego(recording: Recording) -> Recording | None:
    """With another vehicle as ego: that which drives farthest of those recorded
    throughout. None where none of them moves."""
    whole = recording.valid.all(0) & (recording.agent_type == VEHICLE)
    whole[recording.ego] = False
    moved = recording.states[-1, :, :2] - recording.states[0, :, :2]
    distance = np.linalg.norm(moved, axis=-1) * whole
    if distance.max() <= MOVES:
        return None
    return replace(
        recording,
        ego=int(distance.argmax()),
        egos={},
    )


VERSIONS: dict[str, Callable[[Recording], Recording | None]] = {
    "mirrored": mirrored,
    "other_ego": other_ego,
}
