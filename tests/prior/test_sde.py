"""The VP-SDE: its identities, samplers against Gaussian data, and the sign of guidance."""

import math

import pytest
import torch

from e2rl.prior.sde import NoiseSchedule, ddim_step, euler_maruyama_step, path_kl

SCHEDULE = NoiseSchedule()
MEAN, STD = 0.7, 0.5


def gaussian_denoiser(x, t, mean=MEAN, std=STD):
    """E[x_0 | x_t] of data N(mean, std^2)."""
    alpha, sigma = SCHEDULE.alpha(t), SCHEDULE.sigma(t)
    return mean + std**2 * alpha / (alpha**2 * std**2 + sigma**2) * (x - alpha * mean)


def draw(denoiser, step, steps, count=20_000, guide=None):
    """Samples of the reverse SDE: `step`(x, x0, high, low, noise) from each level to the next."""
    generator = torch.Generator().manual_seed(0)
    levels = SCHEDULE.levels(steps).double()
    x = torch.randn(count, generator=generator, dtype=torch.float64)
    for high, low in zip(levels[:-1], levels[1:], strict=True):
        x0 = denoiser(x, high) if guide is None else guide(x, high)
        x = step(x, x0, high, low, torch.randn(count, generator=generator, dtype=torch.float64))
    return x


def euler(x, x0, high, low, noise):
    return euler_maruyama_step(SCHEDULE, x, SCHEDULE.score(x, x0, high), high, low, noise)[0]


def test_variance_is_preserved_and_the_drift_is_the_schedule_s():
    t = torch.linspace(0.01, 0.98, 50, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(SCHEDULE.alpha(t) ** 2 + SCHEDULE.sigma(t) ** 2, torch.ones_like(t))
    (slope,) = torch.autograd.grad(SCHEDULE.alpha(t).sum(), t)
    x = torch.full_like(t, 2.0)
    torch.testing.assert_close(SCHEDULE.drift(x, t), x * slope / SCHEDULE.alpha(t), msg="d log alpha / dt")


def test_the_integral_of_beta_is_exact():
    low, high = torch.tensor(0.2, dtype=torch.float64), torch.tensor(0.9, dtype=torch.float64)
    grid = torch.linspace(0.2, 0.9, 20_001, dtype=torch.float64)
    torch.testing.assert_close(
        SCHEDULE.beta_integral(high, low), torch.trapezoid(SCHEDULE.beta(grid), grid), rtol=1e-6, atol=0
    )


def test_the_score_of_the_denoised_estimate_is_the_gradient_of_the_log_density():
    t = torch.tensor(0.4, dtype=torch.float64)
    x = torch.linspace(-2, 2, 9, dtype=torch.float64, requires_grad=True)
    alpha, sigma = SCHEDULE.alpha(t), SCHEDULE.sigma(t)
    density = -0.5 * (x - alpha * MEAN) ** 2 / (alpha**2 * STD**2 + sigma**2)
    (expected,) = torch.autograd.grad(density.sum(), x)
    torch.testing.assert_close(SCHEDULE.score(x, gaussian_denoiser(x, t), t), expected)


def test_noise_and_clean_estimate_are_two_views_of_the_same_x():
    t, x0, noise = torch.tensor(0.3), torch.randn(5), torch.randn(5)
    torch.testing.assert_close(SCHEDULE.noise(SCHEDULE.noised(x0, t, noise), x0, t), noise)


def test_an_ancestral_step_is_the_posterior_given_both_ends():
    """q(x_low | x_high, x_0) of the forward SDE, by conditioning a joint Gaussian."""
    high, low, x0 = torch.tensor(0.6, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64), 0.4
    ratio = SCHEDULE.alpha(high) / SCHEDULE.alpha(low)
    var_low, var_high = SCHEDULE.sigma(low) ** 2, SCHEDULE.sigma(high) ** 2
    x = torch.tensor(-1.1, dtype=torch.float64)
    mean = SCHEDULE.alpha(low) * x0 + ratio * var_low / var_high * (x - SCHEDULE.alpha(high) * x0)
    variance = var_low - (ratio * var_low) ** 2 / var_high
    after, scale = ddim_step(SCHEDULE, x, x0, high, low, torch.zeros_like(x), 1.0)
    torch.testing.assert_close(after, mean)
    torch.testing.assert_close(scale**2, variance)


def guided(sign):
    """Prior N(0, 1), V = (E[x_0 | x] - 2)^2 / 2, and the score s + sign grad V as a clean estimate."""

    def guide(x, t):
        x0 = gaussian_denoiser(x, t, 0.0, 1.0)
        gradient = SCHEDULE.alpha(t) * (x0 - 2)
        return x0 + sign * SCHEDULE.sigma(t) ** 2 / SCHEDULE.alpha(t) * gradient

    return guide


def test_moving_the_clean_estimate_is_moving_the_score():
    x, t = torch.linspace(-2, 2, 5), torch.tensor(0.5)
    gradient = torch.sin(x)
    x0 = gaussian_denoiser(x, t)
    shifted = x0 - SCHEDULE.sigma(t) ** 2 / SCHEDULE.alpha(t) * gradient
    torch.testing.assert_close(SCHEDULE.score(x, shifted, t), SCHEDULE.score(x, x0, t) - gradient)


def test_guidance_lowers_the_potential_and_the_printed_sign_raises_it():
    cost = lambda x: ((x - 2) ** 2 / 2).mean().item()  # noqa: E731
    plain, down, up = (draw(None, euler, 1000, guide=guided(sign)) for sign in (0, -1, 1))
    assert cost(plain) == pytest.approx(2.5, abs=0.1)
    assert cost(up) > 2 * cost(plain), "s + grad V climbs V"
    exact = (1.0 + 0.5) / 2  # the tilt exp(-V) of N(0, 1) is N(1, 1/2)
    assert cost(down) < exact - 0.1, "guidance by the plug-in estimate goes beyond the exact tilt"
    assert down.mean() > 1.1 and down.var() < 0.5


def test_path_kl_counts_only_steps_with_noise():
    shift = torch.tensor([[3.0, 4.0], [1.0, 0.0]])
    torch.testing.assert_close(path_kl(shift, torch.tensor(2.0)), torch.tensor([25.0 / 4, 1.0 / 4]))
    assert path_kl(shift, torch.tensor(0.0)).tolist() == [0, 0]


def test_levels_descend_to_the_data():
    levels = SCHEDULE.levels(8)
    assert levels[0].item() == pytest.approx(SCHEDULE.start) and levels[-1] == 0 and (levels.diff() < 0).all()
    assert SCHEDULE.alpha(levels[0]) < 0.05 and math.isclose(SCHEDULE.alpha(levels[-1]), 1.0)
