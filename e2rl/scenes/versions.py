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
from scipy.spatial import cKDTree

from e2rl.run.errors import InputError
from e2rl.scenes.paths import (
    direction,
    resample,
    stacked,
)
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)

RECORDED = "recorded"  # the log itself
MARK = "~"  # stands before the version in the ids of all others
MOVES = 1.0  # m between places of a track from which on it moves
BESIDE = 1.5  # m from every centreline, beyond which a vehicle that stands is parked
HEADING_NOISE = 0.05  # rad, standard deviation of disturbed headings
SHIFT = 0.5  # m by which a shifted map lies beside its tracks
CROP = 50.0  # m from the ego's path within which a lane of a cropped map comes


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


def unparked(recording: Recording) -> Recording:
    """Without vehicles that never move and stand beside the lanes."""
    xy = recording.states[..., :2]
    valid = recording.valid[..., None]
    low = np.where(valid, xy, np.inf).min(0)
    high = np.where(valid, xy, -np.inf).max(0)
    stands = np.linalg.norm(high - low, axis=-1) <= MOVES
    lanes = recording.lanes.values()
    lines = [resample(lane.points, 1.0) for lane in lanes if len(lane.points) > 1]
    place = np.where(stands[:, None], low, 0.0)
    parked = stands & (cKDTree(stacked(lines)).query(place)[0] > BESIDE)
    keep = ~(parked & (recording.agent_type == VEHICLE))
    keep[recording.all_egos()] = True
    track = np.where(keep, np.cumsum(keep) - 1, -1).tolist() + [-1]
    heights = recording.heights
    return replace(
        recording,
        states=recording.states[:, keep],
        valid=recording.valid[:, keep],
        heights=None if heights is None else heights[:, keep],
        size=recording.size[keep],
        agent_type=recording.agent_type[keep],
        ego=track[recording.ego],
        egos={start: track[ego] for start, ego in recording.egos.items()},
    )


def turned(recording: Recording) -> Recording:
    """With the others' headings off by HEADING_NOISE, the same all along a track."""
    agents = recording.valid.shape[1]
    noise = np.asarray(_draws(recording).normal(0.0, HEADING_NOISE, agents))
    noise[recording.all_egos()] = 0.0
    states = recording.states.copy()
    states[..., 2] += noise
    return replace(recording, states=states)


def shifted(recording: Recording) -> Recording:
    """With a map that lies SHIFT beside its tracks, in a direction that depends on the
    log."""
    step = SHIFT * direction(_draws(recording).uniform(0.0, 2 * np.pi))
    moved = _lanes(lambda lane: replace(lane, points=lane.points + step))(recording)
    return replace(moved, drivable=[ring[:, :2] + step for ring in recording.drivable])


def cropped(recording: Recording) -> Recording:
    """With the lanes alone that come within CROP of the egos' paths."""
    egos = recording.all_egos()
    path = recording.states[:, egos, :2][recording.valid[:, egos]]
    if not len(path):
        return recording
    tree = cKDTree(path)
    lanes = {}
    for name, lane in recording.lanes.items():
        points = lane.points
        if len(points) > 1:
            points = resample(points, CROP / 2)
        if tree.query(points)[0].min(initial=np.inf) < CROP:
            lanes[name] = lane
    lights = {name: light for name, light in recording.lights.items() if name in lanes}
    return replace(
        recording,
        lanes=lanes,
        lights=lights,
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
    "unparked": unparked,
    "turned": turned,
    "shifted": shifted,
    "cropped": cropped,
    "other_ego": other_ego,
}


def _draws(recording: Recording) -> np.random.Generator:
    """Random numbers of a log's own."""
    return np.random.default_rng(list(recording.scene_id.encode()))
