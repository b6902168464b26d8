"""Gaussian data in closed form: the exact denoiser, the exact flow, and the moments
that a sampler gives it."""

import torch

from e2rl.prior.sde import SAMPLERS, NoiseSchedule

SCHEDULE = NoiseSchedule()


def denoiser(mean, std):
    """E[x_0 | x_t] of data N(mean, std^2), as a function of x and t."""

    def estimate(x, t):
        alpha = SCHEDULE.alpha(t)
        sigma = SCHEDULE.sigma(t)
        return mean + std**2 * alpha / (alpha**2 * std**2 + sigma**2) * (
            x - alpha * mean
        )

    return estimate


def flow(
    x,
    mean,
    std,
    high,
    low,
):
    """Where the probability-flow ODE of N(mean, std^2) leads x from level high to level
    low."""
    spread = [
        torch.sqrt(SCHEDULE.alpha(t) ** 2 * std**2 + SCHEDULE.sigma(t) ** 2)
        for t in (low, high)
    ]
    return SCHEDULE.alpha(low) * mean + spread[0] / spread[1] * (
        x - SCHEDULE.alpha(high) * mean
    )


def run(
    estimate,
    sampler,
    levels,
    noise,
):
    """The sampler's x at the last of levels, or x0 where that is 0; noise [len(levels)
    - 1, ...]."""
    x = noise[0]
    past = None
    name, churn = sampler
    step = SAMPLERS[name](SCHEDULE, churn).step
    for k, (high, low) in enumerate(zip(levels[:-1], levels[1:], strict=True)):
        x0 = estimate(x, high)
        if low == 0:
            return x0
        x, _ = step(x, x0, high, low, noise[min(k + 1, len(noise) - 1)], past)
        past = x0, high
    return x


def moments(
    estimate,
    sampler,
    steps,
    spacing="level",
):
    """Exact mean and standard deviation of K-step samples where the estimate is affine
    in x: samples are affine in the noises then, and one run with no noise and one with
    each noise alone give all their coefficients."""
    noise = torch.cat([torch.zeros(steps, 1), torch.eye(steps)], 1).double()
    x = run(
        estimate,
        sampler,
        SCHEDULE.levels(steps, spacing=spacing).double(),
        noise=noise,
    )
    return x[0].item(), (x[1:] - x[0]).norm().item()
