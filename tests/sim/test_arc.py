"""Constant acceleration and curvature: the unicycle's motion in closed form, to the halt."""

import pytest
import torch

from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.dynamics import Arc, along_arc


def test_an_arc_is_the_unicycle_s_motion_at_constant_acceleration_and_curvature():
    states, given = torch.tensor([1.0, -2.0, 0.4, 9.0]), Arc(torch.tensor(-3.0), torch.tensor(0.04))
    times = DT * torch.arange(1, 51)
    arc, driven = along_arc(states, given, times)
    speed = torch.nn.functional.pad(arc[:, 3], (1, 0), value=9.0)
    actions = torch.stack([torch.full((50,), -3.0), 0.04 * (speed[1:] + speed[:-1]) / 2], -1)
    torch.testing.assert_close(arc, dynamics.rollout(states, actions), rtol=0, atol=0.02)
    assert driven[-1].item() == pytest.approx(9.0**2 / 6, abs=1e-4), "to the halt, never backwards"
    assert (driven.diff() >= 0).all() and (arc[31:, 3] == 0).all()


def test_what_is_seen_lasts_a_while_then_speed_and_heading_stay():
    given, times = Arc(torch.tensor(2.0), torch.tensor(0.05)), torch.tensor([1.0, 2.0, 3.0, 4.0])
    arc, driven = along_arc(torch.tensor([0.0, 0.0, 0.0, 10.0]), given, times, hold=1.0, turn=2.0)
    torch.testing.assert_close(arc[:, 3], torch.full((4,), 12.0))
    torch.testing.assert_close(driven, torch.tensor([11.0, 23.0, 35.0, 47.0]))
    torch.testing.assert_close(arc[1:, 2], torch.full((3,), 1.0))
    assert arc[0, 2].item() == pytest.approx(0.55)
    torch.testing.assert_close((arc[3, :2] - arc[2, :2]).norm(), torch.tensor(12.0))
