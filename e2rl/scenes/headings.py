"""Headings of recorded tracks, mended from motion and neighbours.

Detectors take the front of a box for its back, lose its direction for some frames, and
let what stands turn. A box is the same turned by pi, and no vehicle turns while it
stands or faster than it can be steered.
"""

import numpy as np
from numpy import ndarray
from scipy.ndimage import (
    convolve1d,
    maximum_filter1d,
    median_filter,
    minimum_filter1d,
)

from e2rl.scenes.paths import (
    direction,
    wrap,
)
from e2rl.scenes.recording import (
    DT,
    HIDDEN,
    PEDESTRIAN,
)
from e2rl.scenes.runs import (
    last_valid,
    runs_of,
)
from e2rl.scenes.smoothing import MAX_STEP

HALF = 3  # frames before and after over which the direction of motion is taken
STRAIGHT = 0.8  # of the path driven then: the least displacement with a direction
MOVES = 0.5  # m/s, above which motion has a direction
BACKWARDS = 5.0  # m/s up to which a vehicle may reverse
AGAINST = 0.5  # cosine between heading and motion, beyond which they agree or disagree
# In rad of turning from one frame to the next. Of a slow vehicle at least a fifth of
# the headings must point forwards for all to be turned forwards, (1 - SLOW / TURNED) /
# 2; with fewer it reverses, and these few are wrong.
FAST_COST = 1.0  # of a frame of fast motion backwards
SLOW_COST = 0.02  # of a frame of slow motion backwards
SLOW = 1.0  # of all such frames of a track, at most
TURNED_COST = 0.1  # of a frame that is turned round
TURNED = 1.67  # of all such frames of a track, at most
CONVENTION = 3  # so many fast tracks turned as a whole, and most, are the log's own way
SPIKES = ((7, 0.35), (21, 1.0))  # frames of a median filter, rad from it
WINDOW = 11  # frames through whose positions a line is laid
STANDS = 0.15  # m/s of that line, below which a vehicle stands
APART = 1.0  # m between two frames at which a vehicle stands at two places
NEIGHBOURS = 5  # moving frames beside a stop that say its heading
LOST = 10  # frames without the track, beyond which such neighbours say nothing
CLUSTER = 0.15  # rad about the heading that most frames of a standing vehicle agree on
HELD = 0.1  # rad that a heading must turn while it stands to count as repaired


def mend_headings(
    states: ndarray,
    valid: ndarray,
    agent_type: ndarray,
) -> tuple[ndarray, dict[str, int]]:
    """Returns tracks whose headings are neither turned round nor spiked, and the count
    of mended tracks by a phrase.

    The sign of a speed turns with its heading. Pedestrians, who turn on the spot, keep
    theirs.

    Args:
        states: tracks at 10 Hz [F, A, 4]: x, y [m], heading [rad], signed speed [m/s].
        valid: where they are recorded [F, A].
        agent_type: their types [A].
    """
    states = np.where(valid[..., None], states, 0.0)
    rides = valid & (agent_type != PEDESTRIAN)
    turned = _turned_round(states, rides)
    opposite = wrap(states[..., 2] + np.pi)
    states[..., 2] = np.where(turned, opposite, states[..., 2])
    states[..., 3] = np.where(turned, -states[..., 3], states[..., 3])
    counts = {
        "headings turned round": int(turned.any(0).sum()),
        "heading spikes": _interpolate_spikes(states, rides),
    }
    return states, {phrase: count for phrase, count in counts.items() if count}


def hold_headings(
    states: ndarray,
    valid: ndarray,
    agent_type: ndarray,
) -> tuple[ndarray, int]:
    """Returns tracks whose headings do not change while they stand, and the number of
    tracks that this turns by HELD.

    A heading passes from that before the stop to that after it; at an end of a track it
    is the other one, and where a track only stands, the one that most of its frames
    agree on.

    Args:
        states: tracks at 10 Hz [F, A, 4], already of `mend_headings`.
        valid: where they are recorded [F, A].
        agent_type: their types [A]; pedestrians are left as they are.
    """
    out = states.copy()
    count = 0
    stands = standing_frames(states[..., :2], valid) & (agent_type != PEDESTRIAN)
    for agent in np.flatnonzero(stands.any(0)):
        frames = np.flatnonzero(valid[:, agent])
        standing = stands[frames, agent]
        track = states[frames, agent]
        heading = np.unwrap(track[:, 2])
        held = _held(
            frames,
            heading,
            standing=standing,
            position=track[:, :2],
        )
        out[frames, agent, 2] = np.where(standing, wrap(held), track[:, 2])
        count += bool((np.abs(held - heading) > HELD).any())
    return out, count


def standing_frames(position: ndarray, valid: ndarray) -> ndarray:
    """Returns whether tracks [F, A, 2] stand [F, A]: in WINDOW frames about then, or in
    all that there are on end, the line through their positions has a slope of at most
    STANDS."""
    standing = np.zeros(valid.shape, bool)
    runs = runs_of(valid)
    for frames in range(2, WINDOW):
        short = runs.end - runs.start == frames
        agent = runs.agent[short]
        frame = runs.start[short] + np.arange(frames)[:, None]
        velocity = np.einsum("k,krc->rc", _slope(frames), position[frame, agent])
        standing[frame, agent] = np.linalg.norm(velocity, axis=-1) < STANDS
    if len(valid) >= WINDOW:
        origin = np.where(valid[..., None], position, np.inf).min(0)
        place = np.where(valid[..., None], position - origin, 0.0)
        velocity = convolve1d(
            place,
            _slope(WINDOW)[::-1],
            axis=0,
            mode="constant",
        )
        whole = minimum_filter1d(
            valid,
            WINDOW,
            axis=0,
            mode="constant",
        )
        slow = whole & (np.linalg.norm(velocity, axis=-1) < STANDS)
        standing |= maximum_filter1d(
            slow,
            WINDOW,
            axis=0,
            mode="constant",
        )
    return standing


def _slope(frames: int) -> ndarray:
    """Weights [frames] of positions at DT that make the slope of their line."""
    time = (np.arange(frames) - (frames - 1) / 2) * DT
    return time / (time**2).sum()


def _held(
    frames: ndarray,
    heading: ndarray,
    *,
    standing: ndarray,
    position: ndarray,
) -> ndarray:
    """The headings [K] of a track at its valid frames [K], held where it stands [K];
    heading [K]: without wraps."""
    held = heading.copy()
    jump = np.linalg.norm(np.diff(position, axis=0), axis=-1) > APART
    edges = np.flatnonzero(np.diff(standing) | jump) + 1
    for part in np.split(np.arange(len(frames)), edges):
        if not standing[part[0]]:
            continue
        ends = []
        for edge, side in (
            (part[0], slice(max(part[0] - NEIGHBOURS, 0), part[0])),
            (part[-1], slice(part[-1] + 1, part[-1] + 1 + NEIGHBOURS)),
        ):
            moves = ~standing[side]
            if (moves & (np.abs(frames[side] - frames[edge]) <= LOST)).any():
                ends.append(np.median(heading[side][moves]))
        ends = ends or [_agreed(heading[part])]
        held[part] = np.linspace(ends[0], ends[-1], len(part))
    return held


def _agreed(heading: ndarray) -> float:
    """The median of the headings [K] within CLUSTER of the one, the earliest, that most
    are near to."""
    ordered = np.sort(heading)
    below = np.searchsorted(ordered, heading - CLUSTER)
    near = np.searchsorted(ordered, heading + CLUSTER, side="right") - below
    cluster = np.abs(heading - heading[near.argmax()]) <= CLUSTER
    return float(np.median(heading[cluster]))


def _motion(states: ndarray, valid: ndarray) -> ndarray:
    """Mean velocities [F, A, 2] m/s over HALF frames to both sides, 0 where these have
    no one direction; the recorded ones of a frame that stands alone."""
    step = np.diff(states[..., :2], axis=0)
    length = np.linalg.norm(step, axis=-1)[..., None]
    recorded = (valid[1:] & valid[:-1])[..., None] & (length <= MAX_STEP)
    columns = np.where(recorded, np.concatenate([step, length, recorded], -1), 0.0)
    total = np.concatenate([np.zeros_like(columns[:1]), np.cumsum(columns, axis=0)])
    frame = np.arange(len(valid))
    before = np.maximum(frame - HALF, 0)
    moved = total[np.minimum(frame + HALF, len(valid) - 1)] - total[before]
    path, count = np.split(moved[..., 2:], 2, axis=-1)
    displacement = np.linalg.norm(moved[..., :2], axis=-1)[..., None]
    straight = displacement >= STRAIGHT * path
    mean = moved[..., :2] * straight / np.maximum(count * DT, DT)
    return np.where(count > 0, mean, states[..., 3:] * direction(states[..., 2]))


def _turned_round(states: ndarray, valid: ndarray) -> ndarray:
    """Which headings [F, A] are those of the back: the choice for each track that turns
    least and drives backwards least. Slow motion backwards alone turns nothing round:
    it is reversing."""
    heading = states[..., 2]
    velocity = _motion(states, valid)
    speed = np.linalg.norm(velocity, axis=-1)
    cosine = (velocity * direction(heading)).sum(-1) / np.maximum(speed, 1e-9)
    backwards = cosine < -AGAINST
    fast = valid & (speed > BACKWARDS)
    slow = valid & (speed > MOVES) & ~fast
    flips = np.abs(wrap(np.diff(heading, axis=0))) > np.pi / 2
    odd = (flips & valid[1:] & valid[:-1]).any(0)
    odd |= (fast & backwards).any(0)
    agents = np.flatnonzero(odd | _flips_in_a_gap(heading, valid))
    slow_cost = np.minimum(SLOW_COST, SLOW / np.maximum(slow.sum(0), 1))
    cost = fast * FAST_COST + slow * slow_cost
    turning = np.minimum(TURNED_COST, TURNED / np.maximum(valid.sum(0), 1))
    costs = np.stack([cost * backwards, cost * (cosine > AGAINST) + turning], -1)
    turned = np.zeros(valid.shape, bool)
    turned[:, agents] = _least_cost(
        heading[:, agents],
        valid[:, agents],
        costs[:, agents],
    )
    drives = fast.any(0)
    whole = drives & ((turned & fast).sum(0) > 0.5 * fast.sum(0))
    if whole.sum() >= CONVENTION and whole.sum() > 0.5 * drives.sum():
        turned[:, whole] = False
    return turned


def _flips_in_a_gap(heading: ndarray, valid: ndarray) -> ndarray:
    """Whether a track [F, A] comes back from a gap turned by more than pi / 2 [A]."""
    last = last_valid(valid)[1:-1]
    turn = heading[1:] - heading[np.maximum(last, 0), np.arange(valid.shape[1])]
    returns = valid[1:] & (last >= 0)
    return (returns & (np.abs(wrap(turn)) > np.pi / 2)).any(0)


def _least_cost(
    heading: ndarray,
    valid: ndarray,
    costs: ndarray,
) -> ndarray:
    """Whether to turn each heading [F, A] round, at the least sum of turning from frame
    to frame [rad] and of the costs [F, A, 2] of the recorded heading and the turned one
    (Viterbi's algorithm). Turning in a gap costs less."""
    frames, agents = valid.shape
    total = np.zeros((agents, 2))
    last = np.full(agents, -1)
    source = np.zeros((frames, agents, 2), np.int8)
    column = np.arange(agents)
    for frame in range(frames):
        here = valid[frame]
        turn = np.abs(wrap(heading[frame] - heading[np.maximum(last, 0), column]))
        gap = 1 / (1 + DT * np.maximum(frame - last - 1, 0))
        weight = np.where(last >= 0, gap, 0.0)
        same = total + (turn * weight)[:, None]
        other = total[:, ::-1] + ((np.pi - turn) * weight)[:, None]
        source[frame] = np.where(here[:, None] & (other < same), [1, 0], [0, 1])
        total = np.where(here[:, None], np.minimum(same, other) + costs[frame], total)
        last = np.where(here, frame, last)
    chosen = np.zeros((frames, agents), bool)
    side = total.argmin(1)
    for frame in range(frames)[::-1]:
        chosen[frame] = valid[frame] & (side == 1)
        side = source[frame, column, side]
    return chosen


def _interpolate_spikes(states: ndarray, valid: ndarray) -> int:
    """Replace headings far from the median of their neighbours while a track moves, in
    place; returns of how many tracks."""
    least = min(height for _, height in SPIKES)
    jump = np.abs(wrap(np.diff(states[..., 2], axis=0))) > least
    moving = valid & ~standing_frames(states[..., :2], valid)
    count = 0
    for agent in np.flatnonzero((jump & valid[1:] & valid[:-1]).any(0)):
        frames = np.flatnonzero(valid[:, agent])
        heading = np.unwrap(states[frames, agent, 2])
        # in a longer gap it may turn
        runs = np.split(heading, np.flatnonzero(np.diff(frames) > HIDDEN + 1) + 1)
        spike = np.concatenate([_spikes(run) for run in runs]) & moving[frames, agent]
        if spike.any() and not spike.all():
            sound = np.interp(frames[spike], frames[~spike], heading[~spike])
            states[frames[spike], agent, 2] = wrap(sound)
            count += 1
    return count


def _spikes(heading: ndarray) -> ndarray:
    """Returns which headings [K] of frames without a long gap, and without wraps, are
    far from their median."""
    spike = np.zeros(len(heading), bool)
    for window, height in SPIKES:
        if len(heading) >= window:
            median = median_filter(heading, window, mode="mirror")
            spike |= np.abs(heading - median) > height
    return spike
