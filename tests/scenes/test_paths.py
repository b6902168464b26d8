"""Polylines against closed forms."""

import numpy as np
import pytest

from e2rl.scenes.paths import arc_length, shift_left


def test_a_circle_shifted_left_is_a_circle():
    angle = np.arange(0, 4 * np.pi, 0.2 / 30)
    circle = 30.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    moved = shift_left(circle, 2.0)
    assert np.allclose(np.linalg.norm(moved, axis=-1), 28.0, atol=0.02)
    assert arc_length(moved)[-1] == pytest.approx(
        arc_length(circle)[-1] * 28 / 30, rel=1e-3
    )
