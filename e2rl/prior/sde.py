"""The prior's variance-preserving SDE: noising, score of a clean estimate x0, samplers,
discrete path KL.

Noise level t in [0, 1]: x_t = alpha(t) x_0 + sigma(t) eps with alpha = cos(pi t / 2),
sigma = sin(pi t / 2); as an SDE (eq. 1) dx = f dt + g dw with f = -beta(t) x / 2, g^2 =
beta(t) = pi tan(pi t / 2). The paper's gamma-bar_t (eq. 13) is alpha(t)^2.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.config import configured, setting
from e2rl.run.fused import Fused

# Noise level of the last of `steps` steps, times steps, where levels are spaced by
# log(alpha / sigma).
END = 0.24
SPACINGS = ("level", "log_ratio")
Past = tuple[Tensor, Tensor] | None  # clean estimate and noise level of a step
Stepped = tuple[Tensor, Tensor]  # x at the lower level, and the variance of its noise


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

    def noised(
        self,
        x0: Tensor,
        t: Tensor,
        noise: Tensor,
    ) -> Tensor:
        """A sample of x_t given x_0 (forward diffusion)."""
        return self.alpha(t) * x0 + self.sigma(t) * noise

    def score(
        self,
        x: Tensor,
        x0: Tensor,
        t: Tensor,
    ) -> Tensor:
        """Score of x_t given the clean estimate: (alpha x0 - x) / sigma^2."""
        return (self.alpha(t) * x0 - x) / self.sigma(t) ** 2

    def noise(
        self,
        x: Tensor,
        x0: Tensor,
        t: Tensor,
    ) -> Tensor:
        """The noise eps in x_t given x0."""
        return (x - self.alpha(t) * x0) / self.sigma(t)

    def log_ratio(self, t: Tensor) -> Tensor:
        """lambda(t) = log(alpha / sigma), half the log of the signal-to-noise ratio;
        infinite at 0."""
        return torch.log(self.alpha(t) / self.sigma(t))

    def levels(
        self,
        steps: int,
        device: torch.device | None = None,
        spacing: str = "level",
    ) -> Tensor:
        """Noise levels t_K > ... > t_0 = 0, [steps + 1].

        Args:
            steps: K.
            device: of the levels.
            spacing: `level`: evenly in t; `log_ratio`: evenly in log(alpha / sigma)
                from `start` to END / steps (Lu et al. 2022), then 0, where the last
                step takes the clean estimate itself and so leaves out the noise at its
                level.
        """
        if spacing == "level":
            return torch.linspace(self.start, 0.0, steps + 1, device=device)
        first = math.log(math.tan(0.5 * math.pi * self.start))
        last = math.log(math.tan(0.5 * math.pi * (END / steps)))
        ratio = torch.linspace(first, last, steps, device=device).exp()
        return torch.nn.functional.pad(torch.atan(ratio) * (2 / math.pi), (0, 1))


class Sampler(ABC):
    """Steps of the reverse process (eq. 1) from one noise level to a lower one.

    With the same noise and `past`, a step is affine in x0, so that two steps differ by
    the shift of their means.
    """

    def __init__(self, schedule: NoiseSchedule, churn: float = 1.0) -> None:
        """churn: DDIM's eta (Song et al. 2021, eq. 16), the fraction of ancestral noise
        in a step: 1 is the reverse SDE, 0 deterministic. Elsewhere eta is the
        adversarial intensity."""
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
        """x at the noise level `low`, and the variance of the noise in it.

        Args:
            x: [..., D] at the noise level `high`.
            x0: [..., D] its clean estimate.
            high: [] noise level of x.
            low: [] noise level to go to, above 0.
            noise: [..., D] standard normal.
            past: clean estimate and noise level of the previous step, None at the
                first.
        """


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
        alpha_low = schedule.alpha(low)
        sigma_low = schedule.sigma(low)
        ratio = (schedule.alpha(high) / alpha_low) ** 2
        ancestral = torch.sqrt((1 - ratio).clamp(min=0))
        scale = self.churn * sigma_low / schedule.sigma(high) * ancestral
        rest = torch.sqrt((sigma_low**2 - scale**2).clamp(min=0))
        mean = alpha_low * x0 + rest * schedule.noise(x, x0, high)
        return mean + scale * noise, scale**2


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
            past_x0, past_level = past
            begin = self.schedule.log_ratio(high)
            end = self.schedule.log_ratio(low)
            before = self.schedule.log_ratio(past_level)
            x0 = x0 + 0.5 * (end - begin) / (begin - before) * (x0 - past_x0)
        return super().step(x, x0, high, low, noise)


class EulerMaruyama(Sampler):
    """The paper's eq. 17: x_low = x - (f - g^2 score) |dt| + g sqrt|dt| noise, with
    g^2 |dt| the exact integral of beta over the step."""

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
    churn: float = setting(
        low=0,
        high=1,
    )
    temperature: float = setting(low=0)
    route_temperature: float = setting(low=0)

    def on(self, schedule: NoiseSchedule) -> Sampler:
        """The Sampler of this name."""
        return SAMPLERS[self.sampler](schedule, self.churn)

    def levels(
        self,
        schedule: NoiseSchedule,
        device: torch.device | None = None,
    ) -> Tensor:
        """The noise levels [steps + 1] of a replan."""
        return schedule.levels(self.steps, device, self.spacing)


class Estimates(NamedTuple):
    """Clean estimates x0 [B, V, D] at one visited state: under control, and the
    prior's own."""

    controlled: Tensor
    nominal: Tensor


class Interval(NamedTuple):
    """A step of the reverse process: the noise levels [] of the step before (in the
    first step any other than `high`), of its begin and of its end, and its noise
    [B, V, D]."""

    before: Tensor
    high: Tensor
    low: Tensor
    noise: Tensor


class Account(NamedTuple):
    """Path KL and log density ratio, control over prior, of the steps so far [B, V],
    and the budget of path KL of a scene [B]."""

    kl: Tensor
    log_ratio: Tensor
    budget: Tensor


class Moved(NamedTuple):
    """x [B, V, D] at the lower level, the clean estimate x0 [B, V, D] that led there,
    and the account [B, V] with this step."""

    x: Tensor
    x0: Tensor
    kl: Tensor
    log_ratio: Tensor


@cache
def fused_step(settings: SamplerSettings, size: int, limited: bool) -> Fused:
    """A step of x [B, V, size] under control, against what the prior would do from the
    same visited state (eq. 5 in discrete form); limited: there is a budget.

    A step that would exceed its scene's budget takes the fraction of its control that
    uses the budget up. In the first step the past estimates are the present ones.
    """
    sampler = settings.on(NoiseSchedule())
    temperature = settings.temperature

    def step(
        x: Tensor,
        clean: Estimates,
        past: Estimates,
        interval: Interval,
        account: Account,
    ) -> Moved:
        before, high, low, noise = interval
        x0, nominal = clean
        moved, variance = sampler.step(
            x,
            x0,
            high,
            low,
            noise,
            (past.controlled, before),
        )
        plain, _ = sampler.step(x, nominal, high, low, noise, (past.nominal, before))
        variance = variance * temperature**2
        added = path_kl(moved - plain, variance)
        if limited:
            fraction = within_budget(account.budget, account.kl, added)[:, None, None]
            moved = plain + fraction * (moved - plain)
            x0 = nominal + fraction * (x0 - nominal)
            added = fraction[..., 0] ** 2 * added
        martingale = path_martingale(
            moved - plain,
            noise,
            variance=variance,
            temperature=temperature,
        )
        return Moved(
            moved,
            x0,
            account.kl + added,
            account.log_ratio + added + martingale,
        )

    rows = f"B V {size}"
    shapes = (rows, rows, rows, ("", "", "", rows), ("B V", "B V", "B"))
    return Fused(step, shapes, settings=(settings, limited))


def within_budget(budget: Tensor, spent: Tensor, added: Tensor) -> Tensor:
    """Fraction [B] of a step's shift that keeps the path KL within the budget [B];
    spent, added [B, V]: path KL so far and of the whole shift. KL grows with the square
    of the shift."""
    left = (budget - spent.sum(-1)).clamp(min=0)
    return (left / added.sum(-1).clamp(min=1e-12)).clamp(max=1.0).sqrt()


def path_kl(shift: Tensor, variance: Tensor) -> Tensor:
    """Path KL [...] that one step adds (eq. 5 in discrete form): ||shift of the
    mean||^2 / (2 variance), of shift [..., D].

    Two Gaussians of equal variance have this divergence; the sum over the steps is the
    KL of the discrete paths (chain rule). Steps without noise have no density: 0 where
    the variance is 0.
    """
    energy = (shift**2).sum(-1)
    return torch.where(variance > 0, energy / (2 * variance.clamp(min=1e-12)), 0.0)


def path_martingale(
    shift: Tensor,
    noise: Tensor,
    *,
    variance: Tensor,
    temperature: float,
) -> Tensor:
    """What log q/p [...] of one step is beyond `path_kl`: shift . noise / standard
    deviation, of mean 0 under q.

    Args:
        shift: [..., D] of the mean.
        noise: [..., D] injected, `temperature` times a standard normal.
        variance: [] of the injection.
        temperature: scale of the noise.
    """
    along = (shift * noise).sum(-1) / (temperature * variance.clamp(min=1e-12).sqrt())
    return torch.where(variance > 0, along, 0.0)
