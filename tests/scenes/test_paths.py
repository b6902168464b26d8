"""Path geometry against closed forms."""

import numpy as np
import pytest

from e2rl.scenes.paths import arc_length, shift_left, tractrix, whittaker


def circle(radius: float, step: float, turns: float = 2.0) -> np.ndarray:
    angle = np.arange(0, 2 * np.pi * turns, step / radius)
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def test_whittaker_keeps_quadratics_and_removes_noise():
    t = np.linspace(0, 1, 200)
    quadratic = 3 * t**2 - t + 2
    assert np.allclose(whittaker(quadratic, 300.0), quadratic, atol=1e-6)
    noise = np.random.default_rng(0).normal(size=2000)
    assert whittaker(noise, 300.0).std() < 0.4


def test_whittaker_solves_its_normal_equations():
    values = np.random.default_rng(1).normal(size=(30, 2))
    third = np.diff(np.eye(30), n=3, axis=0)
    assert np.allclose(whittaker(values, 7.0), np.linalg.solve(np.eye(30) + 7.0 * third.T @ third, values))


def test_tractrix_on_a_circle_reaches_the_steady_angle():
    radius, wheelbase = 20.0, 3.0
    front = circle(radius, 0.05)
    centre, heading = tractrix(front, np.array(wheelbase))
    rear = np.sqrt(radius**2 - wheelbase**2)
    assert np.linalg.norm(centre[-1]) == pytest.approx(np.sqrt(rear**2 + (wheelbase / 2) ** 2), abs=0.01)
    rate = (heading[-1] - heading[-101]) / (100 * 0.05)
    assert rate == pytest.approx(1 / radius, rel=1e-3)


def test_tractrix_on_a_line_stays_on_it():
    front = np.stack([np.arange(50) * 0.5, np.zeros(50)], -1)
    centre, heading = tractrix(np.stack([front, front + 1]), np.array([2.0, 4.0]))
    assert np.allclose(heading, 0) and np.allclose(centre[0, :, 0], front[:, 0] - 1.0)


def test_a_circle_shifted_left_is_a_circle():
    moved = shift_left(circle(30.0, 0.2), 2.0)
    assert np.allclose(np.linalg.norm(moved, axis=-1), 28.0, atol=0.02)
    assert arc_length(moved)[-1] == pytest.approx(arc_length(circle(30.0, 0.2))[-1] * 28 / 30, rel=1e-3)
