"""Unicycle: closed forms, bounds, inverse, agreement of the parallel rollout with the recursion, gradients."""

import math

import pytest
import torch

from e2rl.scenes.recording import DT
from e2rl.sim import dynamics


def random_case(batch=64, horizon=50, seed=0):
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(batch, 4, generator=generator, dtype=torch.float64) * torch.tensor([50.0, 50, 6, 20])
    action = torch.randn(batch, horizon, 2, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 1.0])
    return start, action


def test_circle():
    """Constant speed and yaw rate: after a full turn the vehicle is back where it was."""
    steps, speed = 100, 5.0
    actions = torch.tensor([0.0, 2 * math.pi / (steps * DT)], dtype=torch.float64).expand(steps, 2)
    start = torch.tensor([3.0, -2.0, 0.7, speed], dtype=torch.float64)
    end = dynamics.rollout(start, actions)[-1]
    assert torch.allclose(end[:2], start[:2], atol=1e-9)


def test_constant_acceleration_is_exact():
    states = dynamics.rollout(torch.tensor([0.0, 0, 0, 2]), torch.tensor([1.5, 0.0]).expand(40, 2))
    t = DT * torch.arange(1, 41)
    assert torch.allclose(states[:, 0], 2 * t + 0.75 * t**2, atol=1e-4)


def test_a_step_is_a_rollout_of_one():
    start, actions = random_case()
    start, action = start.float(), actions[:, 0].float()
    assert torch.equal(dynamics.step(start, action), dynamics.rollout(start, action[:, None])[:, 0])


def test_rollout_equals_recursion_with_clipped_speeds():
    start, actions = random_case()
    parallel = dynamics.rollout(start, actions)
    state, speeds = start, []
    for k in range(actions.shape[1]):
        expected = (state[:, 3] + actions[:, k, 0] * DT).clamp(0, dynamics.MAX_SPEED)
        state = dynamics.step(state, actions[:, k])
        speeds.append(expected)
        assert torch.allclose(state, parallel[:, k], atol=1e-9)
    assert torch.allclose(torch.stack(speeds, 1), parallel[..., 3])
    assert (torch.stack(speeds, 1) == 0).any(), "the case must reach the bound it is about"


def test_turns_respect_curvature_and_lateral_acceleration():
    start, actions = random_case(seed=1)
    states = torch.cat([start[:, None], dynamics.rollout(start, 10 * actions)], 1)
    rate = dynamics.wrap(states[:, 1:, 2] - states[:, :-1, 2]).abs() / DT
    speed = (states[:, 1:, 3] + states[:, :-1, 3]) / 2
    assert (rate <= dynamics.MAX_CURVATURE * speed + 1e-9).all()
    assert (rate * speed <= dynamics.MAX_LATERAL + 1e-9).all()


def test_inverse_returns_the_actions():
    start, actions = random_case(seed=2)
    actions = actions * torch.tensor([0.1, 0.02])
    start[:, 3] += 5
    states = torch.cat([start[:, None], dynamics.rollout(start, actions)], 1)
    assert torch.allclose(dynamics.inverse(states), actions, atol=1e-9)
    assert torch.allclose(dynamics.rollout(start, dynamics.inverse(states)), states[:, 1:], atol=1e-8)


@pytest.mark.parametrize("horizon", [1, 7])
def test_gradients_flow(horizon):
    start, actions = random_case(4, horizon, seed=3)
    start[:, 3] += 5
    actions = (actions * 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: dynamics.rollout(start, a), actions)


def test_constant_velocity_is_a_rollout_without_actions():
    start, _ = random_case()
    actions = torch.zeros(len(start), 20, 2, dtype=torch.float64)
    times = DT * torch.arange(1, 21, dtype=torch.float64)
    found, expected = dynamics.constant_velocity(start, times), dynamics.rollout(start, actions)
    torch.testing.assert_close(found[..., :2], expected[..., :2])
    assert torch.equal(found[..., 2:], start[:, None, 2:].expand(-1, 20, -1))
