"""The prior's variance-preserving SDE: noising, score from the clean estimate x0, sampler steps, discrete path KL.

Noise level t in [0, 1]: x_t = alpha(t) x_0 + sigma(t) eps with alpha = cos(pi t / 2), sigma = sin(pi t / 2); as an SDE
dx = f dt + g dw with f = -beta(t) x / 2, g^2 = beta(t) = pi tan(pi t / 2). The paper's gamma-bar_t is alpha(t)^2.

DDIM's parameter eta (Song et al. 2021, eq. 16: the share of ancestral noise in a step) is called `churn` everywhere in
this repository: eta always means the adversarial intensity.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NoiseSchedule:
    """Cosine VP-SDE; sampling runs over `levels(steps)` from `start` down to 0."""

    start: float = 0.98

    def alpha(self, t: Tensor) -> Tensor:
        """Signal scale alpha(t)."""
        return torch.cos(0.5 * math.pi * t)

    def sigma(self, t: Tensor) -> Tensor:
        """Noise scale sigma(t)."""
        return torch.sin(0.5 * math.pi * t)

    def beta(self, t: Tensor) -> Tensor:
        """beta(t) = g(t)^2."""
        return math.pi * torch.tan(0.5 * math.pi * t)

    def drift(self, x: Tensor, t: Tensor) -> Tensor:
        """f(x, t) of the forward SDE."""
        return -0.5 * self.beta(t) * x

    def beta_integral(self, high: Tensor, low: Tensor) -> Tensor:
        """Integral of beta over [low, high]: 2 log(alpha(low) / alpha(high))."""
        return 2.0 * torch.log(self.alpha(low) / self.alpha(high))

    def noised(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """A sample of x_t given x_0 (forward diffusion)."""
        return self.alpha(t) * x0 + self.sigma(t) * noise

    def score(self, x: Tensor, x0: Tensor, t: Tensor) -> Tensor:
        """Score of x_t given the clean estimate: (alpha x0 - x) / sigma^2."""
        return (self.alpha(t) * x0 - x) / self.sigma(t) ** 2

    def noise(self, x: Tensor, x0: Tensor, t: Tensor) -> Tensor:
        """The noise eps in x_t given x0."""
        return (x - self.alpha(t) * x0) / self.sigma(t)

    def log_ratio(self, t: Tensor) -> Tensor:
        """lambda(t) = log(alpha / sigma), half the log of the signal-to-noise ratio; infinite at 0."""
        return torch.log(self.alpha(t) / self.sigma(t))

    def levels(self, steps: int, device: torch.device | None = None) -> Tensor:
        """Noise levels t_K > ... > t_0 = 0, [steps + 1], evenly spaced."""
        return torch.linspace(self.start, 0.0, steps + 1, device=device)


def euler_maruyama_step(
    schedule: NoiseSchedule, x: Tensor, score: Tensor, high: Tensor, low: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor]:
    """One step of the reverse SDE from level high to low: (x_low, g^2 |dt|).

    x_low = x - (f - g^2 score) |dt| + g sqrt|dt| noise, with g^2 |dt| the exact integral of beta over the step.
    """
    g2dt = schedule.beta_integral(high, low)
    return x + 0.5 * g2dt * x + g2dt * score + torch.sqrt(g2dt) * noise, g2dt


def ddim_step(
    schedule: NoiseSchedule, x: Tensor, x0: Tensor, high: Tensor, low: Tensor, noise: Tensor, churn: float
) -> tuple[Tensor, Tensor]:
    """One step from level high to low (Song et al. 2021, eqs. 12 and 16): (x_low, standard deviation of its noise).

    churn (DDIM's eta): 1 is the ancestral sampler DDPM, 0 deterministic DDIM.
    """
    alpha_high, alpha_low = schedule.alpha(high), schedule.alpha(low)
    sigma_high, sigma_low = schedule.sigma(high), schedule.sigma(low)
    ratio = (alpha_high / alpha_low) ** 2
    scale = churn * sigma_low / sigma_high * torch.sqrt((1 - ratio).clamp(min=0))
    eps = schedule.noise(x, x0, high)
    rest = torch.sqrt((sigma_low**2 - scale**2).clamp(min=0))
    return alpha_low * x0 + rest * eps + scale * noise, scale


def multistep_estimate(
    schedule: NoiseSchedule, x0: Tensor, past: Tensor, before: Tensor, high: Tensor, low: Tensor
) -> Tensor:
    """The clean estimate of a DPM-Solver++(2M) step (Lu et al. 2022, algorithm 2).

    x0 at level high is extrapolated to the middle of the step in log(alpha / sigma), with the estimate `past` of the
    previous level `before`. A ddim_step with it is 2M: second order at churn 0, the SDE variant at churn 1. The level
    low must be above 0.
    """
    middle, last, end = (schedule.log_ratio(t) for t in (high, before, low))
    return x0 + 0.5 * (end - middle) / (middle - last) * (x0 - past)


SAMPLERS = ("ddim", "dpm_solver_pp", "euler_maruyama")


def reverse_step(
    sampler: str,
    schedule: NoiseSchedule,
    x: Tensor,
    x0: Tensor,
    high: Tensor,
    low: Tensor,
    noise: Tensor,
    churn: float,
    past: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """One step of a sampler of SAMPLERS from level high to low > 0: (x_low, variance of the injected noise).

    past: clean estimate and level of the previous step, None at the first; dpm_solver_pp alone uses it. Given past,
    every step is affine in x0, so that two steps with the same noise differ by the shift of their means.
    """
    if sampler == "euler_maruyama":
        return euler_maruyama_step(schedule, x, schedule.score(x, x0, high), high, low, noise)
    if sampler == "dpm_solver_pp" and past is not None:
        x0 = multistep_estimate(schedule, x0, *past, high, low)
    after, scale = ddim_step(schedule, x, x0, high, low, noise, churn)
    return after, scale**2


def path_kl(shift: Tensor, variance: Tensor) -> Tensor:
    """Path KL [...] that one step adds, ||shift of the mean||^2 / (2 variance), of shift [..., D].

    Two Gaussians of equal variance have this divergence; the sum over the steps is the KL of the discrete paths (chain
    rule). Steps without noise have no density: 0 where the variance is 0.
    """
    energy = (shift**2).sum(-1)
    return torch.where(variance > 0, energy / (2 * variance.clamp(min=1e-12)), torch.zeros_like(energy))
