"""Trailers that a log records as vehicles of their own: which these are, and what
becomes of them.

Simulated traffic would drive a trailer as a vehicle that follows its tractor, and
farther and farther behind it.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import DT, VEHICLE, Recording

DRIVEN, DRIVES = 5.0, 1.0  # m that a pair drives, m/s above which its frames count
FRAMES = 30  # of a pair that drives: followers keep a distance for a second or two, too
REACH = 2.5  # m at most from a tractor's rear to its trailer's front
ASIDE, OVERLAP = (
    0.5,
    0.5,
)  # m at most by which a trailer's front is beside its tractor's rear, in line, and before it
HEADWAY = 0.25  # s: nobody follows another vehicle at that distance
PLAY = 0.2  # m by which that distance varies, in nine of ten frames
ALIGNED = 0.2  # rad between both up to which they are one long box
LONGEST = 5  # vehicles of a road train
STRAIGHTENS = (
    20  # frames in which a trailer that is not seen comes in line with its tractor
)
JOINED = "trailers joined to their tractors"
TURNING = "trailers that turn against their tractors, which only a replay shows"


def couple(recording: Recording) -> Recording:
    """Returns the recording with the trailers that stay behind their tractors as one
    vehicle with them.

    Those that turn against them are marked as `towed`, but for the ego's, which are
    left out. Both count as repairs.

    Args:
        recording: of a log, with fields of the right types and shapes.
    """
    repairs = Counter(recording.repairs)
    for _ in range(LONGEST - 1):
        pairs = _pairs(recording)
        if not pairs:
            break
        for tractor, trailer in pairs:
            turns = _turns(recording, tractor, trailer=trailer)
            recording = (
                _marked(recording, tractor, trailer=trailer)
                if turns
                else _joined(recording, tractor, trailer=trailer)
            )
            repairs[TURNING if turns else JOINED] += 1
    return replace(recording, repairs=repairs)


def _pairs(recording: Recording) -> list[tuple[int, int]]:
    """Returns tractors and their trailers: vehicles that drive at one distance from
    rear to front, too short to follow.

    A vehicle is in one pair at most: the next one of a road train is found once the
    first are joined.
    """
    speed = np.abs(recording.states[..., 3]) * recording.valid
    drives = (speed.sum(0) * DT > DRIVEN) & (recording.agent_type == VEHICLE)
    moving = (speed > DRIVES) & drives
    front, rear = _ends(recording.states, recording.size[:, 0])
    fixed = {*recording.all_egos(), *recording.towed}  # no trailers
    found = []
    for tractor, trailer in sorted(
        _near_pairs(front, rear, moving=moving, valid=recording.valid)
    ):
        frames = np.flatnonzero(moving[:, tractor] & recording.valid[:, trailer])
        offset = front[frames, trailer] - rear[frames, tractor]
        distances = np.linalg.norm(offset, axis=-1)
        if (
            len(frames) < FRAMES
            or trailer in fixed
            or not _behind(
                recording, tractor, trailer=trailer, frames=frames, offset=offset
            )
        ):
            continue
        middle = np.median(distances)
        play = np.quantile(np.abs(distances - middle), 0.9)
        if middle < min(REACH, HEADWAY * speed[frames, tractor].max()) and play < PLAY:
            found.append((middle, tractor, trailer))
    pairs = []
    taken = set[int]()
    for _, tractor, trailer in sorted(found):
        if not taken & {tractor, trailer}:
            pairs.append((tractor, trailer))
            taken |= {tractor, trailer}
    return pairs


def _near_pairs(
    front: np.ndarray, rear: np.ndarray, moving: np.ndarray, valid: np.ndarray
) -> set[tuple[int, int]]:
    """Returns pairs of tracks of which the first moves and has the other's front within
    REACH of its rear at a frame.

    Args:
        front, rear: [F, A, 2] m.
        moving, valid: [F, A] bool.
    """
    pairs = set()
    driving = moving.any(0)
    for frame in np.flatnonzero(moving.any(1)):
        tractors = np.flatnonzero(moving[frame])
        trailers = np.flatnonzero(valid[frame] & driving)
        near = cKDTree(front[frame, trailers]).query_ball_point(
            rear[frame, tractors], REACH
        )
        pairs |= {
            (int(tractor), int(trailers[index]))
            for tractor, indices in zip(tractors, near, strict=True)
            for index in indices
            if trailers[index] != tractor
        }
    return pairs


def _behind(
    recording: Recording,
    tractor: int,
    trailer: int,
    frames: np.ndarray,
    *,
    offset: np.ndarray,
) -> bool:
    """Returns whether a trailer's front is behind its tractor's rear, and not beside
    it, where both are in line.

    offset: [frames, 2] m from that rear to that front.
    """
    heading = recording.states[frames, tractor, 2]
    in_line = np.abs(wrap(heading - recording.states[frames, trailer, 2])) < ALIGNED
    if not in_line.any():
        return True
    ahead = (offset * np.stack([np.cos(heading), np.sin(heading)], -1)).sum(-1)[in_line]
    aside = (offset * np.stack([-np.sin(heading), np.cos(heading)], -1)).sum(-1)[
        in_line
    ]
    return bool(np.median(np.abs(aside)) < ASIDE and np.median(ahead) < OVERLAP)


def _ends(states: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the middles of the fronts and of the rears [F, A, 2] m of boxes at states
    [F, A, 4]; length [A] m."""
    ahead = (
        np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], -1)
        * length[:, None]
        / 2
    )
    return states[..., :2] + ahead, states[..., :2] - ahead


def _turns(recording: Recording, tractor: int, trailer: int) -> bool:
    """Returns whether a trailer is at an angle to its tractor at any frame."""
    both = recording.valid[:, tractor] & recording.valid[:, trailer]
    angle = wrap(
        recording.states[both, tractor, 2] - recording.states[both, trailer, 2]
    )
    return bool(np.quantile(np.abs(angle), 0.95) > ALIGNED)


def _marked(recording: Recording, tractor: int, trailer: int) -> Recording:
    """Returns the recording with a trailer that only a replay shows; without it, where
    the ego is the tractor."""
    if tractor in recording.all_egos():
        valid = recording.valid.copy()
        valid[:, trailer] = False
        return replace(recording, valid=valid)
    return replace(recording, towed=(*recording.towed, trailer))


def _joined(recording: Recording, tractor: int, trailer: int) -> Recording:
    """Returns the recording with both as one vehicle, in the tractor's track; the
    trailer's is empty.

    Its box reaches from the tractor's front to the trailer's rear; where one of both is
    not there, its angle to the other passes from that before to that after, and beyond
    these to 0 within STRAIGHTENS frames.
    """
    pair = [tractor, trailer]
    states = recording.states.copy()
    valid = recording.valid.copy()
    size = recording.size.astype(float)
    there = valid[:, pair]
    front, rear = _ends(states[:, pair], size[pair, 0])
    both = np.asarray(there.all(1))
    reach = np.linalg.norm(front[both, 0] - rear[both, 1], axis=-1)
    length = float(np.median(reach))
    alone = np.where(there[:, :1], states[:, tractor], states[:, trailer])
    chord = front[:, 0] - rear[:, 1]
    angles = [_angle_to_chord(chord, states[:, each, 2], known=both) for each in pair]
    along = alone[:, 2] + np.where(there[:, 0], *angles)
    direction = np.stack([np.cos(along), np.sin(along)], -1)
    direction = np.where(
        both[:, None],
        chord / np.maximum(np.linalg.norm(chord, axis=-1), 1e-6)[:, None],
        direction,
    )
    middle = np.where(
        there[:, :1],
        front[:, 0] - direction * length / 2,
        rear[:, 1] + direction * length / 2,
    )
    heading = np.arctan2(direction[:, 1], direction[:, 0])
    joined = np.concatenate([middle, heading[:, None], alone[:, 3:]], 1)
    either = np.asarray(there.any(1))
    states[:, tractor] = np.where(either[:, None], joined, 0.0)
    valid[:, tractor] = either
    valid[:, trailer] = False
    size[tractor] = length, size[pair, 1].max()
    heights = recording.heights
    if heights is not None:
        heights = heights.copy()
        heights[:, tractor] = np.where(
            there[:, 0], heights[:, tractor], heights[:, trailer]
        )
    coupled = (*recording.coupled, tractor)
    return replace(
        recording,
        states=states,
        valid=valid,
        size=size,
        heights=heights,
        coupled=coupled,
    )


def _angle_to_chord(
    chord: np.ndarray, heading: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Returns the angles [F] rad from a heading to a chord, interpolated where the
    chord is unknown.

    Args:
        chord: [F, 2] m.
        heading: [F] rad.
        known: [F] bool, at one frame at least.
    """
    frames = np.flatnonzero(known)
    angle = wrap(np.arctan2(chord[frames, 1], chord[frames, 0]) - heading[frames])
    ends = frames[0] - STRAIGHTENS, frames[-1] + STRAIGHTENS
    return np.interp(
        np.arange(len(known)), [ends[0], *frames, ends[1]], [0.0, *angle, 0.0]
    )
