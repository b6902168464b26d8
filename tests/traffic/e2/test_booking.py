"""What a pull books in nats, on a standard normal prior whose denoiser is exact."""

import math

import pytest
import torch

from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings

COUNT = 50_000


class Pulled:
    """Control towards `goal` by the posterior mean of the tilt exp(-strength (x -
    goal)^2 / 2); strength 0 is the prior."""

    def __init__(self, schedule, goal, strength):
        self.schedule = schedule
        self.goal = goal
        self.strength = strength

    def __call__(self, step):
        variance = self.schedule.sigma(step.level) ** 2
        x0 = self.schedule.alpha(step.level) * step.x
        if step.k == 1:
            return step.x, x0, x0
        weight = self.strength * variance / (self.strength * variance + 1)
        return step.x, x0, x0 + weight * (self.goal - x0)


def drawn(strength, sampler="dpm_solver_pp", churn=1.0, steps=8):
    spacing = "level" if sampler == "euler_maruyama" else "log_ratio"
    settings = SamplerSettings(
        sampler=sampler,
        steps=steps,
        spacing=spacing,
        churn=churn,
        temperature=1.0,
        route_temperature=1.0,
    )
    prior = Prior(sampler=settings)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(steps, COUNT, 1, 1, generator=generator)
    return prior.sample(None, noise, Pulled(prior.schedule, 2.0, strength))


def divergence(first, second):
    """KL of two normals with the moments of samples."""
    spread = first.x0.std() / second.x0.std()
    shift = (first.x0.mean() - second.x0.mean()) / second.x0.std()
    return float((spread**2 + shift**2 - 1) / 2 - spread.log())


@pytest.mark.parametrize("strength", [1.0, 8.0])
@pytest.mark.parametrize(
    ("sampler", "steps", "most"),
    [("euler_maruyama", 8, 1.2), ("dpm_solver_pp", 8, 2.3), ("dpm_solver_pp", 64, 1.1)],
)
def test_a_pull_books_what_its_samples_cost_or_more(sampler, steps, most, strength):
    """Path KL is that of the discrete paths, above that of their ends (data
    processing): with eight second-order steps about twice."""
    pulled = drawn(strength, sampler, steps=steps)
    cost = divergence(pulled, drawn(0.0, sampler, steps=steps))
    booked = float(pulled.kl.mean())
    assert cost < booked < most * cost


def test_a_pull_draws_the_tilted_prior():
    """N(0, 1) tilted by exp(-4 (x - 2)^2) is N(16 / 9, 1 / 9)."""
    x0 = drawn(8.0).x0
    assert float(x0.mean()) == pytest.approx(16 / 9, abs=0.01)
    assert float(x0.std()) == pytest.approx(1 / 3, abs=0.02)


def test_log_ratios_are_booked_so_that_weights_average_one():
    """E_q[p / q] = 1 over the paths."""
    pulled = drawn(1.0, steps=64)
    weights = torch.exp(-pulled.log_ratio)
    error = float(weights.std()) / math.sqrt(COUNT)
    assert abs(float(weights.mean()) - 1) < 4 * error


def test_with_less_noise_the_same_shift_is_dearer():
    """Churn 0.3 books some ten times what the samples cost."""
    cost = divergence(drawn(8.0, churn=0.3), drawn(0.0, churn=0.3))
    assert float(drawn(8.0, churn=0.3).kl.mean()) > 5 * cost
