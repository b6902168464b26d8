"""The wanted gap: standstill, steady following, closing in, and never below the standstill gap."""

import pytest
import torch

from e2rl.sim.car_following import desired_gap


def gap(speed, leading):
    return desired_gap(torch.tensor(speed), torch.tensor(leading), 1.5, 2.0, 1.0, 4.0).item()


def test_standing_following_closing_and_falling_behind():
    assert gap(0.0, 0.0) == pytest.approx(2.0)
    assert gap(10.0, 10.0) == pytest.approx(2.0 + 15.0)
    assert gap(10.0, 6.0) == pytest.approx(17.0 + 10 * 4 / (2 * 2.0))
    assert gap(10.0, 30.0) == pytest.approx(2.0)
