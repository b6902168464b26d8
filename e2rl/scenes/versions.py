"""Versions of a log: as recorded, mirrored, or with what other converters leave out or
get wrong (`data.versions`).

A policy that learns one converter's conventions fails on another's. Each version takes
one thing away, so that a measurement shows what a policy leans on, and a training on
several leans on none.
"""

from collections.abc import (
    Callable,
    Sequence,
)
from dataclasses import replace

import numpy as np

from e2rl.run.errors import InputError
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
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
        for part in name.split("+") if name != RECORDED else ():
            if part not in VERSIONS:
                raise InputError(
                    f"data.versions: {part!r} is none of {all_names}; a+b is b of a, "
                    f"of those but {RECORDED}"
                )


def version_of(recording: Recording, name: str) -> Recording | None:
    """The version of a log, whose id ends in its name unless it is the log itself;
    `a+b` is b of a. None where there is no such version of it. Raises InputError for a
    log that makes no scene."""
    if name == RECORDED:
        return recording
    version: Recording | None = recording.validate_log()
    for part in name.split("+"):
        version = version and VERSIONS[part](version)
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


def _lanes(change: Callable[[Lane], Lane]) -> Callable[[Recording], Recording]:
    def changed(recording: Recording) -> Recording:
        return replace(
            recording,
            lanes={name: change(lane) for name, lane in recording.lanes.items()},
        )

    return changed


def unlit(recording: Recording) -> Recording:
    """Without traffic lights."""
    return replace(recording, lights={})


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


# by name; `unconnected`: lanes without successors and neighbours, `unlimited`: without
# speed limits, `unmeasured`: without widths
VERSIONS: dict[str, Callable[[Recording], Recording | None]] = {
    "mirrored": mirrored,
    "unconnected": _lanes(
        lambda lane: replace(
            lane,
            exits=[],
            left=[],
            right=[],
        )
    ),
    "unlit": unlit,
    "unlimited": _lanes(lambda lane: replace(lane, speed_limit=0.0)),
    "unmeasured": _lanes(lambda lane: replace(lane, width=0.0)),
    "other_ego": other_ego,
}
