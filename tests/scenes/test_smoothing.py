"""Kinematics of logs: polynomial tracks come back exactly, and nothing of the future is
seen."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from e2rl.run.errors import InputError
from e2rl.scenes.smoothing import (
    causal_past,
    causal_state,
    drop_jumps,
    latest_frames,
    resample_heights,
    resample_uniform,
    smooth,
)

TIME = np.arange(40) * 0.1


def accelerating(
    heading: float = 0.7, speed: float = 4.0, accel: float = 1.5
) -> np.ndarray:
    """States [40, 1, 4] under constant acceleration along a heading, with a false
    recorded speed."""
    way = speed * TIME + accel * TIME**2 / 2
    columns = [
        way * np.cos(heading) + 9,
        way * np.sin(heading) - 5,
        np.full(40, heading),
        np.full(40, 99.0),
    ]
    return np.stack(columns, -1)[:, None]


def test_constant_acceleration_is_estimated_exactly():
    states = accelerating()
    valid = np.ones((40, 1), bool)
    start, accel, yaw_rate = causal_state(states, valid, frame=20)
    assert np.allclose(start[0, :3], states[20, 0, :3], atol=1e-6)
    assert np.isclose(start[0, 3], 4.0 + 1.5 * 2.0, atol=1e-5) and np.isclose(
        accel[0], 1.5, atol=1e-4
    )
    assert abs(yaw_rate[0]) < 1e-9


def test_a_steady_turn_is_estimated():
    heading = 0.3 * TIME
    states = np.stack(
        [np.sin(heading) * 20, (1 - np.cos(heading)) * 20, heading, np.full(40, 6.0)],
        -1,
    )[:, None]
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    start, _, yaw_rate = causal_state(states, np.ones((40, 1), bool), frame=20)
    assert np.isclose(yaw_rate[0], 0.3, atol=1e-4) and np.isclose(
        start[0, 3], 6.0, atol=0.1
    )  # the fit is a chord's


def test_the_start_state_is_blind_to_the_future_and_to_gaps_before():
    states = accelerating()
    valid = np.ones((40, 1), bool)
    before = causal_state(states, valid, frame=20)
    states[21:], valid[21:] = np.nan, False
    states[:15], valid[:15] = 1e6, True
    valid[14] = False
    after = causal_state(states, valid, frame=20)
    assert all(np.allclose(a, b, atol=1e-4) for a, b in zip(before, after, strict=True))


def test_the_past_is_seen_from_the_present_and_blind_to_the_future_and_to_gaps_before():
    states = accelerating()
    valid = np.ones((40, 1), bool)
    speed = np.array([7.0])
    back = np.arange(1, 11) * 0.1
    past = causal_past(states, valid, frame=20, speed=speed)
    assert past.shape == (1, 10, 3)
    assert np.allclose(past[0, :, 0], -7.0 * back + 1.5 * back**2 / 2) and np.allclose(
        past[0, :, 1:], 0
    )
    states[21:], valid[21:], states[:15] = np.nan, False, 1e6
    valid[14] = False
    short = causal_past(states, valid, frame=20, speed=speed)
    assert np.allclose(short[0, :5], past[0, :5])
    assert np.allclose(np.diff(short[0, 4:, 0]), -0.7) and np.allclose(
        short[0, :, 1:], 0
    )
    assert np.allclose(
        causal_past(states, valid, frame=0, speed=speed)[0, :, 0], -7.0 * back
    ), "straight on where nothing is known"


def test_a_turn_shows_in_the_past():
    angle = np.linspace(3.0, 3.5, 20)  # across the cut
    states = np.stack(
        [10 * np.sin(angle), -10 * np.cos(angle), angle, np.zeros(20)], -1
    )[:, None]
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    past = causal_past(states, np.ones((20, 1), bool), frame=19, speed=np.array([1.0]))[
        0
    ]
    turned = -np.arange(1, 11) * 0.5 / 19
    assert np.allclose(past[:, 2], turned)
    assert np.allclose(past[:, 0], 10 * np.sin(turned)) and np.allclose(
        past[:, 1], 10 * (1 - np.cos(turned))
    )


def test_smoothing_keeps_quadratics_and_takes_speed_along_the_heading():
    states = accelerating()
    out = smooth(states, np.ones((40, 1), bool))
    assert np.allclose(out[..., :3], states[..., :3], atol=1e-9)
    assert np.allclose(out[:, 0, 3], 4.0 + 1.5 * TIME, atol=1e-9)


def test_smoothing_works_run_by_run_and_removes_noise():
    states = accelerating()
    valid = np.ones((40, 1), bool)
    valid[18:22] = False
    states[20:, :, :2] += 500.0
    out = smooth(states, valid)
    assert np.allclose(out[:18], smooth(states[:18], valid[:18])) and np.allclose(
        out[22:, 0, 3], 4 + 1.5 * TIME[22:]
    )
    noise = np.random.default_rng(0).normal(0, 0.05, (40, 1, 2))
    noisy = accelerating()
    noisy[..., :2] += noise
    error = smooth(noisy, np.ones((40, 1), bool))[..., :2] - accelerating()[..., :2]
    assert np.abs(error).mean() < 0.6 * np.abs(noise).mean()


def test_a_glitch_costs_its_own_frames_only():
    states = accelerating(accel=0.0)
    valid = np.ones((40, 1), bool)
    states[10, 0, 0] += 30.0  # one frame elsewhere
    states[25:27, 0, 2] += np.pi  # two frames turned round
    kept = drop_jumps(states, valid)
    assert np.flatnonzero(~kept[:, 0]).tolist() == [10] and valid.all()


def test_the_longer_side_of_a_lasting_jump_is_kept():
    states = accelerating(accel=0.0)
    valid = np.ones((40, 1), bool)
    states[30:, 0, 2] += np.pi
    assert drop_jumps(states, valid).all(), "nobody leaves for a heading"
    states[:15, 0, :2] += 100.0
    assert np.flatnonzero(drop_jumps(states, valid)[:, 0]).tolist() == list(
        range(15, 40)
    )


def test_speeds_are_signed_along_the_heading():
    back = accelerating(speed=-3.0, accel=-0.5)
    valid = np.ones((40, 1), bool)
    assert np.allclose(smooth(back, valid)[:, 0, 3], -3.0 - 0.5 * TIME, atol=1e-9)
    start, accel, _ = causal_state(back, valid, frame=20)
    assert np.isclose(start[0, 3], -4.0, atol=1e-5) and np.isclose(
        accel[0], -0.5, atol=1e-4
    )


@pytest.mark.parametrize("accel", [-8.0, -3.0, 0.0])
def test_who_brakes_to_a_halt_or_stands_does_not_reverse(accel):
    halt = np.minimum(TIME, 1.5) - 1.5
    states = np.zeros((40, 1, 4))
    states[:, 0, 0] = accel * halt**2 / 2
    states[..., :2] += np.random.default_rng(0).normal(0, 0.02, (40, 1, 2))
    valid = np.ones((40, 1), bool)
    assert (smooth(states, valid)[..., 3] >= 0).all()
    assert all(
        causal_state(states, valid, frame=frame)[0][0, 3] >= 0 for frame in range(40)
    )


def test_gapped_time_stamps_are_resampled_linearly():
    stamps = np.delete(TIME, [7, 8, 20])
    full = accelerating(accel=0.0)
    states = np.delete(full, [7, 8, 20], axis=0)
    out, known = resample_uniform(states, np.ones((37, 1), bool), ts=stamps + 1.6e9)
    assert known.all() and np.allclose(out[..., :3], full[..., :3], atol=1e-5)


def test_resampling_turns_the_short_way_and_respects_validity():
    stamps = np.delete(TIME, 5)
    states = np.delete(accelerating(accel=0.0), 5, axis=0)
    states[:5, 0, 2], states[5:, 0, 2] = 3.1, -3.1
    valid = np.ones((39, 1), bool)
    valid[20] = False
    out, known = resample_uniform(states, valid, ts=stamps)
    assert abs(abs(out[5, 0, 2]) - np.pi) < 1e-6
    assert np.flatnonzero(~known[:, 0]).tolist() == [21]


def test_long_gaps_are_not_invented_and_other_rates_are_brought_to_ten_hertz():
    stamps = np.concatenate([TIME[:20], TIME[20:] + 1.0])
    states = accelerating(accel=0.0)
    valid = np.ones((40, 1), bool)
    _, known = resample_uniform(states, valid, ts=stamps)
    assert (
        len(known) == 50
        and not known[20:30].any()
        and known[:20].all()
        and known[30:].all()
    )
    out, known = resample_uniform(states, valid, ts=TIME / 2)
    assert len(out) == 20 and np.allclose(out, states[::2], atol=1e-6) and known.all()


RATES = [
    1.0,
    2.0,
    5.0,
    10.0,
    12.5,
    20.0,
    24.0,
    25.0,
    29.97,
    30.0,
    33.0,
    50.0,
    60.0,
    99.0,
    100.0,
    105.0,
]


def circle(seconds: np.ndarray) -> np.ndarray:
    """States [F, 1, 4] at 6 m/s on a circle of 20 m about (500, -300), across the cut
    at pi."""
    angle = 2.5 + 0.3 * seconds
    columns = [
        500 + 20 * np.sin(angle),
        -300 - 20 * np.cos(angle),
        (angle + np.pi) % (2 * np.pi) - np.pi,
    ]
    return np.stack([*columns, np.full(len(seconds), 6.0)], -1)[:, None]


@settings(max_examples=150, deadline=None)
@given(
    rate=st.sampled_from(RATES),
    jitter=st.floats(0, 0.45),
    seed=st.integers(0, 2**32 - 1),
)
def test_at_every_rate_a_track_is_what_was_recorded_and_no_more(rate, jitter, seed):
    """Each valid frame lies on the motion, near recorded frames; each span recorded
    without a gap is covered."""
    rng = np.random.default_rng(seed)
    count = max(int(6 * rate), 8)
    seconds = (np.arange(count) + rng.uniform(-jitter, jitter, count)) / rate
    seconds = seconds[rng.random(count) > 0.05]
    seconds -= seconds[0]
    valid = np.repeat(rng.random(count) < 0.7, 1 + rng.integers(6))[
        : len(seconds), None
    ]
    assume(valid.any())
    out, known = resample_uniform(
        np.where(valid[..., None], circle(seconds), np.nan), valid, ts=seconds
    )
    time = 0.1 * np.flatnonzero(known[:, 0])
    recorded = seconds[valid[:, 0]]
    error = out[known] - circle(time)[:, 0]
    around = np.searchsorted(recorded, time)
    before = recorded[np.maximum(around - 1, 0)]
    after = recorded[np.minimum(around, len(recorded) - 1)]
    nearest = np.minimum(np.abs(time - before), np.abs(time - after))
    inside = (before <= time) & (time <= after)
    assert (inside | (nearest <= 0.02 + 1e-9)).all(), "outside of what was recorded"
    gap = np.where(inside & (nearest > 0.02), after - before, 0.0)
    assert gap.max(initial=0) < 1.9, "too far from what was recorded"
    bend = 6.0 * 0.3 * gap**2 / 8 + 6.0 * nearest * (nearest <= 0.02)
    assert (np.linalg.norm(error[:, :2], axis=-1) <= bend + 1e-6).all()
    assert (
        np.abs(np.sin(error[:, 2])) <= 0.3 * nearest * (nearest <= 0.02) + 1e-6
    ).all()
    grid = 0.1 * np.arange(len(out))[:, None]
    step = np.diff(seconds)
    whole = valid[1:, 0] & valid[:-1, 0] & (step < 0.55)
    covered = ((seconds[:-1] <= grid) & (grid <= seconds[1:]))[:, whole].any(1)
    assert known[covered, 0].all() and not out[~known].any()


@pytest.mark.parametrize("rate", RATES[3:])
def test_who_is_not_recorded_is_nowhere(rate):
    seconds = np.arange(int(6 * rate)) / rate
    valid = ((seconds < 2.03) | (seconds > 4.07))[:, None]
    states = np.where(valid[..., None], circle(seconds), 0.0)
    out, known = resample_uniform(states, valid, ts=seconds)
    grid = 0.1 * np.arange(len(out))
    assert known[:, 0].tolist() == ((grid < 2.04) | (grid > 4.06)).tolist() or rate in (
        12.5,
        24.0,
        25.0,
    )
    assert not known[(grid > 2.04) & (grid < 4.06)].any()
    assert np.abs(np.hypot(*(out[known][:, :2] - [500, -300]).T) - 20).max() < 0.02


def test_a_track_annotated_at_a_lower_rate_is_interpolated_and_one_lost_from_sight_is_not():
    seconds = np.arange(120) / 20
    valid = np.stack(
        [np.arange(120) % 10 == 0, np.ones(120, bool), np.ones(120, bool)], 1
    )
    valid[40:48, 1] = False
    valid[[60, 81], 2] = False
    states = np.where(valid[..., None], np.repeat(circle(seconds), 3, axis=1), 0.0)
    out, known = resample_uniform(states, valid, ts=seconds)
    assert np.flatnonzero(~known[:, 0]).tolist() == [56, 57, 58, 59], (
        "after its last annotation"
    )
    assert np.flatnonzero(~known[:, 1]).tolist() == [20, 21, 22, 23]
    assert known[:, 2].all(), "a flicker between frames that lie 0.1 s apart"
    assert np.abs(np.hypot(*(out[known][:, :2] - [500, -300]).T) - 20).max() < 0.06


def test_frames_of_one_time_stamp_are_one():
    seconds = np.repeat(np.arange(40) / 25, 1 + (np.arange(40) % 3 == 0))
    states = circle(seconds)
    valid = np.ones((len(seconds), 1), bool)
    first = np.flatnonzero(np.diff(seconds) == 0)
    valid[first[::2]], valid[first[1::2] + 1] = False, False
    out, known = resample_uniform(states, valid, ts=seconds)
    expected, _ = resample_uniform(
        circle(np.unique(seconds)), np.ones((40, 1), bool), ts=np.unique(seconds)
    )
    assert known.all() and np.allclose(out, expected)


@pytest.mark.parametrize("speed", [0.0, 6.0, -6.0])
def test_a_frame_beside_the_grid_that_is_alone_is_moved_along_its_speed(speed):
    seconds = np.arange(50) / 14
    frames = [10, 25]
    grid = [7, 18]
    states = circle(seconds)
    valid = np.zeros((50, 1), bool)
    valid[frames], states[..., 3] = True, speed
    out, known = resample_uniform(
        np.where(valid[..., None], states, 0.0), valid, ts=seconds
    )
    assert np.flatnonzero(known[:, 0]).tolist() == grid
    x, y, heading, _ = states[frames, 0].T
    way = speed * (0.1 * np.array(grid) - seconds[frames])
    assert np.allclose(
        out[grid, 0, :3].T,
        [x + way * np.cos(heading), y + way * np.sin(heading), heading],
    )


def test_a_height_that_is_unknown_is_the_nearest_of_its_track_and_others_stay():
    heights = np.tile([0.0, 8.0, 4.0], (40, 1))
    valid = np.ones((40, 3), bool)
    heights[:, 0] = TIME
    heights[[0, 1, 9, 10], 0] = np.nan
    heights[:, 2] = np.nan
    out = resample_heights(heights, valid, ts=TIME)
    expected = TIME.copy()
    expected[[0, 1, 9, 10]] = TIME[[2, 2, 8, 11]]
    assert (
        np.allclose(out[:, 0], expected)
        and (out[:, 1] == 8).all()
        and np.isnan(out[:, 2]).all()
    )
    assert resample_heights(np.full((40, 3), np.nan), valid, ts=TIME) is None
    assert resample_heights(np.where(valid, 1.0, heights), valid, ts=TIME) is None


def test_a_heading_that_flips_between_frames_is_never_halfway():
    seconds = np.arange(50) / 25
    states = np.stack(
        [8 * seconds, 0 * seconds, np.where(seconds > 1.0, np.pi, 0.0), 0 * seconds], -1
    )[:, None]
    out, _ = resample_uniform(states, np.ones((50, 1), bool), ts=seconds)
    assert np.allclose(np.sin(out[..., 2]), 0)


@pytest.mark.parametrize("rate", RATES)
def test_a_light_holds_from_its_frame_on(rate):
    seconds = np.arange(int(6 * rate)) / rate
    frames = latest_frames(seconds, 50)
    late = 0.1 * np.arange(50) - seconds[frames]
    assert (late >= -0.02 - 1e-9).all() and (late < 1 / rate + 1e-6).all()


@pytest.mark.parametrize(
    "stamps", [TIME[::-1], TIME * 1e6, TIME * 0, np.where(TIME > 2, np.nan, TIME)]
)
def test_impossible_time_stamps_are_refused(stamps):
    with pytest.raises(InputError, match="time stamps"):
        resample_uniform(accelerating(), np.ones((40, 1), bool), ts=stamps)


@pytest.mark.parametrize("braking", [4.0, 9.0])
def test_who_has_halted_stands_and_who_has_not_moved_off_yet_does(braking):
    """It brakes from 10 m/s to a halt, stands for a second, and moves off at 3 m/s^2."""
    time = 0.1 * np.arange(120)
    halts = 10.0 / braking
    leaves = halts + 1.0
    driven = np.where(time < halts, 10 * time - braking / 2 * time**2, 50.0 / braking)
    driven = driven + 1.5 * np.maximum(time - leaves, 0.0) ** 2
    states = np.zeros((len(time), 1, 4))
    states[:, 0, 0] = driven
    speed = smooth(states, np.ones((len(time), 1), bool))[:, 0, 3]
    stands = (time >= halts) & (time <= leaves)
    assert (speed[stands] == 0).all()
    assert speed[(time < halts - 0.5) | (time > leaves + 0.5)].min() > 0.4
