"""Which vehicle is the ego in logs that name none: one for each window."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from e2rl.scenes.recording import (
    HISTORY,
    VEHICLE,
    Recording,
)

MOVES = 0.5  # m/s: a vehicle that moves


def with_egos(
    recording: Recording,
    starts: Sequence[int] | None,
    steps: int,
    started: Iterable[int] = (),
) -> Recording:
    """Returns a recording with an ego for each window that has a vehicle at its start.

    Args:
        recording: without an ego.
        starts: start frames of the windows; None: those of `Recording.windows`.
        steps: simulated steps of a scene.
        started: tracks that are the ego wherever they are there at the start.
    """
    frames = recording.start_frames(starts, steps) or [HISTORY]
    egos = {}
    for start in frames:
        span = slice(start, start + steps + 1) if len(frames) > 1 else slice(None)
        egos[start] = _ego(
            recording,
            start,
            span=span,
            started=started,
        )
    present = [ego for ego in egos.values() if ego >= 0]
    return replace(recording, egos=egos, ego=present[0] if present else -1)


def _ego(
    recording: Recording,
    start: int,
    *,
    span: slice,
    started: Iterable[int],
) -> int:
    """Returns the ego's track in a window; -1 where no vehicle is there at its start.

    One of `started`, else the vehicle that moves for the most frames of `span`, of
    several the one that drives farthest.
    """
    vehicles = recording.valid & (recording.agent_type == VEHICLE)
    present = vehicles[min(start, len(vehicles) - 1)]
    for track in started:
        if present[track]:
            return track
    if not present.any():
        return -1
    speed = np.abs(recording.states[span, :, 3]) * vehicles[span]
    moves = (speed > MOVES).sum(0) * present
    return int(np.lexsort((speed.sum(0), moves, present))[-1])
