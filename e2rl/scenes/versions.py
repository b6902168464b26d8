"""Versions of a log: as recorded, mirrored, or with what other converters leave out or
get wrong (`data.versions`).

A policy that learns one converter's conventions fails on another's. Each version takes
one thing away, so that a measurement shows what a policy leans on, and a training on
several leans on none.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from e2rl.run.errors import InputError
from e2rl.scenes.paths import resample
from e2rl.scenes.recording import VEHICLE, Lane, Recording

RECORDED, MARK = (
    "recorded",
    "~",
)  # the log itself; stands before the version in the ids of all others
MOVES = 1.0  # m between places of a track from which on it moves
BESIDE = 1.5  # m from every centreline, farther than which a vehicle that never moves is parked
HEADING_NOISE = 0.05  # rad, standard deviation of disturbed headings
SHIFT = 0.5  # m by which a shifted map lies beside its tracks
CROP = 50.0  # m from the ego's path within which a lane of a cropped map comes


def check_versions(names: Sequence[str]) -> None:
    """Raises InputError where there is none, one is not known, or one is named twice."""
    known = ", ".join((RECORDED, *VERSIONS))
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"data.versions={list(names)}: name one or several different ones of {known}"
        )
    for part in (
        part for name in names if name != RECORDED for part in name.split("+")
    ):
        if part not in VERSIONS:
            raise InputError(
                f"data.versions: {part!r} is none of {known}; a+b is b of a, of those but {RECORDED}"
            )


def version_of(recording: Recording, name: str) -> Recording | None:
    """The version of a log, whose id ends in its name unless it is the log itself;
    `a+b` is b of a. None where there is no such version of it. Raises InputError for a
    log that makes no scene."""
    if name == RECORDED:
        return recording
    made: Recording | None = recording.validate_log()
    for part in name.split("+"):
        made = made and VERSIONS[part](made)
    return (
        made
        and replace(made, scene_id=f"{recording.scene_id}{MARK}{name}").validate_names()
    )


def mirrored(recording: Recording) -> Recording:
    """The mirrored traffic, y to -y: left turns become right turns, and left-hand
    traffic keeps right."""
    mirror = np.array([1.0, -1.0])
    lanes = {
        name: replace(
            lane, points=lane.points * mirror, left=lane.right, right=lane.left
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


def unparked(recording: Recording) -> Recording:
    """Without vehicles that never move and stand beside the lanes."""
    xy = recording.states[..., :2]
    valid = recording.valid
    low, high = (
        least(np.where(valid[..., None], xy, far), 0)
        for least, far in ((np.min, np.inf), (np.max, -np.inf))
    )
    stands = np.linalg.norm(high - low, axis=-1) <= MOVES
    lines = [
        resample(lane.points, 1.0)
        for lane in recording.lanes.values()
        if len(lane.points) > 1
    ]
    beside = (
        cKDTree(np.concatenate([np.zeros((0, 2)), *lines])).query(
            np.where(stands[:, None], low, 0.0)
        )[0]
        > BESIDE
    )
    keep = ~(stands & beside & (recording.agent_type == VEHICLE))
    keep[recording.all_egos()] = True
    place = np.cumsum(keep) - 1
    return replace(
        recording,
        states=recording.states[:, keep],
        valid=valid[:, keep],
        heights=None if recording.heights is None else recording.heights[:, keep],
        size=recording.size[keep],
        agent_type=recording.agent_type[keep],
        ego=int(place[recording.ego]),
        egos={
            start: int(place[ego]) if ego >= 0 else -1
            for start, ego in recording.egos.items()
        },
    )


def turned(recording: Recording) -> Recording:
    """With the others' headings off by HEADING_NOISE, the same all along a track."""
    noise = np.asarray(
        _draws(recording).normal(0.0, HEADING_NOISE, recording.valid.shape[1])
    )
    noise[recording.all_egos()] = 0.0
    states = recording.states.copy()
    states[..., 2] += noise
    return replace(recording, states=states)


def shifted(recording: Recording) -> Recording:
    """With a map that lies SHIFT beside its tracks, in a direction that depends on the
    log."""
    angle = _draws(recording).uniform(0.0, 2 * np.pi)
    step = SHIFT * np.array([np.cos(angle), np.sin(angle)])
    moved = _lanes(lambda lane: replace(lane, points=lane.points + step))(recording)
    return replace(moved, drivable=[ring[:, :2] + step for ring in recording.drivable])


def cropped(recording: Recording) -> Recording:
    """With the lanes alone that come within CROP of the egos' paths."""
    egos = recording.all_egos()
    path = recording.states[:, egos, :2][recording.valid[:, egos]]
    if not len(path):
        return recording
    tree = cKDTree(path)

    def is_near(lane: Lane) -> bool:
        points = (
            resample(lane.points, CROP / 2) if len(lane.points) > 1 else lane.points
        )
        return bool(tree.query(points)[0].min(initial=np.inf) < CROP)

    near = {name for name, lane in recording.lanes.items() if is_near(lane)}
    lanes = {name: lane for name, lane in recording.lanes.items() if name in near}
    lights = {name: light for name, light in recording.lights.items() if name in near}
    return replace(recording, lanes=lanes, lights=lights)


def other_ego(recording: Recording) -> Recording | None:
    """With another vehicle as ego: that which drives farthest of those recorded
    throughout. None where none of them moves."""
    whole = recording.valid.all(0) & (recording.agent_type == VEHICLE)
    whole[recording.ego] = False
    driven = (
        np.linalg.norm(
            recording.states[-1, :, :2] - recording.states[0, :, :2], axis=-1
        )
        * whole
    )
    return (
        replace(recording, ego=int(driven.argmax()), egos={})
        if driven.max() > MOVES
        else None
    )


VERSIONS: dict[str, Callable[[Recording], Recording | None]] = {
    "mirrored": mirrored,
    "unconnected": _lanes(lambda lane: replace(lane, exits=[], left=[], right=[])),
    "unlit": unlit,
    "unlimited": _lanes(lambda lane: replace(lane, speed_limit=0.0)),
    "unmeasured": _lanes(lambda lane: replace(lane, width=0.0)),
    "unparked": unparked,
    "turned": turned,
    "shifted": shifted,
    "cropped": cropped,
    "other_ego": other_ego,
}
"""Versions by name; `unconnected`: lanes without successors and neighbours, `unlimited`: without speed limits,
`unmeasured`: without widths."""


def _draws(recording: Recording) -> np.random.Generator:
    """Random numbers of a log's own."""
    return np.random.default_rng(list(recording.scene_id.encode()))
