"""How vehicles of a recording meet: overlapping boxes, and who has the most to do with the others."""

import numpy as np

from e2rl.scene.recording import DT


def corners(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Corners [..., 4, 2] of boxes with pose [..., >=3] (x, y, heading) and size [..., 2] (length, width)."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    along = np.stack([cos, sin], -1)[..., None, :] * size[..., None, :1] / 2
    across = np.stack([-sin, cos], -1)[..., None, :] * size[..., None, 1:] / 2
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return pose[..., None, :2] + signs[:, :1] * along + signs[:, 1:] * across


def overlap(pose_a: np.ndarray, size_a: np.ndarray, pose_b: np.ndarray, size_b: np.ndarray) -> np.ndarray:
    """Whether boxes a and b [...] overlap, by the separating axis theorem; leading dims broadcast."""
    centre = pose_b[..., :2] - pose_a[..., :2]
    turn = pose_b[..., 2] - pose_a[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    hit = np.ones(np.broadcast_shapes(pose_a.shape[:-1], pose_b.shape[:-1]), bool)
    for pose, own, other in ((pose_a, size_a, size_b), (pose_b, size_b, size_a)):
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        along = np.abs(c * centre[..., 0] + s * centre[..., 1])
        across = np.abs(c * centre[..., 1] - s * centre[..., 0])
        reach_along = own[..., 0] + other[..., 0] * cos + other[..., 1] * sin
        reach_across = own[..., 1] + other[..., 0] * sin + other[..., 1] * cos
        hit &= (along < reach_along / 2) & (across < reach_across / 2)
    return hit


def overlapping_pairs(states: np.ndarray, valid: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Pairs [Q, 2] (i < j) of agents whose boxes overlap in any frame; states [F, A, 4], valid [F, A], size [A, 2]."""
    i, j = np.triu_indices(states.shape[1], 1)
    radius = np.linalg.norm(size, axis=-1) / 2
    gap = np.linalg.norm(states[:, i, :2] - states[:, j, :2], axis=-1)
    both = valid[:, i] & valid[:, j] & (gap < radius[i] + radius[j])
    near = both.any(0)
    i, j, both = i[near], j[near], both[:, near]
    hit = overlap(states[:, i], size[i], states[:, j], size[j]) & both
    return np.stack([i, j], -1)[hit.any(0)]


def lateral_acceleration(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Speed times yaw rate [F, A] m/s^2, 0 where a frame or a neighbour of it is missing."""
    turn = np.diff(states[..., 2], axis=0)
    rate = np.arctan2(np.sin(turn), np.cos(turn)) / DT
    known = valid[1:] & valid[:-1]
    result = np.zeros(states.shape[:2])
    result[1:] = np.where(known, rate * (states[1:, :, 3] + states[:-1, :, 3]) / 2, 0.0)
    return result


def interaction_score(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """How much each vehicle has to do with the others [A]; states [F, A, 4], valid [F, A].

    Mean number of moving neighbours within 20 m, plus 2 for each other whose path it crosses or meets (within 2 m, more
    than 0.5 rad apart in heading, less than 4 s apart in time; at most 4), plus 2 for turning by more than 0.5 rad.
    """
    path, seen = states[::5], valid[::5]
    gap = np.linalg.norm(path[:, :, None, :2] - path[:, None, :, :2], axis=-1)
    moving = (path[..., 3] > 0.5) & seen
    others = ~np.eye(path.shape[1], dtype=bool)
    close = ((gap < 20) & moving[:, None, :] & seen[:, :, None] & others).sum(2).mean(0)
    spread = np.linalg.norm(path[:, None, :, None, :2] - path[None, :, None, :, :2], axis=-1)
    turn = path[:, None, :, None, 2] - path[None, :, None, :, 2]
    late = np.abs(np.arange(len(path))[:, None] - np.arange(len(path))[None]) * 5 * DT
    meet = (spread < 2) & (np.abs(np.sin(turn / 2)) > np.sin(0.25)) & (late < 4)[:, :, None, None] & others
    meet &= moving[:, None, :, None] & moving[None, :, None, :]
    crossing = np.minimum(meet.any((0, 1)).sum(1), 4)
    turned = np.diff(states[..., 2], axis=0)
    turned = np.where(valid[1:] & valid[:-1], np.arctan2(np.sin(turned), np.cos(turned)), 0.0).cumsum(0)
    span = turned.max(0) - turned.min(0)
    return np.where(valid.any(0), close + 2 * crossing + 2 * (span > 0.5), -np.inf)
