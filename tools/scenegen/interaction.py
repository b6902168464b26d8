"""How the vehicles of a recording interact: overlapping boxes, lateral acceleration,
and a score to choose egos by."""

import numpy as np
import torch

from e2rl.scenes import boxes
from e2rl.scenes.recording import DT


def overlap(
    first: np.ndarray,
    first_size: np.ndarray,
    second: np.ndarray,
    second_size: np.ndarray,
) -> np.ndarray:
    """`boxes.overlap` of numpy arrays, in float64."""
    arrays = (first, first_size, second, second_size)
    return boxes.overlap(
        *(torch.as_tensor(array, dtype=torch.float64) for array in arrays)
    ).numpy()


def overlapping_pairs(
    states: np.ndarray, valid: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Pairs [Q, 2] (i < j) of agents whose boxes overlap in any frame; states [F, A,
    4], valid [F, A], size [A, 2]."""
    i, j = np.triu_indices(states.shape[1], 1)
    radius = np.linalg.norm(size, axis=-1) / 2
    distance = np.linalg.norm(states[:, i, :2] - states[:, j, :2], axis=-1)
    both = valid[:, i] & valid[:, j] & (distance < radius[i] + radius[j])
    near = both.any(0)
    i = i[near]
    j = j[near]
    both = both[:, near]
    hit = overlap(states[:, i], size[i], states[:, j], size[j]) & both
    return np.stack([i, j], -1)[hit.any(0)]


def lateral_acceleration(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Speed times yaw rate [F, A] m/s^2; 0 where a frame or the one before it is
    missing."""
    result = np.zeros(states.shape[:2])
    result[1:] = _turns(states, valid) / DT * (states[1:, :, 3] + states[:-1, :, 3]) / 2
    return result


def _turns(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Heading changes [F - 1, A] rad from frame to frame; 0 where either is missing."""
    turn = np.diff(states[..., 2], axis=0)
    return np.where(valid[1:] & valid[:-1], np.arctan2(np.sin(turn), np.cos(turn)), 0.0)


def interaction_score(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """How much each vehicle interacts with the others [A]; states [F, A, 4], valid [F,
    A].

    Mean number of moving neighbours within 20 m, plus 2 for each other vehicle (at most
    4) whose path it crosses or merges with (within 2 m, headings more than 0.5 rad
    apart, less than 4 s apart in time), plus 2 for turning by more than 0.5 rad.
    """
    path = states[::5]
    seen = valid[::5]
    distance = np.linalg.norm(path[:, :, None, :2] - path[:, None, :, :2], axis=-1)
    moving = (path[..., 3] > 0.5) & seen
    others = ~np.eye(path.shape[1], dtype=bool)
    neighbours = (
        ((distance < 20) & moving[:, None, :] & seen[:, :, None] & others)
        .sum(2)
        .mean(0)
    )
    apart = np.linalg.norm(
        path[:, None, :, None, :2] - path[None, :, None, :, :2], axis=-1
    )
    angle = path[:, None, :, None, 2] - path[None, :, None, :, 2]
    late = np.abs(np.arange(len(path))[:, None] - np.arange(len(path))[None]) * 5 * DT
    meet = (
        (apart < 2)
        & (np.abs(np.sin(angle / 2)) > np.sin(0.25))
        & (late < 4)[:, :, None, None]
        & others
    )
    meet &= moving[:, None, :, None] & moving[None, :, None, :]
    crossing = np.minimum(meet.any((0, 1)).sum(1), 4)
    turned = _turns(states, valid).cumsum(0)
    turning = turned.max(0) - turned.min(0) > 0.5
    return np.where(valid.any(0), neighbours + 2 * crossing + 2 * turning, -np.inf)
