"""Recorded tracks and lights on a grid of 10 Hz."""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from e2rl.run.errors import InputError
from e2rl.scenes.paths import (
    direction,
    wrap,
)
from e2rl.scenes.recording import (
    DT,
    FEW_FRAMES,
)
from e2rl.scenes.runs import (
    first_valid,
    last_valid,
)
from e2rl.scenes.smoothing import TOP_SPEED

FRAME_STEPS = (0.005, 1.25)  # s, median step of a log: 200 to 0.8 Hz
LONGEST_PAUSE = 60.0  # s from one frame of a log to the next
MAX_GAP = 0.55  # s without any frame of the log that is bridged (2 Hz annotations)
NEAR = 0.02  # s from a grid frame to the frame that stands for it
ON_GRID = 1e-3  # s from a grid frame at which a frame is this grid frame
REGULAR = 0.1  # quantile of the steps of a track that is annotated at a lower rate
SPARSE = 1.5  # times the log's step, beyond which a track's is a lower rate
FLIP = 2.0  # rad from one frame to the next, which no vehicle turns


class Tracks(NamedTuple):
    """Tracks at 10 Hz: states [G, A, 4], 0 where they are not valid [G, A]; heights
    [G, A] m, None where the log knows none."""

    states: ndarray
    valid: ndarray
    heights: ndarray | None


def resample_uniform(
    states: ndarray,
    valid: ndarray,
    ts: ndarray,
    heights: ndarray | None = None,
) -> Tracks:
    """Returns tracks on a grid of DT from ts[0] on.

    A grid frame is interpolated between the track's own valid frames before and after
    it, so that invalid rows never count, and is valid where `_bridged` allows this.
    Where it does not, as at the ends of a track, the log's frame nearest to the grid
    frame may still be a valid one of the track within NEAR: then it is extrapolated
    from there, along its recorded speed where it is alone.

    Args:
        states: of the log's frames [F, A, 4]: x, y [m], heading [rad], signed speed
            [m/s], 0 where unknown.
        valid: where they are recorded [F, A].
        ts: their time stamps [F] s, ascending; frames of one time stamp become one.
        heights: [F, A] m; all alike, or not finite, where the log knows none. An
            unknown one is the nearest of its track in time, NaN where there is none.

    Returns:
        The tracks, where they are valid, and their heights.

    Raises:
        InputError: fewer than two time stamps, or such as descend or are not in
            seconds.
    """
    levels = None if heights is None else _filled_heights(heights, valid, ts)
    if levels is not None:
        states = np.concatenate([states, levels[..., None]], -1)
    states, valid, ts = _merge_equal_stamps(states, valid, ts)
    _check_stamps(ts)
    ts = ts - ts[0]
    grid = np.arange(int((ts[-1] + NEAR) / DT) + 1) * DT
    gaps = _longest_gaps(valid, ts)
    latest = last_valid(valid)
    earliest = first_valid(valid)
    before = latest[np.searchsorted(ts, grid + ON_GRID, side="right")]
    after = earliest[np.searchsorted(ts, grid - ON_GRID)]
    between = _bridged(
        before,
        after,
        ts=ts,
        gaps=gaps,
    )
    frame = latest_frames(ts, len(grid))
    offset = (grid - ts[frame])[:, None]
    near = (np.abs(offset) <= NEAR) & valid[frame]
    inner = np.where(offset > 0, latest[frame], earliest[frame + 1])
    frame = frame[:, None]
    low = np.minimum(inner, frame)
    high = np.maximum(inner, frame)
    inner = np.where(
        _bridged(
            low,
            high,
            ts=ts,
            gaps=gaps,
        ),
        inner,
        frame,
    )
    before = np.where(between, before, np.minimum(inner, frame))
    after = np.where(between, after, np.maximum(inner, frame))
    out = _interpolate(
        states,
        ts,
        grid=grid,
        before=before,
        after=after,
    )
    alone = near & ~between & (before == after)
    speed = np.clip(out[..., 3], -TOP_SPEED, TOP_SPEED)
    distance = np.where(alone, speed * offset, 0.0)
    out[..., :2] += distance[..., None] * direction(out[..., 2])
    recorded = between | near
    out = np.where(recorded[..., None], out, 0.0)
    resampled = None if levels is None else out[..., 4]
    return Tracks(np.ascontiguousarray(out[..., :4]), recorded, heights=resampled)


def latest_frames(ts: ndarray, count: int) -> ndarray:
    """Returns the log's frames [count] that hold at the grid times 0, DT, ...: the
    nearest within NEAR, else the last before.

    ts: the time stamps [F] s of the log's frames, ascending from 0 on.
    """
    grid = np.arange(count) * DT
    before = np.maximum(np.searchsorted(ts, grid + ON_GRID, side="right") - 1, 0)
    after = np.minimum(before + 1, len(ts) - 1)
    ahead = ts[after] - grid
    return np.where((ahead <= NEAR) & (ahead < grid - ts[before] - 1e-6), after, before)


def _check_stamps(ts: ndarray) -> None:
    if len(ts) < 2:
        raise InputError(FEW_FRAMES)
    step = np.diff(ts)
    median = float(np.median(step))
    usual = FRAME_STEPS[0] <= median <= FRAME_STEPS[1] and step.max() < LONGEST_PAUSE
    if not (usual and (step > 0).all()):
        raise InputError(
            f"time stamps do not increase in seconds (median step {median:g}); "
            "repair metadata.ts"
        )


def _filled_heights(
    heights: ndarray,
    valid: ndarray,
    ts: ndarray,
) -> ndarray | None:
    """Heights [F, A] m where tracks are valid [F, A], each unknown one as the nearest
    in time; None where the log knows none."""
    finite = valid & np.isfinite(heights)
    if not finite.any() or np.ptp(heights[finite]) == 0:
        return None
    filled = np.where(valid, heights, 0.0)
    for agent in np.flatnonzero((valid & ~finite).any(0)):
        frames = np.flatnonzero(finite[:, agent])
        if not len(frames):
            filled[:, agent] = np.nan
            continue
        nearest = np.searchsorted((ts[frames[1:]] + ts[frames[:-1]]) / 2, ts)
        filled[:, agent] = heights[frames[nearest], agent]
    return filled


def _merge_equal_stamps(
    states: ndarray,
    valid: ndarray,
    ts: ndarray,
) -> tuple[ndarray, ndarray, ndarray]:
    """States, valid and time stamps without repeated stamps; of a track the last valid
    frame at a stamp is kept."""
    repeated = np.flatnonzero(np.diff(ts) == 0)
    if not len(repeated):
        return states, valid, ts
    states = states.copy()
    valid = valid.copy()
    for frame in repeated:
        missing = valid[frame] & ~valid[frame + 1]
        states[frame + 1, missing] = states[frame, missing]
        valid[frame + 1, missing] = True
    states = np.delete(states, repeated, axis=0)
    return states, np.delete(valid, repeated, axis=0), np.delete(ts, repeated)


def _longest_gaps(valid: ndarray, ts: ndarray) -> tuple[ndarray, ndarray]:
    """The longest times [s] between two frames of each track [A] that are bridged.

    First, where the whole log has no frame between them, which says nothing: MAX_GAP.
    Second, across frames that the log has, but not the track, which was not seen then:
    DT, as no log at 10 Hz would know better. Both as far as the track is annotated at
    most (every fifth frame, say), a step and a half of a slow log or track, at most
    FRAME_STEPS[1].
    """
    usual = np.median(np.diff(ts))
    step = np.full(valid.shape[1], usual)
    for agent in np.flatnonzero(valid.sum(0) > 2):
        step[agent] = np.quantile(np.diff(ts[valid[:, agent]]), REGULAR)
    slow = SPARSE * np.minimum(step, FRAME_STEPS[1])
    slow = np.where(step > SPARSE * usual, slow, 0.0)
    lacking = max(MAX_GAP, SPARSE * float(usual))
    return np.maximum(lacking, slow), np.maximum(DT, slow)


def _bridged(
    before: ndarray,
    after: ndarray,
    *,
    ts: ndarray,
    gaps: tuple[ndarray, ndarray],
) -> ndarray:
    """Whether two successive valid frames [G, A] of a track are near enough to
    interpolate between them; gaps: see `_longest_gaps`."""
    exists = (before >= 0) & (after < len(ts))
    gap = ts[np.where(exists, after, 0)] - ts[np.where(exists, before, 0)]
    lacking, unseen = gaps
    longest = np.where(after - before <= 1, lacking, unseen)
    return exists & (gap <= longest + ON_GRID)


def _interpolate(
    states: ndarray,
    ts: ndarray,
    *,
    grid: ndarray,
    before: ndarray,
    after: ndarray,
) -> ndarray:
    """States [G, A, C] at the times grid [G] on the lines through two frames [G, A]
    each, that may be one.

    Headings turn the short way; a heading that flips is the nearer frame's.
    """
    agent = np.arange(states.shape[1])
    first = states[before, agent]
    last = states[after, agent]
    span = ts[after] - ts[before]
    share = (grid[:, None] - ts[before]) / np.where(span > 0, span, 1.0)
    weight = np.where(span > 0, share, 0.0)
    out = first + weight[..., None] * (last - first)
    turn = wrap(last[..., 2] - first[..., 2])
    nearer = np.round(np.clip(weight, 0, 1))
    turning = np.where(np.abs(turn) > FLIP, nearer, weight)
    out[..., 2] = first[..., 2] + turning * turn
    return out
