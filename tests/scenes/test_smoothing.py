"""Kinematics of logs: polynomial tracks come back exactly, and nothing of the future is
seen."""

import numpy as np
import pytest
from scipy.signal import savgol_coeffs

from e2rl.scenes.recording import DT
from e2rl.scenes.smoothing import (
    ORDER,
    causal_past,
    causal_state,
    drop_jumps,
    polynomial_weights,
    smooth,
)

TIME = np.arange(40) * 0.1


def accelerating(
    heading: float = 0.7,
    speed: float = 4.0,
    accel: float = 1.5,
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
    assert np.isclose(start[0, 3], 4.0 + 1.5 * 2.0, atol=1e-5)
    assert np.isclose(accel[0], 1.5, atol=1e-4)
    assert abs(yaw_rate[0]) < 1e-9


def test_a_steady_turn_is_estimated():
    heading = 0.3 * TIME
    states = np.stack(
        [np.sin(heading) * 20, (1 - np.cos(heading)) * 20, heading, np.full(40, 6.0)],
        -1,
    )[:, None]
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    start, _, yaw_rate = causal_state(states, np.ones((40, 1), bool), frame=20)
    # the fit is a chord's
    assert np.isclose(yaw_rate[0], 0.3, atol=1e-4)
    assert np.isclose(start[0, 3], 6.0, atol=0.1)


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
    past = causal_past(
        states,
        valid,
        frame=20,
        speed=speed,
    )
    assert past.shape == (1, 10, 3)
    assert np.allclose(past[0, :, 0], -7.0 * back + 1.5 * back**2 / 2)
    assert np.allclose(past[0, :, 1:], 0)
    states[21:], valid[21:], states[:15] = np.nan, False, 1e6
    valid[14] = False
    short = causal_past(
        states,
        valid,
        frame=20,
        speed=speed,
    )
    assert np.allclose(short[0, :5], past[0, :5])
    assert np.allclose(np.diff(short[0, 4:, 0]), -0.7)
    assert np.allclose(short[0, :, 1:], 0)
    assert np.allclose(
        causal_past(
            states,
            valid,
            frame=0,
            speed=speed,
        )[0, :, 0],
        -7.0 * back,
    ), "straight on where nothing is recorded"


def test_a_turn_shows_in_the_past():
    angle = np.linspace(3.0, 3.5, 20)  # across the cut
    states = np.stack(
        [10 * np.sin(angle), -10 * np.cos(angle), angle, np.zeros(20)], -1
    )[:, None]
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    past = causal_past(
        states,
        np.ones((20, 1), bool),
        frame=19,
        speed=np.array([1.0]),
    )[0]
    turned = -np.arange(1, 11) * 0.5 / 19
    assert np.allclose(past[:, 2], turned)
    assert np.allclose(past[:, 0], 10 * np.sin(turned))
    assert np.allclose(past[:, 1], 10 * (1 - np.cos(turned)))


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
    assert np.allclose(out[:18], smooth(states[:18], valid[:18]))
    assert np.allclose(out[22:, 0, 3], 4 + 1.5 * TIME[22:])
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
    plausible = drop_jumps(states, valid)
    assert np.flatnonzero(~plausible[:, 0]).tolist() == [10]
    assert valid.all()


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
    back = accelerating(
        speed=-3.0,
        accel=-0.5,
    )
    valid = np.ones((40, 1), bool)
    assert np.allclose(smooth(back, valid)[:, 0, 3], -3.0 - 0.5 * TIME, atol=1e-9)
    start, accel, _ = causal_state(back, valid, frame=20)
    assert np.isclose(start[0, 3], -4.0, atol=1e-5)
    assert np.isclose(accel[0], -0.5, atol=1e-4)


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


@pytest.mark.parametrize("order", [0, 1])
def test_the_fit_at_the_middle_sample_is_scipy_s_savitzky_golay_filter(order):
    centre, _ = polynomial_weights(15, order)
    np.testing.assert_allclose(
        centre, savgol_coeffs(15, ORDER, order, DT), rtol=0, atol=1e-13
    )
