"""Trailers that a log records as vehicles of their own: which these are, and what
becomes of them.

Simulated traffic would drive a trailer as a vehicle that follows its tractor, and
farther and farther behind it.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from e2rl.scenes.paths import (
    direction,
    wrap,
)
from e2rl.scenes.recording import (
    DT,
    VEHICLE,
    Recording,
)

DRIVEN = 5.0  # m that a pair drives
DRIVES = 1.0  # m/s above which its frames count
FRAMES = 30  # of a pair that drives: followers keep a distance for a second or two, too
REACH = 2.5  # m at most from a tractor's rear to its trailer's front
ASIDE = 0.5  # m at most by which that front is beside that rear, in line
OVERLAP = 0.5  # m at most by which it is before it
HEADWAY = 0.25  # s: nobody follows another vehicle at that distance
PLAY = 0.2  # m by which that distance varies, in nine of ten frames
ALIGNED = 0.2  # rad between both up to which they are one long box
LONGEST = 5  # vehicles of a road train
STRAIGHTENS = 20  # frames in which a trailer that is not seen comes in line
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
            turns = _turns(recording, tractor, trailer)
            change = _marked if turns else _joined
            recording = change(recording, tractor, trailer)
            repairs[TURNING if turns else JOINED] += 1
    return replace(recording, repairs=repairs)


def _pairs(recording: Recording) -> list[tuple[int, int]]:
    """Returns tractors and their trailers: vehicles that drive at one distance from
    rear to front, too short to follow.

    A vehicle is in one pair at most: the next one of a road train is found once the
    first are joined.
    """
    states = recording.states
    valid = recording.valid
    speed = np.abs(states[..., 3]) * valid
    drives = (speed.sum(0) * DT > DRIVEN) & (recording.agent_type == VEHICLE)
    moving = (speed > DRIVES) & drives
    front, rear = _ends(states, recording.size[:, 0])
    fixed = {*recording.all_egos(), *recording.towed}  # no trailers
    candidates = []
    for tractor, trailer in sorted(
        _near_pairs(
            front,
            rear,
            moving,
            valid,
        )
    ):
        frames = np.flatnonzero(moving[:, tractor] & valid[:, trailer])
        if len(frames) < FRAMES or trailer in fixed:
            continue
        offset = front[frames, trailer] - rear[frames, tractor]
        heading = states[frames, tractor, 2]
        turn = heading - states[frames, trailer, 2]
        if not _behind(offset, heading, turn):
            continue
        distances = np.linalg.norm(offset, axis=-1)
        middle = np.median(distances)
        play = np.quantile(np.abs(distances - middle), 0.9)
        if middle < min(REACH, HEADWAY * speed[frames, tractor].max()) and play < PLAY:
            candidates.append((middle, tractor, trailer))
    pairs = []
    taken = set[int]()
    for _, tractor, trailer in sorted(candidates):
        if taken.isdisjoint((tractor, trailer)):
            pairs.append((tractor, trailer))
            taken |= {tractor, trailer}
    return pairs


def _near_pairs(
    front: ndarray,
    rear: ndarray,
    moving: ndarray,
    valid: ndarray,
) -> set[tuple[int, int]]:
    """Returns pairs of tracks of which the first moves and has the other's front within
    REACH of its rear at a frame.

    front, rear: [F, A, 2] m; moving, valid: [F, A] bool.
    """
    pairs = set()
    driving = moving.any(0)
    for frame in np.flatnonzero(moving.any(1)):
        tractors = np.flatnonzero(moving[frame])
        trailers = np.flatnonzero(valid[frame] & driving)
        tree = cKDTree(front[frame, trailers])
        near = tree.query_ball_point(rear[frame, tractors], REACH)
        for tractor, indices in zip(tractors.tolist(), near, strict=True):
            pairs |= {(tractor, int(trailers[index])) for index in indices}
    return {(tractor, trailer) for tractor, trailer in pairs if tractor != trailer}


def _behind(
    offset: ndarray,
    heading: ndarray,
    turn: ndarray,
) -> bool:
    """Returns whether a trailer's front is behind its tractor's rear, and not beside
    it, where both are in line.

    offset: [frames, 2] m from that rear to that front; heading [frames] rad: the
    tractor's; turn [frames] rad: from the trailer's to it.
    """
    in_line = np.abs(wrap(turn)) < ALIGNED
    if not in_line.any():
        return True
    unit = direction(heading)
    along = (offset * unit).sum(-1)[in_line]
    across = offset[:, 1] * unit[:, 0] - offset[:, 0] * unit[:, 1]
    return bool(
        np.median(np.abs(across[in_line])) < ASIDE and np.median(along) < OVERLAP
    )


def _ends(states: ndarray, length: ndarray) -> tuple[ndarray, ndarray]:
    """Returns the middles of the fronts and of the rears [F, A, 2] m of boxes at states
    [F, A, 4]; length [A] m."""
    ahead = direction(states[..., 2]) * length[:, None] / 2
    return states[..., :2] + ahead, states[..., :2] - ahead


def _turns(
    recording: Recording,
    tractor: int,
    trailer: int,
) -> bool:
    """Returns whether a trailer is at an angle to its tractor at any frame."""
    both = recording.valid[:, [tractor, trailer]].all(1)
    headings = recording.states[both, :, 2]
    angle = np.abs(wrap(headings[:, tractor] - headings[:, trailer]))
    return bool(np.quantile(angle, 0.95) > ALIGNED)


def _marked(
    recording: Recording,
    tractor: int,
    trailer: int,
) -> Recording:
    """Returns the recording with a trailer that only a replay shows; without it, where
    the ego is the tractor."""
    if tractor in recording.all_egos():
        valid = recording.valid.copy()
        valid[:, trailer] = False
        return replace(recording, valid=valid)
    return replace(recording, towed=(*recording.towed, trailer))


def _joined(
    recording: Recording,
    tractor: int,
    trailer: int,
) -> Recording:
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
    recorded = valid[:, pair]
    pulled = recorded[:, :1]
    both = np.asarray(recorded.all(1))
    front, rear = _ends(states[:, pair], size[pair, 0])
    chord = front[:, 0] - rear[:, 1]
    distance = np.linalg.norm(chord, axis=-1)
    length = float(np.median(distance[both]))
    alone = np.where(pulled, states[:, tractor], states[:, trailer])
    angles = [_angle_to_chord(chord, states[:, track, 2], both) for track in pair]
    angle = np.where(pulled[:, 0], angles[0], angles[1])
    unit = direction(alone[:, 2] + angle)
    unit = np.where(both[:, None], chord / np.maximum(distance, 1e-6)[:, None], unit)
    half = unit * length / 2
    middle = np.where(pulled, front[:, 0] - half, rear[:, 1] + half)
    heading = np.arctan2(unit[:, 1], unit[:, 0])
    joined = np.column_stack([middle, heading, alone[:, 3]])
    valid[:, tractor] = recorded.any(1)
    valid[:, trailer] = False
    states[:, tractor] = np.where(valid[:, [tractor]], joined, 0.0)
    size[tractor] = (length, size[pair, 1].max())
    heights = recording.heights
    if heights is not None:
        height = np.where(pulled[:, 0], heights[:, tractor], heights[:, trailer])
        heights = heights.copy()
        heights[:, tractor] = height
    return replace(
        recording,
        states=states,
        valid=valid,
        size=size,
        heights=heights,
        coupled=(*recording.coupled, tractor),
    )


def _angle_to_chord(
    chord: ndarray,
    heading: ndarray,
    recorded: ndarray,
) -> ndarray:
    """Returns the angles [F] rad from a heading [F] rad to a chord [F, 2] m,
    interpolated where the chord is not recorded [F], at one frame at least."""
    frames = np.flatnonzero(recorded)
    angle = wrap(np.arctan2(chord[frames, 1], chord[frames, 0]) - heading[frames])
    times = [frames[0] - STRAIGHTENS, *frames, frames[-1] + STRAIGHTENS]
    return np.interp(np.arange(len(recorded)), times, [0.0, *angle, 0.0])
