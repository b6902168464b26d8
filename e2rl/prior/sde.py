"""The prior's variance-preserving SDE: noising, score of a clean estimate x0, samplers,
discrete path KL.

Noise level t in [0, 1]: x_t = alpha(t) x_0 + sigma(t) eps with alpha = cos(pi t / 2),
sigma = sin(pi t / 2); as an SDE dx = f dt + g dw with f = -beta(t) x / 2, g^2 = beta(t)
= pi tan(pi t / 2). The paper's gamma-bar_t is alpha(t)^2.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from e2rl.run.fused import Fused
from e2rl.run.settings import configured, setting

END = 0.24  # noise level of the last of `steps` steps, times steps, where levels are spaced by log(alpha / sigma)
SPACINGS = ("level", "log_ratio")
Past = tuple[Tensor, Tensor] | None  # clean estimate and noise level of a step
Stepped = tuple[
    Tensor, Tensor
]  # x at the lower level, and the variance of the noise in it


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
        """lambda(t) = log(alpha / sigma), half the log of the signal-to-noise ratio;
        infinite at 0."""
        return torch.log(self.alpha(t) / self.sigma(t))

    def levels(
        self, steps: int, device: torch.device | None = None, spacing: str = "level"
    ) -> Tensor:
        """Noise levels t_K > ... > t_0 = 0, [steps + 1].

        spacing: `level`: evenly in t; `log_ratio`: evenly in log(alpha / sigma) from
        `start` to END / steps (Lu et al. 2022), then 0, where the last step takes the
        clean estimate itself and so leaves out the noise at its level.
        """
        if spacing == "level":
            return torch.linspace(self.start, 0.0, steps + 1, device=device)
        first, last = (
            math.log(math.tan(0.5 * math.pi * t)) for t in (self.start, END / steps)
        )
        ratio = torch.linspace(first, last, steps, device=device).exp()
        return torch.nn.functional.pad(torch.atan(ratio) * (2 / math.pi), (0, 1))


class Sampler(ABC):
    """Steps of the reverse process from one noise level to a lower one.

    Given `past`, a step is affine in x0, so that two steps with the same noise differ
    by the shift of their means. churn: DDIM's eta (Song et al. 2021, eq. 16), the
    fraction of ancestral noise in a step: 1 is the reverse SDE, 0 deterministic. eta
    always means the adversarial intensity.
    """

    def __init__(self, schedule: NoiseSchedule, churn: float = 1.0) -> None:
        self.schedule = schedule
        self.churn = churn

    @abstractmethod
    def step(
        self,
        x: Tensor,
        x0: Tensor,
        high: Tensor,
        low: Tensor,
        noise: Tensor,
        past: Past = None,
    ) -> Stepped:
        """Returns x at the noise level `low`, above 0, from x and its clean estimate x0
        at level `high`. noise: standard normal, of the shape of x; past: of the
        previous step, None at the first."""


class DDIM(Sampler):
    """Song et al. 2021, eqs. 12 and 16; at churn 1 the ancestral sampler DDPM."""

    def step(
        self,
        x: Tensor,
        x0: Tensor,
        high: Tensor,
        low: Tensor,
        noise: Tensor,
        past: Past = None,
    ) -> Stepped:
        schedule = self.schedule
        alpha_high = schedule.alpha(high)
        alpha_low = schedule.alpha(low)
        sigma_high = schedule.sigma(high)
        sigma_low = schedule.sigma(low)
        ratio = (alpha_high / alpha_low) ** 2
        scale = (
            self.churn * sigma_low / sigma_high * torch.sqrt((1 - ratio).clamp(min=0))
        )
        eps = schedule.noise(x, x0, high)
        rest = torch.sqrt((sigma_low**2 - scale**2).clamp(min=0))
        return alpha_low * x0 + rest * eps + scale * noise, scale**2


class DPMSolverPP(DDIM):
    """DPM-Solver++(2M) (Lu et al. 2022, algorithm 2): second order at churn 0, its SDE
    variant at churn 1.

    A DDIM step with the clean estimate extrapolated to the middle of the step in
    log(alpha / sigma).
    """

    def step(
        self,
        x: Tensor,
        x0: Tensor,
        high: Tensor,
        low: Tensor,
        noise: Tensor,
        past: Past = None,
    ) -> Stepped:
        if past is not None:
            middle, last, end = (
                self.schedule.log_ratio(t) for t in (high, past[1], low)
            )
            x0 = x0 + 0.5 * (end - middle) / (middle - last) * (x0 - past[0])
        return super().step(x, x0, high, low, noise)


class EulerMaruyama(Sampler):
    """x_low = x - (f - g^2 score) |dt| + g sqrt|dt| noise, with g^2 |dt| the exact
    integral of beta over the step."""

    def step(
        self,
        x: Tensor,
        x0: Tensor,
        high: Tensor,
        low: Tensor,
        noise: Tensor,
        past: Past = None,
    ) -> Stepped:
        g2dt = self.schedule.beta_integral(high, low)
        score = self.schedule.score(x, x0, high)
        return x + 0.5 * g2dt * x + g2dt * score + torch.sqrt(g2dt) * noise, g2dt


SAMPLERS: dict[str, type[Sampler]] = {
    "ddim": DDIM,
    "dpm_solver_pp": DPMSolverPP,
    "euler_maruyama": EulerMaruyama,
}


@configured("prior/default", "sampler")
@dataclass(frozen=True)
class SamplerSettings:
    """How the prior samples (conf/prior/default.yaml)."""

    sampler: str = setting(choices=SAMPLERS)
    steps: int = setting(low=1)
    spacing: str = setting(choices=SPACINGS)
    churn: float = setting(low=0, high=1)
    temperature: float = setting(low=0)
    route_temperature: float = setting(low=0)

    def on(self, schedule: NoiseSchedule) -> Sampler:
        """The Sampler of this name."""
        return SAMPLERS[self.sampler](schedule, self.churn)

    def levels(
        self, schedule: NoiseSchedule, device: torch.device | None = None
    ) -> Tensor:
        """The noise levels [steps + 1] of a replan."""
        return schedule.levels(self.steps, device, self.spacing)


@cache
def fused_step(settings: SamplerSettings, size: int) -> Fused:
    """`Sampler.step` of these settings for x [B, V, size]: of x, x0, past x0, the
    levels past, high and low and noise, to x at level low. In the first step the past
    is x0 at any other level."""
    sampler = settings.on(NoiseSchedule())

    def step(
        x: Tensor,
        x0: Tensor,
        past: Tensor,
        last: Tensor,
        high: Tensor,
        low: Tensor,
        noise: Tensor,
    ) -> Tensor:
        return sampler.step(x, x0, high, low, noise, (past, last))[0]

    each = f"B V {size}"
    return Fused(step, (each, each, each, "", "", "", each), settings=settings)


@cache
def fused_controlled_step(settings: SamplerSettings, size: int, limited: bool) -> Fused:
    """A step under control, against what the prior would do from the same visited
    states; see `Prior.sample`.

    Of x, clean estimates x0 and nominal, those of the past, the levels past, high and
    low, noise, the KL and log ratio [B, V] so far and the budget [B] to x, x0, KL and
    log ratio. limited: there is a budget.
    """
    sampler = settings.on(NoiseSchedule())
    temperature = settings.temperature

    def step(*given: Tensor) -> tuple[Tensor, ...]:
        (
            x,
            x0,
            nominal,
            past,
            past_nominal,
            last,
            high,
            low,
            noise,
            kl,
            log_ratio,
            budget,
        ) = given
        moved, variance = sampler.step(x, x0, high, low, noise, (past, last))
        plain = sampler.step(x, nominal, high, low, noise, (past_nominal, last))[0]
        variance = variance * temperature**2
        added = path_kl(moved - plain, variance)
        if limited:
            fraction = within_budget(budget, kl, added=added)[:, None, None]
            moved = plain + fraction * (moved - plain)
            x0 = nominal + fraction * (x0 - nominal)
            added = fraction[..., 0] ** 2 * added
        martingale = path_martingale(
            moved - plain, noise, variance=variance, temperature=temperature
        )
        return moved, x0, kl + added, log_ratio + added + martingale

    each = f"B V {size}"
    return Fused(
        step,
        (*[each] * 5, "", "", "", each, "B V", "B V", "B"),
        settings=(settings, limited),
    )


def within_budget(budget: Tensor, spent: Tensor, added: Tensor) -> Tensor:
    """Fraction [B] of a step's shift that keeps the path KL within the budget [B];
    spent, added [B, V]: path KL so far and of the whole shift. KL grows with the square
    of the shift."""
    left = (budget - spent.sum(-1)).clamp(min=0)
    return (left / added.sum(-1).clamp(min=1e-12)).clamp(max=1.0).sqrt()


def path_kl(shift: Tensor, variance: Tensor) -> Tensor:
    """Path KL [...] that one step adds, ||shift of the mean||^2 / (2 variance), of
    shift [..., D].

    Two Gaussians of equal variance have this divergence; the sum over the steps is the
    KL of the discrete paths (chain rule). Steps without noise have no density: 0 where
    the variance is 0.
    """
    energy = (shift**2).sum(-1)
    return torch.where(
        variance > 0, energy / (2 * variance.clamp(min=1e-12)), torch.zeros_like(energy)
    )


def path_martingale(
    shift: Tensor, noise: Tensor, variance: Tensor, temperature: float
) -> Tensor:
    """What log q/p [...] of one step is beyond `path_kl`: shift . noise / standard
    deviation, of mean 0 under q.

    shift, noise [..., D]: of the mean, and what was injected, `temperature` times a
    standard normal; variance of the injection.
    """
    along = (shift * noise).sum(-1) / (temperature * variance.clamp(min=1e-12).sqrt())
    return torch.where(variance > 0, along, torch.zeros_like(along))
