"""A box is the same turned by pi, and nothing turns while it stands: recorded headings
are mended by that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from e2rl.scenes.headings import (
    hold_headings,
    mend_headings,
    standing_frames,
)
from e2rl.scenes.paths import wrap
from e2rl.scenes.recording import PEDESTRIAN, VEHICLE

FRAMES = 91
TIME = 0.1 * np.arange(FRAMES)
TYPES = np.array([VEHICLE])
TURNED = "headings turned round"
SPIKES = "heading spikes"


def driven(
    speed: np.ndarray | float,
    curvature: float = 0.0,
    heading: float = 2.9,
) -> np.ndarray:
    """States [F, 1, 4] at a signed speed [F] along an arc."""
    speed = np.broadcast_to(np.asarray(speed, float), (FRAMES,))
    distance = np.concatenate([[0.0], np.cumsum(speed[1:] + speed[:-1]) / 2 * 0.1])
    angle = heading + curvature * distance
    middle = heading + curvature * (distance[1:] + distance[:-1]) / 2
    step = np.diff(distance)[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)]) + [
        3000.0,
        -800.0,
    ]
    return np.concatenate([place, wrap(angle)[:, None], speed[:, None]], -1)[:, None]


def turned_by(
    states: np.ndarray,
    angle: float | np.ndarray,
    frames: slice | np.ndarray = slice(None),
) -> np.ndarray:
    """The states with other headings in some frames, and the sign of the speed that a
    reader takes from them."""
    out = states.copy()
    out[frames, 0, 2] = wrap(out[frames, 0, 2] + angle)
    out[frames, 0, 3] *= np.where(np.cos(angle) < 0, -1.0, 1.0)
    return out


def assert_same(
    mended: np.ndarray,
    states: np.ndarray,
    valid: np.ndarray | None = None,
) -> None:
    recorded = np.ones(FRAMES, bool) if valid is None else valid[:, 0]
    assert np.abs(wrap(mended[recorded, 0, 2] - states[recorded, 0, 2])).max() < 0.03
    assert np.allclose(mended[recorded, 0, 3], states[recorded, 0, 3])


MOTIONS = {
    "fast": driven(12.0, 0.01),
    "slow": driven(3.0, 0.05),
    "stops": driven(np.clip(9 - 2 * TIME, 0, None), 0.01),
    "starts": driven(np.clip(2 * (TIME - 4), 0, None), 0.02),
    "reverses": driven(-2.0, 0.05),
    "reverses at the end": driven(np.clip(6 - 2 * TIME, -2.5, None), 0.02),
    "stands": driven(0.0),
}
EVERY = np.ones((FRAMES, 1), bool)


@pytest.mark.parametrize("name", MOTIONS)
def test_true_headings_are_left_as_they_are(name):
    states = MOTIONS[name]
    mended, counts = mend_headings(states, EVERY, agent_type=TYPES)
    assert not counts
    assert np.array_equal(mended, states)
    held, count = hold_headings(mended, EVERY, agent_type=TYPES)
    assert count == 0
    assert np.abs(wrap(held[..., 2] - states[..., 2])).max() < 0.03


@pytest.mark.parametrize("name", MOTIONS)
@settings(
    max_examples=30,
    deadline=None,
)
@given(seed=st.integers(0, 2**32 - 1))
def test_single_frames_turned_round_are_turned_back(name, seed):
    rng = np.random.default_rng(seed)
    states = MOTIONS[name]
    flipped = rng.choice(
        FRAMES,
        size=rng.integers(1, 15),
        replace=False,
    )
    valid = EVERY.copy()
    valid[rng.integers(FRAMES, size=9)] = False
    mended, counts = mend_headings(
        turned_by(states, np.pi, frames=flipped), valid, agent_type=TYPES
    )
    assert_same(mended, states, valid=valid)
    assert counts == ({TURNED: 1} if valid[flipped].any() else {})


@pytest.mark.parametrize("name", ["fast", "stops", "starts"])
@pytest.mark.parametrize(
    "part",
    [slice(None), slice(30, None), slice(None, 60), slice(10, 11), slice(20, 50)],
)
def test_whoever_drives_at_road_speed_with_the_back_first_is_turned(name, part):
    mended, counts = mend_headings(
        turned_by(MOTIONS[name], np.pi, frames=part), EVERY, agent_type=TYPES
    )
    assert counts == {TURNED: 1}
    assert_same(mended, MOTIONS[name])


def test_a_slow_vehicle_whose_heading_flips_for_good_drives_forwards():
    mended, _ = mend_headings(
        turned_by(MOTIONS["slow"], np.pi, frames=slice(20, None)),
        EVERY,
        agent_type=TYPES,
    )
    assert_same(mended, MOTIONS["slow"])


def test_a_tracker_that_turns_whoever_reverses_is_not_believed():
    states = MOTIONS["reverses at the end"]
    mended, counts = mend_headings(
        turned_by(states, np.pi, frames=states[:, 0, 3] < 0), EVERY, agent_type=TYPES
    )
    assert counts == {TURNED: 1}
    assert mended[-1, 0, 3] == -2.5
    assert_same(mended, states)


@pytest.mark.parametrize("frames", [[10], [40, 41, 42], [90], [5, 30, 31, 60]])
@pytest.mark.parametrize("angle", [0.5, 1.2, 1.57, -1.0])
def test_spikes_are_interpolated(frames, angle):
    states = MOTIONS["fast"]
    mended, counts = mend_headings(
        turned_by(states, angle, frames=np.array(frames)), EVERY, agent_type=TYPES
    )
    assert counts[SPIKES] == 1
    recorded = np.setdiff1d(np.arange(FRAMES), [90])
    assert np.abs(wrap(mended[recorded, 0, 2] - states[recorded, 0, 2])).max() < 0.03


def test_who_turns_while_hidden_has_no_spike():
    heading = np.clip(1.2 * (TIME - 4), 0, np.pi / 2)
    step = 0.4 * np.stack([np.cos(heading), np.sin(heading)], -1)
    states = np.concatenate(
        [np.cumsum(step, axis=0), heading[:, None], np.full((FRAMES, 1), 4.0)], -1
    )[:, None]
    valid = EVERY.copy()
    valid[30:70] = valid[72:] = False
    mended, counts = mend_headings(
        turned_by(states, 0.5, frames=slice(10, 11)), valid, agent_type=TYPES
    )
    assert counts == {SPIKES: 1}, "that before the gap"
    assert_same(mended, states, valid=valid)


def test_a_spike_beside_frames_that_are_lost_is_one():
    valid = EVERY.copy()
    valid[[41, 44, 46]] = False
    mended, counts = mend_headings(
        turned_by(MOTIONS["fast"], 1.2, frames=np.array([42, 45])),
        valid,
        agent_type=TYPES,
    )
    assert counts == {SPIKES: 1}
    assert_same(mended, MOTIONS["fast"], valid=valid)


def test_a_log_whose_headings_are_all_turned_round_is_not_mended():
    """That is its convention, which is refused."""
    states = np.concatenate([turned_by(MOTIONS["fast"], np.pi)] * 4, axis=1)
    mended, counts = mend_headings(
        states, np.ones((FRAMES, 4), bool), agent_type=np.repeat(TYPES, 4)
    )
    assert np.array_equal(mended, states)
    assert not counts


SPINS = {
    "noise": lambda rng: rng.normal(0, 0.15, FRAMES),
    "spin": lambda rng: np.interp(TIME, [1, 9], [0, np.pi]),
    "slow turn": lambda rng: np.interp(TIME, [1, 9], [0, -0.6]),
    "flips": lambda rng: np.where(np.arange(FRAMES) // 7 % 2, np.pi, 0.0),
    "wrong at first": lambda rng: np.where(TIME < 1, 1.2, 0.0),
}


@pytest.mark.parametrize("name", SPINS)
@pytest.mark.parametrize("jitter", [0.0, 0.01, 0.05])
def test_what_stands_keeps_its_heading(name, jitter):
    rng = np.random.default_rng(1)
    states = turned_by(MOTIONS["stands"], SPINS[name](rng))
    states[..., :2] += rng.normal(0, jitter, (FRAMES, 1, 2))
    mended, _ = mend_headings(states, EVERY, agent_type=TYPES)
    held, count = hold_headings(mended, EVERY, agent_type=TYPES)
    axis = wrap(2 * (held[:, 0, 2] - 2.9)) / 2
    assert count == (name != "flips")
    assert np.ptp(held[:, 0, 2]) < 1e-9
    assert np.abs(axis).max() < 0.16


@pytest.mark.parametrize("name", ["spin", "slow turn"])
def test_whoever_stops_keeps_the_heading_with_which_it_came(name):
    states = driven(np.clip(5 - 4 * TIME, 0, None))
    states = turned_by(states, np.where(TIME > 1.25, SPINS[name](None), 0.0))
    held, count = hold_headings(
        mend_headings(states, EVERY, agent_type=TYPES)[0], EVERY, agent_type=TYPES
    )
    assert count == 1
    assert np.abs(wrap(held[..., 2] - 2.9)).max() < 0.1


def test_whoever_creeps_round_a_corner_does_not_stand():
    states = driven(0.5, 0.2)
    assert not standing_frames(states[..., :2], EVERY).any()
    assert np.array_equal(hold_headings(states, EVERY, agent_type=TYPES)[0], states)


def test_a_pedestrian_turns_on_the_spot():
    states = turned_by(MOTIONS["stands"], SPINS["spin"](None))
    assert np.array_equal(
        hold_headings(states, EVERY, agent_type=np.array([PEDESTRIAN]))[0], states
    )
    assert np.array_equal(
        mend_headings(states, EVERY, agent_type=np.array([PEDESTRIAN]))[0], states
    )
