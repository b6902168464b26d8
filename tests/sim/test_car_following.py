"""IDM: the desired gap, the equilibrium, free roads, and both free-road terms above the desired speed."""

import pytest
import torch

from e2rl.sim.leaders import IDMParameters, desired_gap, idm_acceleration

DRIVER = IDMParameters(headway=1.0, standstill_gap=5.0, acceleration=1.0, braking=3.0)


def gap(speed, leader_speed):
    driver = IDMParameters(headway=1.5, standstill_gap=2.0, acceleration=1.0, braking=4.0)
    return desired_gap(torch.tensor(speed), torch.tensor(leader_speed), driver).item()


def accel(speed, desired, gap, leading, improved):
    values = (torch.tensor(float(value)) for value in (speed, desired, gap, leading))
    return idm_acceleration(*values, DRIVER, improved).item()


def test_standing_following_closing_and_falling_behind():
    assert gap(0.0, 0.0) == pytest.approx(2.0)
    assert gap(10.0, 10.0) == pytest.approx(2.0 + 15.0)
    assert gap(10.0, 6.0) == pytest.approx(17.0 + 10 * 4 / (2 * 2.0))
    assert gap(10.0, 30.0) == pytest.approx(2.0)


@pytest.mark.parametrize("improved", [False, True])
def test_equilibrium_gap(improved):
    """At constant speed behind a leader of the same speed: gap = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    gap = (5 + 6 * 1.0) / (1 - (6 / 10) ** 4) ** 0.5
    assert abs(accel(6, 10, gap, 6, improved)) < 1e-5
    assert accel(6, 10, gap + 1, 6, improved) > 0 > accel(6, 10, gap - 1, 6, improved)


@pytest.mark.parametrize("improved", [False, True])
def test_approaching_brakes_and_receding_does_not(improved):
    behind = [accel(8, 10, 15, leading, improved) for leading in (2, 8, 12)]
    assert behind[0] < -1 and behind[0] < behind[1] < behind[2]


@pytest.mark.parametrize("improved", [False, True])
def test_a_free_road(improved):
    assert abs(accel(10, 10, torch.inf, 0, improved)) < 1e-6 and accel(0, 10, torch.inf, 0, improved) == 1.0


def test_above_the_desired_speed_only_the_improved_term_brakes_comfortably():
    assert -3.0 <= accel(20, 10, torch.inf, 0, True) < 0
    assert accel(20, 10, torch.inf, 0, False) == pytest.approx(1 - 2**4)
