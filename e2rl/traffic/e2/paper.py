"""The guidance that the paper prints: anchoring once (eq. 14) and masked gradients of
two potentials (eqs. 15 and 16). `synthesizer=e2_paper` has it; the default attack has
not.

Guidance replaces the score s by s - grad V (Dhariwal and Nichol 2021), which moves the
clean estimate: x0 <- x0 - (sigma^2 / alpha) grad V. V_feas acts on all vehicles, eta
V_adv on the coalition alone, through the mask M_S.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS
from e2rl.prior.prior import Controlled, Denoising, Prior
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.config import configured, setting
from e2rl.traffic.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    annealed_temperature,
)

MIN_ALPHA = 0.05
TINY = 1e-12  # keeps a clip of 0, which is no shift at all, from 0 / 0
# V_feas acts at and below this noise level; above it the clean estimate has no shape.
FEASIBILITY_LEVEL = 0.5


@configured("synthesizer/e2_paper", "guidance")
@dataclass(frozen=True)
class GuidanceSettings:
    """Settings of eqs. 14 and 16; conf/synthesizer/e2_paper.yaml explains each."""

    gradient: str = setting(choices=("denoiser", "clean"))
    scaling: str = setting(choices=("score", "sigma"))
    adversarial_clip: float | None = setting(low=0, optional=True)
    feasibility: float = setting(low=0)
    feasibility_clip: float | None = setting(low=0, optional=True)
    anchor_level: float = setting(low=0, high=1)


def clip_rows(gradient: Tensor, limit: float | None) -> Tensor:
    """gradient [B, V, D] with each row's norm at most `limit`; None: any."""
    if limit is None:
        return gradient
    norm = gradient.norm(dim=-1, keepdim=True)
    return gradient * (limit / norm.clamp(min=max(limit, TINY)))


def gradient_weight(schedule: NoiseSchedule, level: Tensor, scaling: str) -> Tensor:
    """Factor between grad V and the shift of x0 at a noise level: sigma^2 / alpha,
    which is exact (score), or sigma."""
    sigma = schedule.sigma(level)
    if scaling == "sigma":
        return sigma
    return sigma**2 / schedule.alpha(level).clamp(min=MIN_ALPHA)


@dataclass
class LiteralAnchor:
    """Eq. 14, x <- (1 - w) x + w (alpha a + sigma e'), of proposals a with a noise e'.

    It shrinks the variance of the noise by (1 - w)^2 + w^2. knots [B, V, KNOTS] m/s^2:
    the proposals; vehicles [B, V] bool that have one; weight w in [0, 1]; noise
    [B, V, SIZE]. After sampling, `jump` [B, V] is the energy of the shift,
    ||shift||^2 / (2 sigma^2).
    """

    knots: Tensor
    vehicles: Tensor
    weight: float
    noise: Tensor

    def __post_init__(self) -> None:
        self.jump = self.noise.new_zeros(self.vehicles.shape)

    def __call__(self, step: Denoising) -> Tensor:
        """Returns x [B, V, SIZE] after the blend; of its clean estimate the proposals
        keep the lateral part."""
        schedule = step.prior.schedule
        with torch.no_grad():
            x0 = step.clean(step.x)
        proposal = torch.cat([self.knots / ACCEL_SCALE, x0[..., KNOTS:]], -1)
        noised = schedule.noised(proposal, step.level, self.noise)
        blend = (1 - self.weight) * step.x + self.weight * noised
        after = torch.where(self.vehicles[..., None], blend, step.x)
        energy = ((after - step.x) ** 2).sum(-1)
        self.jump = energy / (2 * schedule.sigma(step.level) ** 2)
        return after


@dataclass
class MaskedGuidance:
    """Eq. 16 for one replan of B scenes: the guidance of a SparseControl.

    conditions: what the potentials see; coalition [B, V] bool: C*, the mask M_S; eta
    [B]: intensity; anchor: None, eq. 14 does not act.
    """

    prior: Prior
    settings: GuidanceSettings
    potentials: PotentialSettings
    conditions: PotentialContext
    coalition: Tensor
    eta: Tensor
    anchor: LiteralAnchor | None = None

    def __post_init__(self) -> None:
        sampler = self.prior.sampler
        levels = sampler.levels(self.prior.schedule)[:-1]
        distance = (levels - self.settings.anchor_level).abs()
        self.anchor_step = sampler.steps - int(distance.argmin())
        shaped = int((levels <= FEASIBILITY_LEVEL).sum())
        self.feasibility_step = shaped if self.settings.feasibility > 0 else 0
        # Asked once, on the host: without a coalition V_adv is 0, and with a clip of 0
        # it has no effect.
        acts = self.settings.adversarial_clip != 0
        self.has_coalition = acts and bool(self.coalition.any())

    @property
    def jump(self) -> Tensor:
        """Energy [B, V] of eq. 14's shift."""
        if self.anchor is None:
            return torch.zeros(self.coalition.shape, device=self.eta.device)
        return self.anchor.jump

    def __call__(self, step: Denoising) -> Controlled:
        """Returns x after eq. 14, where that is due, the clean estimate x0 and the one
        guided by eq. 16, [B, V, SIZE] each."""
        if self.anchor is not None and step.k == self.anchor_step:
            step = replace(step, x=self.anchor(step))
        settings = self.settings
        with_feasibility = 1 < step.k <= self.feasibility_step
        x0, adversarial, feasibility = self._gradients(step, with_feasibility)
        guided = x0
        weight = gradient_weight(self.prior.schedule, step.level, settings.scaling)
        if self.has_coalition:
            shift = clip_rows(weight * adversarial, settings.adversarial_clip)
            eta = self.eta[:, None, None]
            guided = guided - eta * shift * self.coalition[..., None]
        if with_feasibility:
            shift = settings.feasibility * weight * feasibility
            shift = clip_rows(shift, settings.feasibility_clip)
            guided = guided - shift * step.context.active[..., None]
        return step.x, x0, guided

    def _gradients(
        self, step: Denoising, with_feasibility: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """x0, grad V_adv by x or by x0 as set, and grad V_feas by x0, [B, V, SIZE]
        each."""
        adversarial = feasibility = torch.zeros_like(step.x)
        through_network = self.has_coalition and self.settings.gradient == "denoiser"
        with torch.enable_grad():
            variable = step.x.detach().requires_grad_(through_network)
            denoised = step.clean(variable)
            x0 = denoised.detach().requires_grad_(True)
            if not self.has_coalition and not with_feasibility:
                return x0.detach(), adversarial, feasibility
            states = self.prior.decode(x0, step.context, steps=SAMPLED_STEPS).states()
            if self.has_coalition:
                temperature = annealed_temperature(step.level, self.potentials)
                value = self.potentials.adversarial(
                    states,
                    self.conditions,
                    temperature=temperature,
                )
                (adversarial,) = torch.autograd.grad(value.sum(), x0, retain_graph=True)
            if with_feasibility:
                value = self.potentials.feasibility(states, self.conditions)
                (feasibility,) = torch.autograd.grad(value.sum(), x0)
        if through_network:
            (adversarial,) = torch.autograd.grad(denoised, variable, adversarial)
        return x0.detach(), adversarial, feasibility
