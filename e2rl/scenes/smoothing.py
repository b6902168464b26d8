"""Kinematics of recordings: one smoother for all logs, and what a causal observer knows
at a frame."""

from functools import lru_cache

import numpy as np
from numpy import ndarray
from scipy.ndimage import convolve1d

from e2rl.scenes.paths import (
    direction,
    wrap,
)
from e2rl.scenes.recording import DT
from e2rl.scenes.runs import (
    Runs,
    runs_of,
)

WINDOW, ORDER = 15, 2  # Savitzky-Golay: frames, polynomial order
CAUSAL_WINDOW = 11  # frames: the current one and 1 s of history
PAST = CAUSAL_WINDOW - 1  # frames of that history
MAX_STEP = 5.0  # m from one frame to the next; more is a jump
TOP_SPEED = 45.0  # m/s; recorded speeds beyond it are glitches
REVERSES = 0.25  # m/s: slower is noise, of 4 sd where positions jitter by 2 cm
LATELY = 5  # frames over which it is measured
REVERSED = 0.5  # m: what drives less far backwards does not reverse
AT_REST = 0.1  # m/s on average, of what has halted or not moved off
REST_FRAMES = 3  # frames before or after over which that is measured
MIN_ACCEL, MAX_ACCEL = -6.0, 4.0  # m/s^2 at a start
MAX_YAW_RATE = 1.0  # rad/s at a start


def signed_speed(velocity: ndarray, heading: ndarray) -> ndarray:
    """Speeds [...] m/s of velocities [..., 2], negative where these point backwards of
    a heading [...] rad."""
    along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    return np.where(along < 0, -1.0, 1.0) * np.linalg.norm(velocity, axis=-1)


def speeds(states: ndarray, valid: ndarray) -> ndarray:
    """Signed speeds [F, A] m/s of tracks [F, A, 4] at 10 Hz, from the mean of the
    velocities to the frames before and after, where these are recorded; 0 for a track
    of one frame."""
    velocity = np.diff(states[..., :2], axis=0) / DT
    recorded = (valid[1:] & valid[:-1])[..., None]
    total = np.zeros((*valid.shape, 2))
    count = np.zeros((*valid.shape, 1))
    for side in (slice(None, -1), slice(1, None)):
        total[side] += velocity * recorded
        count[side] += recorded
    return signed_speed(total / np.maximum(count, 1), states[..., 2])


def drop_jumps(states: ndarray, valid: ndarray) -> ndarray:
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
        valid[:, agent] = _consistent(states[:, agent, :2], valid[:, agent], run)
    return valid


def _consistent(
    track: ndarray,
    valid: ndarray,
    run: ndarray,
) -> ndarray:
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
            if np.hypot(change[0], change[1]) <= MAX_STEP * abs(frames[inner] - edge):
                keep[frames] = True
                edge = frames[outer]
    return keep


def smooth(states: ndarray, valid: ndarray) -> ndarray:
    """Tracks [F, A, 4] with smoothed positions, and the signed speed along the heading
    from their derivative.

    Savitzky-Golay per run of frames; a run shorter than WINDOW takes the longest odd
    window that it can. At both ends of a run the polynomials of its first and its last
    window go on.
    """
    out = states.copy()
    position = states[..., :2]
    velocity = np.full_like(position, np.nan)
    runs = runs_of(valid)
    windows = np.minimum(WINDOW, (runs.end - runs.start - 1) // 2 * 2 + 1)
    for window in np.unique(windows[windows > ORDER]).tolist():
        chosen = Runs._make(part[windows == window] for part in runs)
        _fit_runs(
            position,
            chosen,
            window=window,
            order=0,
            into=out[..., :2],
        )
        _fit_runs(
            position,
            chosen,
            window=window,
            order=1,
            into=velocity,
        )
    unit = direction(states[..., 2])
    along = (velocity * unit).sum(-1)
    fitted = ~np.isnan(along)
    along = np.where(fitted, along, states[..., 3])
    around = _mean_velocity(
        position,
        valid,
        back=LATELY // 2,
        ahead=LATELY // 2,
    )
    speed = _signed(along, ~fitted | ((around * unit).sum(-1) < -REVERSES))
    _stop_short_reversing(speed, valid)
    out[..., 3] = np.where(_at_rest(position, valid), 0.0, speed)
    return out


def _fit_runs(
    track: ndarray,
    runs: Runs,
    *,
    window: int,
    order: int,
    into: ndarray,
) -> None:
    """Write the fit (order 0) or its slope (order 1) of runs of a track [F, A, 2] into
    an array like it."""
    agent, start, end = runs
    half = window // 2
    centre, weights = polynomial_weights(window, order)
    middle = convolve1d(
        track[:, agent],
        centre,
        axis=0,
        mode="constant",
    )
    frame = np.arange(len(track))[:, None]
    row, run = np.nonzero((frame >= start + half) & (frame < end - half))
    into[row, agent[run]] = middle[row, run]
    for first, rows in ((start, slice(half)), (end - window, slice(half + 1, window))):
        frame = first + np.arange(window)[:, None]
        fit = np.einsum("kw,wrc->krc", weights[rows], track[frame, agent])
        into[frame[rows], agent] = fit


@lru_cache
def polynomial_weights(window: int, order: int) -> tuple[ndarray, ndarray]:
    """Of the polynomial that fits `window` samples at DT best, the value (order 0) or
    slope (order 1): at the middle sample, for a convolution [window], and at all
    samples [window, window]: row k times the samples is that at k."""
    time = np.arange(window)[:, None] - window // 2
    power = np.arange(ORDER + 1)
    basis = power * time ** np.maximum(power - 1, 0) / DT if order else time**power
    weights = basis @ np.linalg.pinv(time**power)
    return weights[window // 2, ::-1], weights


def _at_rest(position: ndarray, valid: ndarray) -> ndarray:
    """Returns where tracks [F, A, 2] m have halted, or have not yet moved off, bool [F,
    A]: a polynomial that is fitted across a hard stop goes on for half a second."""
    recorded = valid[1:] & valid[:-1]
    beyond = np.zeros_like(valid[:1])
    after = _mean_velocity(
        position,
        valid,
        back=0,
        ahead=REST_FRAMES,
    )
    before = _mean_velocity(
        position,
        valid,
        back=REST_FRAMES,
        ahead=0,
    )
    halted = np.linalg.norm(after, axis=-1) < AT_REST
    waits = np.linalg.norm(before, axis=-1) < AT_REST
    halted &= np.concatenate([recorded, beyond])
    waits &= np.concatenate([beyond, recorded])
    return halted | waits


def _stop_short_reversing(speed: ndarray, valid: ndarray) -> None:
    """Set speeds [F, A] to 0, in place, where a track drives backwards for less than
    REVERSED m: it is noise."""
    for agent, first, last in np.transpose(runs_of(valid & (speed < 0))):
        if -speed[first:last, agent].sum() * DT < REVERSED:
            speed[first:last, agent] = 0.0


def _mean_velocity(
    position: ndarray,
    valid: ndarray,
    *,
    back: int,
    ahead: int,
) -> ndarray:
    """Mean velocities [F, A, 2] m/s of tracks [F, A, 2] from `back` frames before to
    `ahead` frames after, of what is recorded there; 0 where nothing is."""
    recorded = (valid[1:] & valid[:-1])[..., None]
    step = np.where(recorded, np.diff(position, axis=0), 0.0)
    total = np.cumsum(np.concatenate([np.zeros_like(position[:1]), step]), axis=0)
    count = np.cumsum(
        np.concatenate([np.zeros((1, valid.shape[1], 1)), recorded]), axis=0
    )
    frame = np.arange(len(valid))
    first = np.maximum(frame - back, 0)
    last = np.minimum(frame + ahead, len(valid) - 1)
    seconds = np.maximum((count[last] - count[first]) * DT, DT)
    return (total[last] - total[first]) / seconds


def _signed(along: ndarray, backwards: ndarray) -> ndarray:
    """Speeds m/s along headings, at most TOP_SPEED: what is slower than REVERSES or not
    `backwards` reverses not."""
    speed = np.clip(along, -TOP_SPEED, TOP_SPEED)
    return np.where((speed > -REVERSES) | ~backwards, np.maximum(speed, 0.0), speed)


def causal_state(
    states: ndarray,
    valid: ndarray,
    frame: int,
) -> tuple[ndarray, ndarray, ndarray]:
    """State [A, 4] with a signed speed, acceleration [A] and yaw rate [A] at `frame`
    from the frames up to it only.

    Least squares over the contiguous frames that end at `frame`, at most CAUSAL_WINDOW:
    quadratic in position (linear below five frames), linear in heading. The heading
    itself is the recorded one.
    """
    window = slice(max(frame - CAUSAL_WINDOW + 1, 0), frame + 1)
    tracks = states[window]
    present = states[frame]
    time = (np.arange(window.start, window.stop) - frame) * DT
    backwards = np.logical_and.accumulate(np.flip(valid[window], 0), axis=0)
    recorded = np.flip(backwards, 0).astype(float)
    count = recorded.sum(0)
    shift = tracks[..., :2] - present[:, :2]  # small numbers, so that the fit is exact
    turn = np.where(recorded > 0, tracks[..., 2] - present[:, 2], 0.0)
    turn = np.unwrap(turn, axis=0)[..., None]
    basis = np.stack([np.ones_like(time), time, time**2], 1)
    position = _fit(
        basis,
        recorded,
        value=shift,
        quadratic=count >= 5,
    )
    heading = _fit(
        basis,
        recorded,
        value=turn,
        quadratic=np.zeros(len(count), bool),
    )
    unit = direction(present[:, 2])
    mean = _mean_velocity(
        tracks[..., :2],
        recorded > 0,
        back=LATELY - 1,
        ahead=0,
    )[-1]
    backwards = (mean * unit).sum(-1) < -REVERSES
    speed = _signed((position[:, 1] * unit).sum(-1), backwards)
    accel = np.clip(2 * (position[:, 2] * unit).sum(-1), MIN_ACCEL, MAX_ACCEL)
    single = count < 2
    speed = np.where(single, _signed(present[:, 3], single), speed)
    accel = np.where(single | (np.abs(speed) < 0.1), 0.0, accel)
    yaw_rate = np.where(single, 0.0, heading[:, 1, 0])
    start = np.column_stack([present[:, :2] + position[:, 0], present[:, 2], speed])
    return start, accel, np.clip(yaw_rate, -MAX_YAW_RATE, MAX_YAW_RATE)


def causal_past(
    states: ndarray,
    valid: ndarray,
    frame: int,
    speed: ndarray,
) -> ndarray:
    """Returns the recorded poses of agents 0.1 s, 0.2 s, ... before `frame`.

    Before the contiguous frames that end at `frame`, an agent counts as having driven
    straight.

    Args:
        states: tracks at 10 Hz [F, A, 4].
        valid: where they are recorded [F, A].
        frame: the latest that may be used.
        speed: [A] m/s there.

    Returns:
        [A, PAST, 3]: m ahead, m left and rad relative to the recorded pose at `frame`.
    """
    back = np.arange(1, PAST + 1)
    frames = np.clip(frame - back, 0, None)
    recorded = valid[frames] & (frame >= back)[:, None] & valid[frame]
    recorded = np.logical_and.accumulate(recorded, axis=0)
    dx, dy = np.moveaxis(states[frames, :, :2] - states[frame, :, :2], -1, 0)
    angle = states[frame, :, 2]
    cos = np.cos(angle)
    sin = np.sin(angle)
    turn = wrap(states[frames, :, 2] - angle)
    pose = np.stack([dx * cos + dy * sin, dy * cos - dx * sin, turn], -1)
    count = recorded.sum(0)
    poses = np.concatenate([np.zeros_like(pose[:1]), pose])
    earliest = poses[count, np.arange(len(angle))]
    seconds = np.maximum(back[:, None] - count, 0) * DT
    straight = earliest - np.stack([seconds * speed, 0 * seconds, 0 * seconds], -1)
    return np.where(recorded[..., None], pose, straight).swapaxes(0, 1)


def _fit(
    basis: ndarray,
    weight: ndarray,
    *,
    value: ndarray,
    quadratic: ndarray,
) -> ndarray:
    """Weighted least squares coefficients [A, 3, C] of value [W, A, C] on basis [W, 3];
    without the quadratic term where `quadratic` [A] is False."""
    gram = np.einsum(
        "wi,wa,wj->aij",
        basis,
        weight,
        basis,
    )
    drop = np.where(quadratic, 0.0, 1e9)
    gram += 1e-9 * np.eye(3) + drop[:, None, None] * np.diag([0.0, 0.0, 1.0])
    value = np.nan_to_num(value)
    return np.linalg.solve(
        gram,
        np.einsum(
            "wi,wa,wac->aic",
            basis,
            weight,
            value,
        ),
    )
