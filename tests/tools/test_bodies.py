"""The bundled scenes' bodies against closed forms: smoothed paths and rear axles that
follow."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from scenegen.bodies import tractrix, whittaker  # noqa: E402


def test_smoothing_solves_its_normal_equations_and_keeps_quadratics():
    values = np.random.default_rng(1).normal(size=(30, 2))
    third = np.diff(np.eye(30), n=3, axis=0)
    assert np.allclose(
        whittaker(values, 7.0),
        np.linalg.solve(np.eye(30) + 7.0 * third.T @ third, values),
    )


def test_a_body_on_a_circle_reaches_the_steady_angle():
    radius = 20.0
    wheelbase = 3.0
    angle = np.arange(0, 4 * np.pi, 0.05 / radius)
    centre, heading = tractrix(
        radius * np.stack([np.cos(angle), np.sin(angle)], -1), np.array(wheelbase)
    )
    rear = np.sqrt(radius**2 - wheelbase**2)
    assert np.linalg.norm(centre[-1]) == pytest.approx(
        np.sqrt(rear**2 + (wheelbase / 2) ** 2), abs=0.01
    )
    assert (heading[-1] - heading[-101]) / (100 * 0.05) == pytest.approx(
        1 / radius, rel=1e-3
    )
