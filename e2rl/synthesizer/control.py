"""Sparse gradient control (Sec. IV-B2): the masked control of one replan, inside every step of the reverse SDE.

Guidance replaces the score s by s - grad V (design.md 7.1), which is the same as moving the clean estimate:
x0 <- x0 - (sigma^2 / alpha) grad V. What is added here is a bound per vehicle, so that eta stays a usable dial: the
gradient is scaled by noise level and clipped before eta multiplies it; V_feas has a clip of its own. Only V_adv is
pulled back through the network: V_feas acts on the clean estimate, and only once that has taken shape
(`feasibility_level`), with the same outcome at a fraction of the cost.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.errors import InputError
from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS
from e2rl.prior.prior import Context, Prior
from e2rl.prior.sde import NoiseSchedule
from e2rl.synthesizer.anchoring import Anchor, blend_clean, blend_literal
from e2rl.synthesizer.potentials import (
    PotentialContext,
    PotentialSettings,
    adversarial_potential,
    annealed_temperature,
    feasibility_potential,
    sampled_steps,
)

MIN_ALPHA = 0.05
TINY = 1e-12  # keeps a clip of 0, which is no shift at all, from 0 / 0


@dataclass(frozen=True)
class ControlSettings:
    """conf/synthesizer/e2.yaml explains each."""

    gradient: str = "denoiser"
    scaling: str = "sigma"
    adversarial_clip: float = 0.5
    feasibility: float = 4.0
    feasibility_clip: float = 1.0
    feasibility_level: float = 0.5
    feasibility_scope: str = "all"
    anchoring: str = "clean"
    anchor_level: float = 0.2
    lookahead: int = 0
    transport_budget: float | None = None

    def __post_init__(self):
        for name, choices in (
            ("gradient", ("denoiser", "clean")),
            ("scaling", ("score", "sigma", "unit")),
            ("feasibility_scope", ("all", "support")),
            ("anchoring", ("clean", "literal", "off")),
        ):
            if getattr(self, name) not in choices:
                raise InputError(f"synthesizer.control.{name} is {getattr(self, name)!r}; choose one of {choices}")
        if self.transport_budget is not None and not self.transport_budget >= 0:
            raise InputError(
                f"synthesizer.control.transport_budget is {self.transport_budget}; expected at least 0, "
                "or null for no limit"
            )


def clip_rows(gradient: Tensor, limit: float) -> Tensor:
    """gradient [B, V, D] with each row's norm at most `limit`."""
    return gradient * (limit / gradient.norm(dim=-1, keepdim=True).clamp(min=max(limit, TINY)))


def gradient_weight(schedule: NoiseSchedule, level: Tensor, scaling: str) -> Tensor:
    """Factor between grad V and the shift of x0: score (sigma^2 / alpha) is the exact form, sigma and unit tame it."""
    alpha, sigma = schedule.alpha(level), schedule.sigma(level)
    if scaling == "score":
        return sigma**2 / alpha.clamp(min=MIN_ALPHA)
    return sigma if scaling == "sigma" else torch.ones_like(sigma)


class SparseControl:
    """The control of one replan of B scenes; called by `Prior.sample` at every noise level.

    eta [B]: intensity; coalition [B, V]: C*; anchor: the skeleton's proposal; anchor_noise [B, V, SIZE]: for the
    literal blend; react: the ego's states [B, HORIZON, 4] against planned states [B, V, HORIZON, 4], asked at
    settings.lookahead of the noise levels (None: its plan stays what it is). `jump` [B, V] holds the anchor's mean
    shift energy, ||shift||^2 / (2 sigma^2), after sampling.
    """

    def __init__(
        self,
        prior: Prior,
        settings: ControlSettings,
        potentials: PotentialSettings,
        where: PotentialContext,
        coalition: Tensor,
        eta: Tensor,
        anchor: Anchor,
        strength: float,
        anchor_noise: Tensor,
        react: Callable[[Tensor], Tensor] | None = None,
    ):
        self.prior, self.settings, self.potentials, self.where = prior, settings, potentials, where
        self.coalition, self.eta, self.anchor, self.strength = coalition, eta, anchor, strength
        self.anchor_noise, self.react = anchor_noise, react
        self.refreshed = (
            {round(prior.sampler.steps * i / (settings.lookahead + 1)) for i in range(1, settings.lookahead + 1)}
            if react is not None
            else set()
        )
        levels = prior.schedule.levels(prior.sampler.steps)
        nearest = int((levels[:-1] - settings.anchor_level).abs().argmin())
        self.anchor_step = prior.sampler.steps - nearest
        self.mend_step = int((levels[:-1] <= settings.feasibility_level).sum())
        self.jump = torch.zeros(coalition.shape, device=eta.device)
        self.hunts = bool(coalition.any())  # asked once, on the host: without a coalition V_adv is 0

    def __call__(
        self, x: Tensor, level: Tensor, k: int, context: Context, denoise: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(x after anchoring, denoised x0, controlled x0) at step k; anchoring comes first (design.md 7.2)."""
        if k == self.anchor_step and self.settings.anchoring != "off" and self.strength > 0:
            x = self._anchored(x, level, context, denoise)
        x0, towards, away = self._gradients(x, level, k, context, denoise)
        weight = gradient_weight(self.prior.schedule, level, self.settings.scaling)
        towards = clip_rows(weight * towards, self.settings.adversarial_clip)
        away = clip_rows(self.settings.feasibility * weight * away, self.settings.feasibility_clip)
        whom = context.active if self.settings.feasibility_scope == "all" else self.coalition
        shift = self.eta[:, None, None] * towards * self.coalition[..., None] + away * whom[..., None]
        acts = (context.active & (self.eta > 0)[:, None])[..., None]
        return x, x0, x0 - torch.where(acts, shift, 0.0)

    def _gradients(
        self, x: Tensor, level: Tensor, k: int, context: Context, denoise: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(x0, grad V_adv, grad V_feas): the one by x or x0, as set, the other by x0."""
        towards = away = torch.zeros_like(x)
        mends = k <= self.mend_step
        with torch.enable_grad():
            variable = x.detach().requires_grad_(self.hunts and self.settings.gradient == "denoiser")
            denoised = denoise(variable)
            x0 = denoised.detach().requires_grad_(True)
            if k in self.refreshed and self.hunts:
                planned = self.prior.decode(x0.detach(), context).states()
                self.where = replace(self.where, ego_plan=self.react(planned))
            if self.hunts or mends:
                states = self.prior.decode(x0, context, steps=sampled_steps(self.potentials)).states()
            if self.hunts:
                heat = annealed_temperature(level, self.potentials)
                threat = adversarial_potential(states, self.where, self.potentials, heat)
                (towards,) = torch.autograd.grad(threat.sum(), x0, retain_graph=True)
            if mends:
                infeasible = feasibility_potential(states, self.where, self.potentials)
                (away,) = torch.autograd.grad(infeasible.sum(), x0)
        if variable.requires_grad:
            (towards,) = torch.autograd.grad(denoised, variable, towards)
        return x0.detach(), towards, away

    def _anchored(self, x: Tensor, level: Tensor, context: Context, denoise) -> Tensor:
        """Topological anchoring of the coalition at this level; books the jump's energy."""
        with torch.no_grad():
            x0 = denoise(x)
        alpha, sigma = self.prior.schedule.alpha(level), self.prior.schedule.sigma(level)
        proposal = torch.cat([self.anchor.knots / ACCEL_SCALE, x0[..., KNOTS:]], -1)
        mask = self.anchor.has & self.coalition & context.active & (self.eta > 0)[:, None]
        if self.settings.anchoring == "clean":
            after = blend_clean(x, x0, proposal, alpha, mask, self.strength)
        else:
            after = blend_literal(x, proposal, alpha, sigma, mask, self.strength, self.anchor_noise)
        self.jump = ((after - x) ** 2).sum(-1) / (2 * sigma**2)
        return after
