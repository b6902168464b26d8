"""Kinematics of recordings: one smoother for all logs, and what a causal observer knows
at a frame."""

from functools import lru_cache

import numpy as np
from scipy.ndimage import convolve1d
from scipy.signal import savgol_coeffs

from e2rl.run.errors import InputError
from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import DT, FEW_FRAMES

WINDOW, ORDER = 15, 2  # Savitzky-Golay: frames, polynomial order
CAUSAL_WINDOW = 11  # frames: the current one and 1 s of history
PAST = CAUSAL_WINDOW - 1  # frames of that history
MAX_STEP = 5.0  # m from one frame to the next; more is a jump
FRAME_STEPS = (0.005, 1.25)  # s, median step of a log: 200 to 0.8 Hz
LONGEST_PAUSE = 60.0  # s from one frame of a log to the next
MAX_GAP = (
    0.55  # s without any frame of the log that interpolation bridges (2 Hz annotations)
)
NEAR = 0.02  # s from a grid frame to the frame that stands for it
ON_GRID = 1e-3  # s from a grid frame at which a frame is this grid frame
REGULAR = 0.1  # quantile of a track's steps below which none may lie for it to be annotated at a lower rate
FLIP = 2.0  # rad from one frame to the next, which no vehicle turns
TOP_SPEED = 45.0  # m/s; recorded speeds beyond it are glitches
REVERSES, LATELY = (
    0.25,
    5,
)  # m/s, frames: slower motion backwards is noise, of 4 sd where positions jitter by 2 cm
REVERSED = 0.5  # m: what drives less far backwards does not reverse
AT_REST, REST_FRAMES = (
    0.1,
    3,
)  # m/s on average, to so many frames after or before, of what has halted or not moved off


def resample_uniform(
    states: np.ndarray, valid: np.ndarray, ts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns tracks [G, A, 4] on a grid of DT from ts[0] on, and where they are valid
    [G, A].

    A grid frame is interpolated between the track's own valid frames before and after
    it, so that invalid rows never count, and is valid where `_bridged` allows this.
    Where it does not, as at the ends of a track, the log's frame nearest to the grid
    frame may still be a valid one of the track within NEAR: then it is extrapolated
    from there, along its recorded speed where it is alone. Elsewhere the states are 0.

    Args:
        states: of the log's frames [F, A, 4]: x, y [m], heading [rad], signed speed
            [m/s], 0 where unknown.
        valid: where they are recorded [F, A].
        ts: their time stamps [F] s, ascending; frames of one time stamp become one.

    Raises:
        InputError: fewer than two time stamps, or such as descend or are not in
            seconds.
    """
    states, valid, ts = _merge_equal_stamps(states, valid, ts=ts)
    if len(ts) < 2:
        raise InputError(FEW_FRAMES)
    step = np.diff(ts)
    median = float(np.median(step))
    in_order = bool((step > 0).all())
    if not (
        in_order
        and FRAME_STEPS[0] <= median <= FRAME_STEPS[1]
        and step.max() < LONGEST_PAUSE
    ):
        raise InputError(
            f"time stamps do not increase in seconds (median step {median:g}); repair metadata.ts"
        )
    ts = ts - ts[0]
    grid = np.arange(int((ts[-1] + NEAR) / DT) + 1) * DT
    latest = _valid_until(valid)
    earliest = _valid_from(valid)
    before = latest[np.searchsorted(ts, grid + ON_GRID, side="right")]
    after = earliest[np.searchsorted(ts, grid - ON_GRID)]
    between = _bridged(before, after, valid=valid, ts=ts)
    nearest = latest_frames(ts, len(grid))[:, None]
    offset = grid[:, None] - ts[nearest]
    near = (np.abs(offset) <= NEAR) & np.take_along_axis(valid, nearest, axis=0)
    inner = np.where(offset > 0, latest[nearest[:, 0]], earliest[nearest[:, 0] + 1])
    inner = np.where(
        _bridged(
            np.minimum(inner, nearest), np.maximum(inner, nearest), valid=valid, ts=ts
        ),
        inner,
        nearest,
    )
    before = np.where(between, before, np.minimum(inner, nearest))
    after = np.where(between, after, np.maximum(inner, nearest))
    out = _interpolate(states, ts, grid=grid, before=before, after=after)
    alone = near & ~between & (before == after)
    way = np.where(alone, np.clip(out[..., 3], -TOP_SPEED, TOP_SPEED) * offset, 0.0)
    out[..., 0] += way * np.cos(out[..., 2])
    out[..., 1] += way * np.sin(out[..., 2])
    known = between | near
    return np.where(known[..., None], out, 0.0), known


def resample_heights(
    heights: np.ndarray, valid: np.ndarray, ts: np.ndarray
) -> np.ndarray | None:
    """Returns heights [G, A] m of tracks on the grid of `resample_uniform`; None where
    the log knows none.

    Where a track's height is unknown, it is the nearest in time that is known; NaN,
    where none is.

    Args:
        heights: of the log's frames [F, A] m; all alike, or not finite, where the log
            has none.
        valid: where the tracks are recorded [F, A].
        ts: time stamps [F] s.
    """
    known = valid & np.isfinite(heights)
    if not known.any() or np.ptp(heights[known]) == 0:
        return None
    states = np.zeros((*heights.shape, 4))
    states[..., 0] = np.where(valid, heights, 0.0)
    for agent in np.flatnonzero((valid & ~known).any(0)):
        frames = np.flatnonzero(known[:, agent])
        if not len(frames):
            states[:, agent, 0] = np.nan
            continue
        nearest = np.searchsorted((ts[frames[1:]] + ts[frames[:-1]]) / 2, ts)
        states[:, agent, 0] = heights[frames[nearest], agent]
    return resample_uniform(states, valid, ts=ts)[0][..., 0]


def _merge_equal_stamps(
    states: np.ndarray, valid: np.ndarray, ts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, valid and time stamps without repeated stamps; of a track the last valid
    frame at a stamp is kept."""
    repeated = np.flatnonzero(np.diff(ts) == 0)
    if not len(repeated):
        return states, valid, ts
    states = states.copy()
    valid = valid.copy()
    for frame in repeated:
        kept = valid[frame] & ~valid[frame + 1]
        states[frame + 1, kept], valid[frame + 1, kept] = states[frame, kept], True
    return (
        np.delete(states, repeated, axis=0),
        np.delete(valid, repeated, axis=0),
        np.delete(ts, repeated),
    )


def _valid_until(valid: np.ndarray) -> np.ndarray:
    """The last valid frame of each track before the frames 0 .. F [F + 1, A], -1 for
    none."""
    frame = np.where(valid, np.arange(len(valid))[:, None], -1)
    return np.maximum.accumulate(
        np.pad(frame, ((1, 0), (0, 0)), constant_values=-1), axis=0
    )


def _valid_from(valid: np.ndarray) -> np.ndarray:
    """The first valid frame of each track from the frames 0 .. F on [F + 1, A], F for
    none."""
    return len(valid) - 1 - _valid_until(valid[::-1])[::-1]


def _bridged(
    before: np.ndarray, after: np.ndarray, valid: np.ndarray, ts: np.ndarray
) -> np.ndarray:
    """Whether two successive valid frames [G, A] of a track are near enough to
    interpolate between them.

    Frames between them that the log has, but not the track, say that it was not seen:
    then they may lie DT apart, as no log at 10 Hz would know better, or as far as the
    track is annotated at most (every fifth frame, say). Frames that the whole log lacks
    say nothing: MAX_GAP. Both may be a step and a half of a slow log or track, at most
    FRAME_STEPS[1].
    """
    exists = (before >= 0) & (after < len(ts))
    before = np.where(exists, before, 0)
    after = np.where(exists, after, 0)
    gap = ts[after] - ts[before]
    step = np.diff(ts)
    own = np.full(valid.shape[1], np.median(step))
    for agent in np.flatnonzero(valid.sum(0) > 2):
        own[agent] = np.quantile(np.diff(ts[valid[:, agent]]), REGULAR)
    sparse = np.where(
        own > 1.5 * np.median(step), 1.5 * np.minimum(own, FRAME_STEPS[1]), 0.0
    )
    lacking = max(MAX_GAP, 1.5 * float(np.median(step)))
    most = np.where(
        after - before <= 1, np.maximum(lacking, sparse), np.maximum(DT, sparse)
    )
    return exists & (gap <= most + ON_GRID)


def _interpolate(
    states: np.ndarray,
    ts: np.ndarray,
    grid: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
) -> np.ndarray:
    """States [G, A, 4] at the times grid [G] on the lines through two frames [G, A]
    each, that may be one.

    Headings turn the short way; a heading that flips is the nearer frame's.
    """
    agent = np.arange(states.shape[1])
    first = states[before, agent]
    last = states[after, agent]
    span = ts[after] - ts[before]
    weight = np.where(
        span > 0, (grid[:, None] - ts[before]) / np.where(span > 0, span, 1.0), 0.0
    )
    out = first + weight[..., None] * (last - first)
    turn = wrap(last[..., 2] - first[..., 2])
    turning = np.where(np.abs(turn) > FLIP, np.round(np.clip(weight, 0, 1)), weight)
    out[..., 2] = first[..., 2] + turning * turn
    return out


def latest_frames(ts: np.ndarray, count: int) -> np.ndarray:
    """The log's frames [count] that hold at the grid times 0, DT, ...: the nearest
    within NEAR, else the last before.

    ts: the time stamps [F] s of the log's frames, ascending from 0 on.
    """
    grid = np.arange(count) * DT
    before = np.maximum(np.searchsorted(ts, grid + ON_GRID, side="right") - 1, 0)
    after = np.minimum(before + 1, len(ts) - 1)
    ahead = ts[after] - grid
    return np.where((ahead <= NEAR) & (ahead < grid - ts[before] - 1e-6), after, before)


def signed_speed(velocity: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Speeds [...] m/s of velocities [..., 2], negative where these point backwards of
    a heading [...] rad."""
    along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    return np.where(along < 0, -1.0, 1.0) * np.linalg.norm(velocity, axis=-1)


def speeds(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Signed speeds [F, A] m/s of tracks [F, A, 4] at 10 Hz, from the mean of the
    velocities to the frames before and after, where these are recorded; 0 for a track
    of one frame."""
    velocity = np.diff(states[..., :2], axis=0) / DT
    known = (valid[1:] & valid[:-1])[..., None]
    total = np.zeros((*valid.shape, 2))
    count = np.zeros((*valid.shape, 1))
    for side in (slice(None, -1), slice(1, None)):
        total[side] += velocity * known
        count[side] += known
    return signed_speed(total / np.maximum(count, 1), states[..., 2])


def drop_jumps(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """valid [F, A] without the frames that jumps (over MAX_STEP in a frame) divide from
    a track's longest run.

    A run beyond a jump is kept where it fits the frames kept before it: a glitch of a
    few frames costs these frames only. A heading costs none: `mend_headings` mends it.
    """
    valid = valid.copy()
    jump = np.linalg.norm(np.diff(states[..., :2], axis=0), axis=-1) > MAX_STEP
    jump &= valid[1:] & valid[:-1]
    for agent in np.flatnonzero(jump.any(0)):
        run = np.concatenate([[0], np.cumsum(jump[:, agent])])
        valid[:, agent] = _consistent(states[:, agent, :2], valid[:, agent], run=run)
    return valid


def _consistent(track: np.ndarray, valid: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Frames [F] of one track [F, 2] in its longest run (run [F]: number of jumps so
    far) and the runs that fit it."""
    count = np.bincount(run[valid])
    longest = count.argmax()
    keep = valid & (run == longest)
    for runs, inner, outer in (
        (range(longest + 1, len(count)), 0, -1),
        (range(longest)[::-1], -1, 0),
    ):
        edge = np.flatnonzero(keep)[outer]
        for number in runs:
            frames = np.flatnonzero(valid & (run == number))
            if not len(frames):
                continue
            change = track[frames[inner]] - track[edge]
            if np.hypot(*change) <= MAX_STEP * abs(frames[inner] - edge):
                keep[frames] = True
                edge = frames[outer]
    return keep


def smooth(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Tracks [F, A, 4] with smoothed positions, and the signed speed along the heading
    from their derivative.

    Savitzky-Golay per contiguous run of frames; a run shorter than WINDOW takes the
    longest odd window that it can. At both ends of a run the polynomials of its first
    and its last window go on.
    """
    out = states.copy()
    velocity = np.full_like(states[..., :2], np.nan)
    edge = np.diff(np.pad(valid.T, ((0, 0), (1, 1))).astype(np.int8))
    (agent, start), end = np.nonzero(edge == 1), np.nonzero(edge == -1)[1]
    windows = np.minimum(WINDOW, (end - start - 1) // 2 * 2 + 1)
    for window in np.unique(windows[windows > ORDER]).tolist():
        runs = (
            agent[windows == window],
            start[windows == window],
            end[windows == window],
        )
        for order, into in ((0, out[..., :2]), (1, velocity)):
            _fit_runs(states[..., :2], *runs, window, order, into)
    unit = np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], -1)
    along = (velocity * unit).sum(-1)
    fitted = ~np.isnan(along)
    along = np.where(fitted, along, states[..., 3])
    around = _mean_velocity(states[..., :2], valid, back=LATELY // 2, ahead=LATELY // 2)
    out[..., 3] = _signed(along, ~fitted | ((around * unit).sum(-1) < -REVERSES))
    _stop_short_reversing(out[..., 3], valid)
    out[..., 3] = np.where(_at_rest(states[..., :2], valid), 0.0, out[..., 3])
    return out


def _at_rest(position: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Returns where tracks [F, A, 2] m have halted, or have not yet moved off, bool [F,
    A]: a polynomial that is fitted across a hard stop goes on for half a second."""
    known = valid[1:] & valid[:-1]
    beyond = np.zeros_like(valid[:1])
    after = (
        np.linalg.norm(
            _mean_velocity(position, valid, back=0, ahead=REST_FRAMES), axis=-1
        )
        < AT_REST
    )
    before = (
        np.linalg.norm(
            _mean_velocity(position, valid, back=REST_FRAMES, ahead=0), axis=-1
        )
        < AT_REST
    )
    return (after & np.concatenate([known, beyond])) | (
        before & np.concatenate([beyond, known])
    )


def _stop_short_reversing(speed: np.ndarray, valid: np.ndarray) -> None:
    """Set speeds [F, A] to 0, in place, where a track drives backwards for less than
    REVERSED m: it is noise."""
    backwards = valid & (speed < 0)
    for agent in np.flatnonzero(backwards.any(0)):
        edges = np.flatnonzero(np.diff(np.pad(backwards[:, agent], 1)))
        for first, last in edges.reshape(-1, 2):
            if -speed[first:last, agent].sum() * DT < REVERSED:
                speed[first:last, agent] = 0.0


def _mean_velocity(
    position: np.ndarray, valid: np.ndarray, back: int, ahead: int
) -> np.ndarray:
    """Mean velocities [F, A, 2] m/s of tracks [F, A, 2] from `back` frames before to
    `ahead` frames after, of what is recorded there; 0 where nothing is."""
    known = (valid[1:] & valid[:-1])[..., None]
    step = np.where(known, np.diff(position, axis=0), 0.0)
    total = np.cumsum(np.concatenate([np.zeros_like(position[:1]), step]), axis=0)
    count = np.cumsum(np.concatenate([np.zeros((1, valid.shape[1], 1)), known]), axis=0)
    frame = np.arange(len(valid))
    first = np.maximum(frame - back, 0)
    last = np.minimum(frame + ahead, len(valid) - 1)
    return (total[last] - total[first]) / np.maximum(
        (count[last] - count[first]) * DT, DT
    )


def _signed(along: np.ndarray, backwards: np.ndarray) -> np.ndarray:
    """Speeds m/s along headings, at most TOP_SPEED: what is slower than REVERSES or not
    `backwards` reverses not."""
    speed = np.clip(along, -TOP_SPEED, TOP_SPEED)
    return np.where((speed > -REVERSES) | ~backwards, np.maximum(speed, 0.0), speed)


def _fit_runs(
    track: np.ndarray,
    agent: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    window: int,
    order: int,
    into: np.ndarray,
) -> None:
    """Write the fit (order 0) or its slope (order 1) of runs [R] of a track [F, A, 2]
    into an array like it; agent, start and end [R]: whose runs, from which frame to
    before which."""
    half, (centre, weights) = window // 2, polynomial_weights(window, order)
    middle = convolve1d(track[:, agent], centre, axis=0, mode="constant")
    frame = np.arange(len(track))[:, None]
    row, run = np.nonzero((frame >= start + half) & (frame < end - half))
    into[row, agent[run]] = middle[row, run]
    for first, rows in ((start, slice(half)), (end - window, slice(half + 1, window))):
        frame = first + np.arange(window)[:, None]
        into[frame[rows], agent] = np.einsum(
            "kw,wrc->krc", weights[rows], track[frame, agent]
        )


@lru_cache
def polynomial_weights(window: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the polynomial that fits `window` samples at DT best, the value (order 0) or
    slope (order 1): at the middle sample, for a convolution [window], and at all
    samples [window, window]: row k times the samples is that at k."""
    time = np.arange(window)[:, None] - window // 2
    power = np.arange(ORDER + 1)
    basis = power * time ** np.maximum(power - 1, 0) / DT if order else time**power
    return savgol_coeffs(window, ORDER, order, DT), basis @ np.linalg.pinv(time**power)


def causal_state(
    states: np.ndarray, valid: np.ndarray, frame: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State [A, 4] with a signed speed, acceleration [A] and yaw rate [A] at `frame`
    from the frames up to it only.

    Least squares over the contiguous frames that end at `frame`, at most CAUSAL_WINDOW:
    quadratic in position (linear below five frames), linear in heading. The heading
    itself is the recorded one.
    """
    first = max(frame - CAUSAL_WINDOW + 1, 0)
    time = (np.arange(first, frame + 1) - frame) * DT
    known = np.flip(
        np.logical_and.accumulate(np.flip(valid[first : frame + 1], 0), axis=0), 0
    ).astype(float)
    count = known.sum(0)
    shift = (
        states[first : frame + 1, :, :2] - states[frame, :, :2]
    )  # small numbers, so that the fit is exact
    turned = np.unwrap(
        np.where(known > 0, states[first : frame + 1, :, 2] - states[frame, :, 2], 0.0),
        axis=0,
    )
    basis = np.stack([np.ones_like(time), time, time**2], 1)
    position = _fit(basis, known, value=shift, quadratic=count >= 5)
    turn = _fit(
        basis, known, value=turned[..., None], quadratic=np.zeros_like(count, bool)
    )
    angle = states[frame, :, 2]
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    lately = _mean_velocity(
        states[first : frame + 1, :, :2], known > 0, back=LATELY - 1, ahead=0
    )[-1]
    speed = _signed(
        (position[:, 1] * unit).sum(-1), (lately * unit).sum(-1) < -REVERSES
    )
    accel = np.clip(2 * (position[:, 2] * unit).sum(-1), -6.0, 4.0)
    single = count < 2
    speed = np.where(single, _signed(states[frame, :, 3], single), speed)
    accel = np.where(single | (np.abs(speed) < 0.1), 0.0, accel)
    yaw_rate = np.where(single, 0.0, turn[:, 1, 0])
    fitted = states[frame, :, :2] + position[:, 0]
    return (
        np.concatenate([fitted, angle[:, None], speed[:, None]], 1),
        accel,
        np.clip(yaw_rate, -1.0, 1.0),
    )


def causal_past(
    states: np.ndarray, valid: np.ndarray, frame: int, speed: np.ndarray
) -> np.ndarray:
    """Recorded poses [A, PAST, 3] of the agents 0.1 s, 0.2 s, ... before `frame`.

    m ahead, m left and rad relative to the recorded pose at `frame`; speed [A] m/s at
    `frame`. Before the contiguous frames that end at `frame`, an agent counts as having
    driven straight at this speed.
    """
    back = np.arange(1, PAST + 1)
    frames = np.clip(frame - back, 0, None)
    known = np.logical_and.accumulate(
        valid[frames] & (frame >= back)[:, None] & valid[frame], axis=0
    )
    dx, dy = np.moveaxis(states[frames, :, :2] - states[frame, :, :2], -1, 0)
    angle = states[frame, :, 2]
    cos = np.cos(angle)
    sin = np.sin(angle)
    pose = np.stack(
        [dx * cos + dy * sin, dy * cos - dx * sin, wrap(states[frames, :, 2] - angle)],
        -1,
    )
    first = np.concatenate([np.zeros_like(pose[:1]), pose])[
        known.sum(0), np.arange(len(angle))
    ]  # the earliest known
    since = np.maximum(back[:, None] - known.sum(0), 0) * DT
    straight = first - np.stack([since * speed, 0 * since, 0 * since], -1)
    return np.where(known[..., None], pose, straight).swapaxes(0, 1)


def _fit(
    basis: np.ndarray, weight: np.ndarray, value: np.ndarray, quadratic: np.ndarray
) -> np.ndarray:
    """Weighted least squares coefficients [A, 3, C] of value [W, A, C] on basis [W, 3];
    without the quadratic term where `quadratic` [A] is False."""
    gram = np.einsum("wi,wa,wj->aij", basis, weight, basis)
    drop = np.where(quadratic, 0.0, 1e9)
    gram += 1e-9 * np.eye(3) + drop[:, None, None] * np.diag([0.0, 0.0, 1.0])
    return np.linalg.solve(
        gram, np.einsum("wi,wa,wac->aic", basis, weight, np.nan_to_num(value))
    )
