"""Tracks, heights and lights of any rate on a grid of 10 Hz: what was recorded, and no
more."""

import numpy as np
import pytest
from hypothesis import (
    assume,
    given,
    settings,
)
from hypothesis import strategies as st

from e2rl.run.errors import InputError
from e2rl.scenes.resampling import FRAME_STEPS, latest_frames, resample_uniform

TIME = np.arange(40) * 0.1


def driven(heading: float = 0.7, speed: float = 4.0) -> np.ndarray:
    """States [40, 1, 4] of a steady drive along a heading, with a false recorded
    speed."""
    x = speed * TIME * np.cos(heading) + 9
    y = speed * TIME * np.sin(heading) - 5
    return np.stack([x, y, np.full(40, heading), np.full(40, 99.0)], -1)[:, None]


def test_gapped_time_stamps_are_resampled_linearly():
    stamps = np.delete(TIME, [7, 8, 20])
    full = driven()
    states = np.delete(full, [7, 8, 20], axis=0)
    out, recorded, _ = resample_uniform(
        states, np.ones((37, 1), bool), ts=stamps + 1.6e9
    )
    assert recorded.all()
    assert np.allclose(out[..., :3], full[..., :3], atol=1e-5)


def test_resampling_turns_the_short_way_and_respects_validity():
    stamps = np.delete(TIME, 5)
    states = np.delete(driven(), 5, axis=0)
    states[:5, 0, 2], states[5:, 0, 2] = 3.1, -3.1
    valid = np.ones((39, 1), bool)
    valid[20] = False
    out, recorded, _ = resample_uniform(states, valid, ts=stamps)
    assert abs(abs(out[5, 0, 2]) - np.pi) < 1e-6
    assert np.flatnonzero(~recorded[:, 0]).tolist() == [21]


def test_long_gaps_are_not_invented_and_other_rates_are_brought_to_ten_hertz():
    stamps = np.concatenate([TIME[:20], TIME[20:] + 1.0])
    states = driven()
    valid = np.ones((40, 1), bool)
    _, recorded, _ = resample_uniform(states, valid, ts=stamps)
    assert len(recorded) == 50
    assert not recorded[20:30].any()
    assert recorded[:20].all()
    assert recorded[30:].all()
    out, recorded, _ = resample_uniform(states, valid, ts=TIME / 2)
    assert len(out) == 20
    assert np.allclose(out, states[::2], atol=1e-6)
    assert recorded.all()


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


@settings(
    max_examples=150,
    deadline=None,
)
@given(
    rate=st.sampled_from(RATES),
    jitter=st.floats(0, 0.45),
    seed=st.integers(0, 2**32 - 1),
)
def test_at_every_rate_a_track_is_what_was_recorded_and_no_more(
    rate,
    jitter,
    seed,
):
    """Each valid frame lies on the motion, near recorded frames; each span recorded
    without a gap is covered."""
    rng = np.random.default_rng(seed)
    count = max(int(6 * rate), 8)
    seconds = (np.arange(count) + rng.uniform(-jitter, jitter, count)) / rate
    seconds = seconds[rng.random(count) > 0.05]
    seconds -= seconds[0]
    assume(np.median(np.diff(seconds)) <= FRAME_STEPS[1])  # slower logs are refused
    valid = np.repeat(rng.random(count) < 0.7, 1 + rng.integers(6))[
        : len(seconds), None
    ]
    assume(valid.any())
    out, resampled, _ = resample_uniform(
        np.where(valid[..., None], circle(seconds), np.nan), valid, ts=seconds
    )
    time = 0.1 * np.flatnonzero(resampled[:, 0])
    recorded = seconds[valid[:, 0]]
    error = out[resampled] - circle(time)[:, 0]
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
    assert resampled[covered, 0].all()
    assert not out[~resampled].any()


@pytest.mark.parametrize("rate", RATES[3:])
def test_who_is_not_recorded_is_nowhere(rate):
    seconds = np.arange(int(6 * rate)) / rate
    valid = ((seconds < 2.03) | (seconds > 4.07))[:, None]
    states = np.where(valid[..., None], circle(seconds), 0.0)
    out, recorded, _ = resample_uniform(states, valid, ts=seconds)
    grid = 0.1 * np.arange(len(out))
    assert recorded[:, 0].tolist() == (
        (grid < 2.04) | (grid > 4.06)
    ).tolist() or rate in (
        12.5,
        24.0,
        25.0,
    )
    assert not recorded[(grid > 2.04) & (grid < 4.06)].any()
    assert np.abs(np.hypot(*(out[recorded][:, :2] - [500, -300]).T) - 20).max() < 0.02


def test_a_track_annotated_at_a_lower_rate_is_interpolated_and_one_lost_from_sight_is_not():
    seconds = np.arange(120) / 20
    valid = np.stack(
        [np.arange(120) % 10 == 0, np.ones(120, bool), np.ones(120, bool)], 1
    )
    valid[40:48, 1] = False
    valid[[60, 81], 2] = False
    states = np.where(valid[..., None], np.repeat(circle(seconds), 3, axis=1), 0.0)
    out, recorded, _ = resample_uniform(states, valid, ts=seconds)
    assert np.flatnonzero(~recorded[:, 0]).tolist() == [56, 57, 58, 59], (
        "after its last annotation"
    )
    assert np.flatnonzero(~recorded[:, 1]).tolist() == [20, 21, 22, 23]
    assert recorded[:, 2].all(), "a flicker between frames that lie 0.1 s apart"
    assert np.abs(np.hypot(*(out[recorded][:, :2] - [500, -300]).T) - 20).max() < 0.06


def test_frames_of_one_time_stamp_are_one():
    seconds = np.repeat(np.arange(40) / 25, 1 + (np.arange(40) % 3 == 0))
    states = circle(seconds)
    valid = np.ones((len(seconds), 1), bool)
    first = np.flatnonzero(np.diff(seconds) == 0)
    valid[first[::2]], valid[first[1::2] + 1] = False, False
    out, recorded, _ = resample_uniform(states, valid, ts=seconds)
    expected, *_ = resample_uniform(
        circle(np.unique(seconds)), np.ones((40, 1), bool), ts=np.unique(seconds)
    )
    assert recorded.all()
    assert np.allclose(out, expected)


@pytest.mark.parametrize("speed", [0.0, 6.0, -6.0])
def test_a_frame_beside_the_grid_that_is_alone_is_moved_along_its_speed(speed):
    seconds = np.arange(50) / 14
    frames = [10, 25]
    grid = [7, 18]
    states = circle(seconds)
    valid = np.zeros((50, 1), bool)
    valid[frames], states[..., 3] = True, speed
    out, recorded, _ = resample_uniform(
        np.where(valid[..., None], states, 0.0), valid, ts=seconds
    )
    assert np.flatnonzero(recorded[:, 0]).tolist() == grid
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

    def resampled(heights: np.ndarray) -> np.ndarray | None:
        states = np.zeros((40, 3, 4))
        return resample_uniform(
            states,
            valid,
            ts=TIME,
            heights=heights,
        ).heights

    out = resampled(heights)
    expected = TIME.copy()
    expected[[0, 1, 9, 10]] = TIME[[2, 2, 8, 11]]
    assert np.allclose(out[:, 0], expected)
    assert (out[:, 1] == 8).all()
    assert np.isnan(out[:, 2]).all()
    assert resampled(np.full((40, 3), np.nan)) is None
    assert resampled(np.where(valid, 1.0, heights)) is None


def test_a_heading_that_flips_between_frames_is_never_halfway():
    seconds = np.arange(50) / 25
    states = np.stack(
        [8 * seconds, 0 * seconds, np.where(seconds > 1.0, np.pi, 0.0), 0 * seconds], -1
    )[:, None]
    out, *_ = resample_uniform(states, np.ones((50, 1), bool), ts=seconds)
    assert np.allclose(np.sin(out[..., 2]), 0)


@pytest.mark.parametrize("rate", RATES)
def test_a_light_holds_from_its_frame_on(rate):
    seconds = np.arange(int(6 * rate)) / rate
    frames = latest_frames(seconds, 50)
    late = 0.1 * np.arange(50) - seconds[frames]
    assert (late >= -0.02 - 1e-9).all()
    assert (late < 1 / rate + 1e-6).all()


@pytest.mark.parametrize(
    "stamps", [TIME[::-1], TIME * 1e6, TIME * 0, np.where(TIME > 2, np.nan, TIME)]
)
def test_impossible_time_stamps_are_refused(stamps):
    with pytest.raises(InputError, match="time stamps"):
        resample_uniform(driven(), np.ones((40, 1), bool), ts=stamps)
