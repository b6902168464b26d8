"""Sparse control (Sec. IV-B): the masked control of one replan, inside every step of
the reverse SDE.

Guidance replaces the score s by s - grad V (Dhariwal and Nichol 2021), which moves the
clean estimate: x0 <- x0 - (sigma^2 / alpha) grad V. To keep eta a usable dial, each
vehicle's gradient is scaled by the noise level and clipped before eta multiplies it.
Only V_adv is pulled back through the network; V_feas acts on the clean estimate, once
that has taken shape: the same outcome at a fraction of the cost.

Anchors and kernels pull the clean estimate to a goal at every step (`pulled`). The last
step has no noise, so that no control of it has a price in nats; it is the prior's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS, SIZE
from e2rl.prior.prior import Context, Prior
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.errors import InputError
from e2rl.run.fused import fused
from e2rl.run.settings import configured, setting
from e2rl.traffic.e2.anchoring import Anchor
from e2rl.traffic.e2.kernels import pulled
from e2rl.traffic.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    annealed_temperature,
)

MIN_ALPHA = 0.05
TINY = 1e-12  # keeps a clip of 0, which is no shift at all, from 0 / 0
FEASIBILITY_LEVEL = 0.5  # V_feas acts at and below this noise level; above it the clean estimate has no shape yet


@configured("synthesizer/e2", "control")
@dataclass(frozen=True)
class ControlSettings:
    """Settings of the guided reverse SDE; conf/synthesizer/e2.yaml explains each."""

    gradient: str = setting(choices=("denoiser", "clean"))
    scaling: str = setting(choices=("score", "sigma"))
    adversarial_clip: float = setting(low=0)
    feasibility: float = setting()
    feasibility_clip: float = setting(low=0)
    anchoring: str = setting(choices=("clean", "literal", "raw", "off"))
    anchor_level: float = setting(low=0, high=1)
    transport_budget: float | None = setting(low=0, optional=True)

    def __post_init__(self) -> None:
        """Raises InputError for a budget of nats beside raw proposals, which have no
        price."""
        if self.anchoring == "raw" and self.transport_budget is not None:
            raise InputError(
                "synthesizer.control.anchoring=raw drives proposals as they are, at no price in nats: set "
                "transport_budget=null"
            )


def clip_rows(gradient: Tensor, limit: float) -> Tensor:
    """gradient [B, V, D] with each row's norm at most `limit`."""
    return gradient * (
        limit / gradient.norm(dim=-1, keepdim=True).clamp(min=max(limit, TINY))
    )


def gradient_weight(schedule: NoiseSchedule, level: Tensor, scaling: str) -> Tensor:
    """Factor between grad V and the shift of x0 at a noise level: the exact sigma^2 /
    alpha (score), or sigma."""
    sigma = schedule.sigma(level)
    return (
        sigma
        if scaling == "sigma"
        else sigma**2 / schedule.alpha(level).clamp(min=MIN_ALPHA)
    )


@dataclass
class Pull:
    """Goals [B, V, SIZE] that vehicles [B, V] bool are pulled to, with `strength` [B]
    (see `pulled`)."""

    goal: Tensor
    vehicles: Tensor
    strength: Tensor

    def __call__(self, x0: Tensor, level: Tensor) -> Tensor:
        """x0 [B, V, SIZE] after the pull at a noise level; where a goal is NaN nothing
        pulls."""
        return pull_to(x0, self.goal, self.vehicles, self.strength, level)


@fused(f"B V {SIZE}", f"B V {SIZE}", "B V:bool", "B", "")
def pull_to(
    x0: Tensor, goal: Tensor, vehicles: Tensor, strength: Tensor, level: Tensor
) -> Tensor:
    """`Pull` of x0 at a noise level."""
    goal = torch.where(goal.isnan(), x0, goal)
    moved = pulled(
        x0,
        goal,
        strength=strength[:, None, None],
        level=level,
        schedule=NoiseSchedule(),
    )
    return torch.where(vehicles[..., None], moved, x0)


@dataclass
class SparseControl:
    """The control of one replan of B scenes; called by `Prior.sample` at every noise
    level.

    conditions: what the potentials see; coalition [B, V] bool: C*; eta [B]: intensity;
    anchor: the skeleton's proposal, with `strength`; anchor_noise [B, V, SIZE]: for the
    literal blend; kernel: what else is pulled. After sampling, `jump` [B, V] is the
    energy of the literal blend's shift, ||shift||^2 / (2 sigma^2).
    """

    prior: Prior
    settings: ControlSettings
    potentials: PotentialSettings
    conditions: PotentialContext
    coalition: Tensor
    eta: Tensor
    anchor: Anchor
    strength: float
    anchor_noise: Tensor
    kernel: Pull | None = None

    def __post_init__(self) -> None:
        steps = self.prior.sampler.steps
        levels = self.prior.sampler.levels(self.prior.schedule)[:-1]
        self.anchor_step = steps - int(
            (levels - self.settings.anchor_level).abs().argmin()
        )
        self.feasibility_step = (
            int((levels <= FEASIBILITY_LEVEL).sum())
            if self.settings.feasibility > 0
            else 0
        )
        self.jump = torch.zeros(self.coalition.shape, device=self.eta.device)
        # Asked once, on the host: without a coalition V_adv is 0, and with a clip of 0
        # it has no effect.
        self.has_coalition = self.settings.adversarial_clip > 0 and bool(
            self.coalition.any()
        )
        self.pulls = [] if self.kernel is None else [self.kernel]
        if self.settings.anchoring == "clean" and self.strength > 0:
            lateral = torch.full_like(self.anchor.knots[..., : SIZE - KNOTS], torch.nan)
            goal = torch.cat([self.anchor.knots / ACCEL_SCALE, lateral], -1)
            self.pulls.append(
                Pull(
                    goal,
                    self.anchor.feasible & self.coalition,
                    strength=self.strength * self.eta,
                )
            )

    def __call__(
        self,
        x: Tensor,
        level: Tensor,
        k: int,
        context: Context,
        denoise: Callable[[Tensor], Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """x [B, V, SIZE] of step k and its noise level -> (x after anchoring, clean
        estimate x0, controlled x0)."""
        settings = self.settings
        if (
            k == self.anchor_step
            and settings.anchoring == "literal"
            and self.strength > 0
        ):
            x = self._blended(x, level, context=context, denoise=denoise)
        x0, adversarial, feasibility = self._gradients(
            x, level, k=k, context=context, denoise=denoise
        )
        if k == 1:
            return x, x0, self._driven(x0)
        weight = gradient_weight(self.prior.schedule, level, scaling=settings.scaling)
        moved = x0
        if self.has_coalition:
            adversarial = clip_rows(weight * adversarial, settings.adversarial_clip)
            moved = (
                moved
                - self.eta[:, None, None] * adversarial * self.coalition[..., None]
            )
        if 1 < k <= self.feasibility_step:
            feasibility = clip_rows(
                settings.feasibility * weight * feasibility, settings.feasibility_clip
            )
            moved = moved - feasibility * context.active[..., None]
        for pull in self.pulls:
            moved = pull(moved, level)
        controlled = (context.active & (self.eta > 0)[:, None])[..., None]
        return x, x0, torch.where(controlled, moved, x0)

    def _driven(self, x0: Tensor) -> Tensor:
        """The last x0 [B, V, SIZE], where the accelerations of raw proposals take the
        place of the sample's."""
        if self.settings.anchoring != "raw":
            return x0
        raw = self.anchor.feasible & self.coalition & (self.eta > 0)[:, None]
        proposal = torch.cat(
            [self.anchor.knots / ACCEL_SCALE, torch.zeros_like(x0[..., KNOTS:])], -1
        )
        return torch.where(raw[..., None], proposal, x0)

    def _gradients(
        self,
        x: Tensor,
        level: Tensor,
        k: int,
        context: Context,
        denoise: Callable[[Tensor], Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(x0, grad V_adv by x or x0 as set, grad V_feas by x0)."""
        adversarial = feasibility = torch.zeros_like(x)
        with_feasibility = 1 < k <= self.feasibility_step
        with torch.enable_grad():
            variable = x.detach().requires_grad_(
                self.has_coalition and self.settings.gradient == "denoiser"
            )
            denoised = denoise(variable)
            x0 = denoised.detach().requires_grad_(True)
            if not self.has_coalition and not with_feasibility:
                return x0.detach(), adversarial, feasibility
            states = self.prior.decode(x0, context, steps=SAMPLED_STEPS).states()
            if self.has_coalition:
                temperature = annealed_temperature(level, self.potentials)
                value = self.potentials.adversarial(
                    states, self.conditions, temperature
                )
                (adversarial,) = torch.autograd.grad(value.sum(), x0, retain_graph=True)
            if with_feasibility:
                value = self.potentials.feasibility(states, self.conditions)
                (feasibility,) = torch.autograd.grad(value.sum(), x0)
        if variable.requires_grad:
            (adversarial,) = torch.autograd.grad(denoised, variable, adversarial)
        return x0.detach(), adversarial, feasibility

    def _blended(
        self,
        x: Tensor,
        level: Tensor,
        context: Context,
        denoise: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """x after the printed anchoring of proposal a, (1 - w) x + w (alpha a + sigma
        e'), eq. (anchor_injection). Books the energy of the shift in `jump`.

        With a noise e' of its own it shrinks the noise variance by (1 - w)^2 + w^2. It
        is kept for the ablation.
        """
        with torch.no_grad():
            x0 = denoise(x)
        schedule = self.prior.schedule
        strength = min(self.strength, 1.0)
        proposal = torch.cat([self.anchor.knots / ACCEL_SCALE, x0[..., KNOTS:]], -1)
        blend = (1 - strength) * x + strength * schedule.noised(
            proposal, level, self.anchor_noise
        )
        mask = (
            self.anchor.feasible
            & self.coalition
            & context.active
            & (self.eta > 0)[:, None]
        )
        after = torch.where(mask[..., None], blend, x)
        self.jump = ((after - x) ** 2).sum(-1) / (2 * schedule.sigma(level) ** 2)
        return after
