"""Trailers that a log records as vehicles of their own: which these are, and what becomes of them.

Simulated traffic would drive a trailer as a vehicle that follows its tractor, and farther and farther behind it.
"""

from collections import Counter
from dataclasses import replace

import numpy as np

from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import DT, VEHICLE, Recording

DRIVEN, DRIVES = 5.0, 1.0  # m that a pair drives, m/s above which its frames count
FRAMES = 10  # of a pair that drives
REACH = 2.5  # m at most from a tractor's rear to its trailer's front
HEADWAY = 0.25  # s: nobody follows another vehicle at that distance
PLAY = 0.2  # m by which that distance varies, in nine of ten frames
ALIGNED = 0.2  # rad between both up to which they are one long box
LONGEST = 5  # vehicles of a road train
JOINED = "trailers joined to their tractors"
TURNING = "trailers that turn against their tractors, which only a replay shows"


def couple(recording: Recording) -> Recording:
    """Returns the recording with the trailers that stay behind their tractors as one vehicle with them.

    Those that turn against them are marked as `towed`, but for the ego's, which are left out. Both count as repairs.

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
            recording = _marked(recording, tractor, trailer) if turns else _joined(recording, tractor, trailer)
            repairs[TURNING if turns else JOINED] += 1
    return replace(recording, repairs=repairs)


def _pairs(recording: Recording) -> list[tuple[int, int]]:
    """Returns tractors and their trailers: vehicles that drive at one distance from rear to front, too short to follow.

    A vehicle is in one pair at most: the next one of a road train is found once the first are joined.
    """
    states, valid = recording.states, recording.valid
    speed = np.abs(states[..., 3]) * valid
    drives = (speed.sum(0) * DT > DRIVEN) & (recording.agent_type == VEHICLE)
    drives[[*recording.towed]] = False
    tracks = np.flatnonzero(drives)
    front, rear = _ends(states[:, tracks], recording.size[tracks, 0])
    moving = (speed[:, tracks] > DRIVES)[:, :, None] & valid[:, tracks][:, None]
    gap = np.linalg.norm(rear[:, :, None] - front[:, None], axis=-1)  # [F, tractor, trailer]
    gap = np.where(moving, gap, np.nan)
    near = (moving.sum(0) >= FRAMES) & (np.where(moving, gap, np.inf).min(0, initial=np.inf) < REACH)
    np.fill_diagonal(near, False)
    found = []
    for one, other in np.argwhere(near):
        distances = gap[moving[:, one, other], one, other]
        middle, top = np.median(distances), speed[moving[:, one, other], tracks[one]].max()
        play = np.quantile(np.abs(distances - middle), 0.9)
        if middle < min(REACH, HEADWAY * top) and play < PLAY and tracks[other] != recording.ego:
            found.append((middle, int(tracks[one]), int(tracks[other])))
    pairs, taken = [], set[int]()
    for _, tractor, trailer in sorted(found):
        if not taken & {tractor, trailer}:
            pairs.append((tractor, trailer))
            taken |= {tractor, trailer}
    return pairs


def _ends(states: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the middles of the fronts and of the rears [F, A, 2] m of boxes at states [F, A, 4]; length [A] m."""
    ahead = np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], -1) * length[:, None] / 2
    return states[..., :2] + ahead, states[..., :2] - ahead


def _turns(recording: Recording, tractor: int, trailer: int) -> bool:
    """Returns whether a trailer is at an angle to its tractor at any frame."""
    both = recording.valid[:, tractor] & recording.valid[:, trailer]
    angle = wrap(recording.states[both, tractor, 2] - recording.states[both, trailer, 2])
    return bool(np.quantile(np.abs(angle), 0.95) > ALIGNED)


def _marked(recording: Recording, tractor: int, trailer: int) -> Recording:
    """Returns the recording with a trailer that only a replay shows; without it, where the ego is the tractor."""
    if tractor in {recording.ego, *recording.egos.values()}:
        valid = recording.valid.copy()
        valid[:, trailer] = False
        return replace(recording, valid=valid)
    return replace(recording, towed=(*recording.towed, trailer))


def _joined(recording: Recording, tractor: int, trailer: int) -> Recording:
    """Returns the recording with both as one vehicle, in the tractor's track; the trailer's is empty.

    Its box reaches from the tractor's front to the trailer's rear; where one of both is not there, it lies along the
    other.
    """
    pair = [tractor, trailer]
    states, valid, size = recording.states.copy(), recording.valid.copy(), recording.size.astype(float)
    there = valid[:, pair]
    front, rear = _ends(states[:, pair], size[pair, 0])
    both = np.asarray(there.all(1))
    reach = np.linalg.norm(front[both, 0] - rear[both, 1], axis=-1)
    length = float(np.median(reach))
    alone = np.where(there[:, :1], states[:, tractor], states[:, trailer])
    direction = np.stack([np.cos(alone[:, 2]), np.sin(alone[:, 2])], -1)
    chord = front[:, 0] - rear[:, 1]
    direction = np.where(both[:, None], chord / np.maximum(np.linalg.norm(chord, axis=-1), 1e-6)[:, None], direction)
    middle = np.where(there[:, :1], front[:, 0] - direction * length / 2, rear[:, 1] + direction * length / 2)
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
        heights[:, tractor] = np.where(there[:, 0], heights[:, tractor], heights[:, trailer])
    coupled = (*recording.coupled, tractor)
    return replace(recording, states=states, valid=valid, size=size, heights=heights, coupled=coupled)
