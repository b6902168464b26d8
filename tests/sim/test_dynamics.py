"""Unicycle: closed forms, bounds, inverse, agreement of the parallel rollout with the
recursion, gradients."""

import math

import pytest
import torch

from e2rl.scenes.recording import DT
from e2rl.sim import dynamics

# The values of docs/method.md.
MAX_SPEED = 40.0
MAX_LATERAL = 8.0
MAX_CURVATURE = 0.3


def random_case(batch=64, horizon=50, seed=0):
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(
        batch,
        4,
        generator=generator,
        dtype=torch.float64,
    ) * torch.tensor([50.0, 50, 6, 20])
    action = torch.randn(
        batch,
        horizon,
        2,
        generator=generator,
        dtype=torch.float64,
    ) * torch.tensor([6.0, 1.0])
    return start, action


def test_circle():
    """Constant speed and yaw rate: after a full turn the vehicle is back where it was."""
    steps = 100
    speed = 5.0
    actions = torch.tensor(
        [0.0, 2 * math.pi / (steps * DT)], dtype=torch.float64
    ).expand(steps, 2)
    start = torch.tensor([3.0, -2.0, 0.7, speed], dtype=torch.float64)
    end = dynamics.rollout(start, actions)[-1]
    assert torch.allclose(end[:2], start[:2], atol=1e-9)


def test_constant_acceleration_is_exact():
    states = dynamics.rollout(
        torch.tensor([0.0, 0, 0, 2]), torch.tensor([1.5, 0.0]).expand(40, 2)
    )
    t = DT * torch.arange(1, 41)
    assert torch.allclose(states[:, 0], 2 * t + 0.75 * t**2, atol=1e-4)


def test_rollout_equals_recursion_with_clipped_speeds():
    start, actions = random_case()
    parallel = dynamics.rollout(start, actions)
    state = start
    speeds = []
    for k in range(actions.shape[1]):
        expected = (state[:, 3] + actions[:, k, 0] * DT).clamp(0, MAX_SPEED)
        state = dynamics.step(state, actions[:, k])
        speeds.append(expected)
        assert torch.allclose(state, parallel[:, k], atol=1e-9)
    assert torch.allclose(torch.stack(speeds, 1), parallel[..., 3])
    assert (torch.stack(speeds, 1) == 0).any(), (
        "the case must reach the bound it is about"
    )


@pytest.mark.parametrize(
    ("acceleration", "distance"),
    [(0.0, -(2.0**2) / 6), (-5.0, -(2.0**2) / 6), (4.0, -0.5)],
)
def test_who_reverses_comes_to_a_halt_however_it_is_told_to_go_on(
    acceleration, distance
):
    """From 2 m/s in reverse at 3 m/s^2, or as hard as it is told to; then it stands, or
    drives on."""
    start = torch.tensor([0.0, 0.0, 0.0, -2.0])
    actions = torch.tensor([acceleration, 0.0]).expand(10, 2)
    states = dynamics.rollout(start, actions)
    state = start
    for expected in states:
        state = dynamics.step(state, actions[0])
        torch.testing.assert_close(state, expected)
    assert states[:, 0].min().item() == pytest.approx(distance, abs=0.03)
    assert states[-1, 3].item() == pytest.approx(
        max(0.0, acceleration * 1.0 - 2.0), abs=1e-5
    )


def test_who_reverses_and_brakes_harder_goes_on_from_the_speed_that_it_has():
    """From -4 m/s by 8 m/s^2 to -0.8; then by 3 m/s^2 at least, whatever it is told, to
    a halt; then as it is told."""
    accelerations = torch.tensor([8.0] * 4 + [-8.0] * 4 + [5.0, -8.0])
    states = dynamics.rollout(
        torch.tensor([0.0, 0.0, 0.0, -4.0]),
        torch.stack([accelerations, torch.zeros(10)], -1),
    )
    speeds = torch.tensor([-3.2, -2.4, -1.6, -0.8, -0.5, -0.2, 0.0, 0.0, 0.5, 0.0])
    torch.testing.assert_close(
        states[:, 3],
        speeds,
        rtol=0,
        atol=1e-5,
    )


def test_a_rollout_is_repeated_steps_forwards_and_backwards():
    start, actions = random_case(256, seed=4)
    start[:, 3] -= 10
    assert (start[:, 3] < 0).sum() > 100
    assert (dynamics.rollout(start, actions)[:, 5, 3] < 0).any()
    state = start
    for moment, expected in enumerate(dynamics.rollout(start, actions).unbind(1)):
        state = dynamics.step(state, actions[:, moment])
        torch.testing.assert_close(
            state,
            expected,
            rtol=0,
            atol=1e-9,
        )


def test_who_reverses_turns_within_the_steering_s_limits():
    """A path's curvature times the metres driven, which are negative."""
    state = dynamics.step(torch.tensor([0.0, 0.0, 0.0, -5.0]), torch.tensor([0.0, 9.0]))
    assert state[2].item() == pytest.approx(MAX_CURVATURE * 0.485, abs=1e-4)


def test_turns_respect_curvature_and_lateral_acceleration():
    start, actions = random_case(seed=1)
    states = torch.cat([start[:, None], dynamics.rollout(start, 10 * actions)], 1)
    rate = dynamics.wrap(states[:, 1:, 2] - states[:, :-1, 2]).abs() / DT
    speed = (states[:, 1:, 3] + states[:, :-1, 3]) / 2
    requests = (10 * actions[..., 1]).abs()
    allowed = torch.minimum(MAX_CURVATURE * speed, MAX_LATERAL / speed.clamp(min=1e-3))
    torch.testing.assert_close(rate, torch.minimum(requests, allowed))
    assert (requests < allowed).any()
    assert (speed > 6).any()
    assert (speed < 4).any(), "by steering lock, grip, or neither"


def test_inverse_returns_the_actions():
    start, actions = random_case(seed=2)
    actions = actions * torch.tensor([0.1, 0.02])
    start[:, 3] += 5
    states = torch.cat([start[:, None], dynamics.rollout(start, actions)], 1)
    assert torch.allclose(dynamics.inverse(states), actions, atol=1e-9)
    assert torch.allclose(
        dynamics.rollout(start, dynamics.inverse(states)), states[:, 1:], atol=1e-8
    )


@pytest.mark.parametrize("horizon", [1, 7])
def test_gradients_flow(horizon):
    start, actions = random_case(4, horizon, seed=3)
    start[:, 3] += 5
    actions = (actions * 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: dynamics.rollout(start, a), actions)


def test_the_curvature_that_is_expected_of_a_turn():
    rate = torch.tensor([0.5, -0.3, 0.05, 2.0])
    speed = torch.tensor([10.0, 6.0, 0.2, 5.0])
    result = dynamics.curvature_of(rate, speed)
    torch.testing.assert_close(result, torch.tensor([0.05, -0.05, 0.05, 0.12]))


def test_constant_velocity_is_a_rollout_without_actions():
    start, _ = random_case()
    actions = torch.zeros(len(start), 20, 2, dtype=torch.float64)
    times = DT * torch.arange(1, 21, dtype=torch.float64)
    result = dynamics.constant_velocity(start, times)
    expected = dynamics.rollout(start, actions)
    torch.testing.assert_close(result[..., :2], expected[..., :2])
    assert torch.equal(result[..., 2:], start[:, None, 2:].expand(-1, 20, -1))


@pytest.mark.parametrize(
    ("offset", "closing", "cost"),
    [
        ((10, 0), (-5, 0), 0.1353),
        ((10, 1), (-5, 0), 0.0821),
        ((5, 0), (-10, 0), 0.8825),
        ((10, 0), (5, 0), 0.0),
        ((40, 3), (0, 0), 0.0),
    ],
)
def test_the_cost_of_the_closest_approach_has_its_published_values(
    offset, closing, cost
):
    result = dynamics.closest_approach_cost(
        torch.tensor(offset).double(), torch.tensor(closing).double()
    )
    assert result.item() == pytest.approx(cost, abs=1e-4)


def test_nobody_is_faster_than_40_metres_a_second():
    states = dynamics.rollout(
        torch.tensor([0.0, 0.0, 0.0, 39.0]), torch.tensor([5.0, 0.0]).expand(10, 2)
    )
    assert states[:, 3].max().item() == MAX_SPEED
