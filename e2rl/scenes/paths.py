"""Polylines over their arc length, and angles."""

from collections.abc import (
    Iterable,
    Sized,
)
from typing import TypeVar

import numpy as np
from numpy import ndarray
from torch import Tensor

Angle = TypeVar(
    "Angle",
    float,
    ndarray,
    Tensor,
)

WHEELBASE = 0.6  # of the body's length, around its centre


def wrap(angle: Angle) -> Angle:
    """Angles [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def direction(angle: ndarray | float) -> ndarray:
    """Unit vectors [..., 2] of angles [...] rad."""
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def stacked(lines: Iterable[ndarray]) -> ndarray:
    """Points [P, 2] of polylines, one after another."""
    return np.concatenate([np.zeros((0, 2)), *lines])


def part_of(parts: Iterable[Sized]) -> ndarray:
    """Index [P] of the part that each item belongs to, of parts one after another."""
    counts = [len(part) for part in parts]
    return np.repeat(np.arange(len(counts)), counts)


def arc_length(points: ndarray) -> ndarray:
    """Cumulative length [..., P] of polylines [..., P, 2], starting at 0."""
    step = points[..., 1:, :] - points[..., :-1, :]
    arc = np.zeros(points.shape[:-1])
    np.cumsum(
        np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2),
        axis=-1,
        out=arc[..., 1:],
    )
    return arc


def points_at(
    line: ndarray,
    arc: ndarray,
    at: ndarray,
) -> ndarray:
    """Points [Q, 2] of a polyline [P, 2] at arc lengths `at` [Q]; arc [P]: its own. It
    goes on straight at its end."""
    points = np.stack([np.interp(at, arc, line[:, axis]) for axis in range(2)], 1)
    beyond = at > arc[-1]
    if beyond.any():
        last = line[-1] - line[-2]
        unit = last / np.linalg.norm(last)
        points[beyond] = line[-1] + (at[beyond] - arc[-1])[:, None] * unit
    return points


def resample(points: ndarray, spacing: float) -> ndarray:
    """Points [Q, 2] nearly every `spacing` m along points [P, 2]: the length is divided
    evenly."""
    arc = arc_length(points)
    count = max(int(np.ceil(arc[-1] / spacing)), 1) + 1
    at = np.arange(count) * (arc[-1] / (count - 1))
    at[-1] = arc[-1]
    return points_at(points, arc, at=at)


def tangent_angle(points: ndarray) -> ndarray:
    """Direction [P] rad of a polyline [P, 2] at its points."""
    x, y = _tangent(points).T
    return np.arctan2(y, x)


def _tangent(points: ndarray) -> ndarray:
    """`np.gradient(points, axis=0)` of points [P, 2], which takes twice as long or more of
    few."""
    tangent = np.empty(points.shape)
    np.subtract(points[2:], points[:-2], out=tangent[1:-1])
    tangent[1:-1] /= 2
    tangent[0] = points[1] - points[0]
    tangent[-1] = points[-1] - points[-2]
    return tangent


def shift_left(points: ndarray, distance: ndarray | float) -> ndarray:
    """Polyline [P, 2] shifted `distance` m (scalar or [P]) to its left."""
    tangent = _tangent(points)
    tangent /= np.maximum(
        np.linalg.norm(
            tangent,
            axis=-1,
            keepdims=True,
        ),
        1e-9,
    )
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    return points + np.broadcast_to(distance, len(points))[:, None] * normal
