"""Runs: frames on end at which a track is valid."""

from typing import NamedTuple

import numpy as np
from numpy import ndarray


class Runs(NamedTuple):
    """Runs [R]: of which track, from which frame on, before which frame."""

    agent: ndarray
    start: ndarray
    end: ndarray


def runs_of(valid: ndarray) -> Runs:
    """Returns the runs of tracks that are valid [F, A], track by track."""
    padded = np.pad(valid.T, ((0, 0), (1, 1)))
    edge = np.diff(padded.astype(np.int8))
    agent, start = np.nonzero(edge == 1)
    return Runs(agent, start, end=np.nonzero(edge == -1)[1])


def last_valid(valid: ndarray) -> ndarray:
    """Returns the last valid frame of each track before frames 0 .. F [F + 1, A], -1
    for none."""
    frame = np.where(valid, np.arange(len(valid))[:, None], -1)
    padded = np.pad(frame, ((1, 0), (0, 0)), constant_values=-1)
    return np.maximum.accumulate(padded, axis=0)


def first_valid(valid: ndarray) -> ndarray:
    """Returns the first valid frame of each track from frames 0 .. F on [F + 1, A], F
    for none."""
    return len(valid) - 1 - last_valid(valid[::-1])[::-1]
