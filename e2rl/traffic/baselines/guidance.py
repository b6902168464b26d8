"""The two ways in which baselines guide a diffusion prior by a loss of the decoded
plan.

`MeanGuidance` moves the posterior mean of a step (CTG, Zhong et al. 2023),
`CleanGuidance` the clean estimate (Safe-Sim, Chang et al. 2024). Both are controls of
`Prior.sample`, for S samples of B scenes at once.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import (
    Context,
    Control,
    Controlled,
    Denoising,
    Prior,
    uncontrolled,
)
from e2rl.prior.sde import Past
from e2rl.run.config import setting
from e2rl.run.errors import InputError
from e2rl.traffic.baselines.baseline import Baseline
from e2rl.traffic.baselines.view import View, folded, motion_of, pick, tiled
from e2rl.traffic.nominal import Replan
from e2rl.traffic.traffic import State

# Motion, fields [S, B, V, T] -> [S, B, V]; each row's own, others detached.
Loss = Callable[[LaneState], Tensor]
Objective = Callable[[Tensor], Tensor]  # x [S * B, V, SIZE] -> [], the sum of a loss
# Of Adam: its steps are as long for any gradient, so rounding would decide where there
# is none.
ROUNDING = 1e-3


@dataclass
class MeanGuidance:
    """Adam steps on the posterior mean z of x at the next level, whose decoded plan the
    objective rates.

    guided [S * B, V] bool: rows that move; limit [S * B]: largest change of an element,
    in standard deviations of the step's noise. The last step, which has no noise, is
    not guided.
    """

    prior: Prior
    objective: Objective
    guided: Tensor
    limit: Tensor
    step_size: float
    iterations: int
    past: Past = None  # of the step, where the sampler is of second order

    def __call__(self, step: Denoising) -> Controlled:
        """See `prior.Control`."""
        x, x0, _ = uncontrolled(step)
        if step.k == 1:
            return x, x0, x0
        sampler = self.prior.sampler
        schedule = self.prior.schedule
        past = None if step.k == sampler.steps else self.past
        low = sampler.levels(schedule, x.device)[sampler.steps - step.k + 1]
        zero = torch.zeros_like(step.level)
        move = partial(
            sampler.on(schedule).step,
            high=step.level,
            low=low,
            noise=zero,
        )
        mean, variance = move(x=x, x0=x0, past=past)
        none = None if past is None else (zero, past[1])
        per_x0, _ = move(x=zero, x0=zero + 1, past=none)  # a step is affine in x0
        limit = self.limit[:, None, None] * variance.sqrt()
        moved = x0 + self._shift(mean, limit) / per_x0
        self.past = moved, step.level
        return x, x0, moved

    def _shift(self, mean: Tensor, limit: Tensor) -> Tensor:
        with torch.enable_grad():
            z = mean.detach().clone().requires_grad_(True)
            adam = torch.optim.Adam([z], lr=self.step_size, eps=ROUNDING)
            for _ in range(self.iterations):
                (z.grad,) = torch.autograd.grad(self.objective(z), z)
                adam.step()
                z.data = mean + (z.data - mean).clamp(-limit, limit)
        return torch.where(self.guided[..., None], z.detach() - mean, 0.0)


@dataclass
class CleanGuidance:
    """A gradient step on the clean estimate, the gradient taken by the noisy x, through
    the network.

    guided [S * B, V] bool: rows that move; clip: largest change of an element at a
    step, in x.
    """

    objective: Objective
    guided: Tensor
    step_size: float
    clip: float

    def __call__(self, step: Denoising) -> Controlled:
        """See `prior.Control`."""
        with torch.enable_grad():
            variable = step.x.detach().requires_grad_(True)
            x0 = step.clean(variable)
            (gradient,) = torch.autograd.grad(self.objective(x0), variable)
        shift = (self.step_size * gradient).clamp(-self.clip, self.clip)
        x0 = x0.detach()
        return step.x, x0, x0 - torch.where(self.guided[..., None], shift, 0.0)


@dataclass
class Samples:
    """S joint samples of B scenes: x0 [S * B, V, SIZE], kl [S * B, V] of their control,
    motion: their plans, fields [S, B, V, T]."""

    x0: Tensor
    kl: Tensor
    motion: LaneState


def guided_samples(
    prior: Prior,
    replan: Replan,
    context: Context,
    *,
    loss: Loss,
    control: Callable[[Objective], Control],
) -> Samples:
    """Returns joint samples under a control.

    Args:
        prior: that is guided.
        replan: holds the noise of S samples.
        context: of the replan.
        loss: of the samples' motion.
        control: of the loss, as a function of x.
    """
    count = replan.noise.shape[3]
    samples = tiled(context, count)
    motion = partial(
        motion_of,
        prior,
        context=samples,
        batch=len(context.active),
    )
    objective = control(lambda x: loss(motion(x)).sum())
    sample = prior.sample(samples, folded(replan.noise), objective)
    return Samples(sample.x0, sample.kl, motion=motion(sample.x0))


@dataclass(eq=False, repr=False)
class Guided(Baseline):
    """Every replan: guided joint samples, of which the one of least `loss` is driven."""

    samples: int = setting(low=1)

    guides_everybody = False  # or adversaries alone

    def attack(self, replan: Replan, context: Context) -> tuple[State, Tensor]:
        """Returns state and chosen joint sample x0 [G, V, SIZE]; scenes without
        strength keep the nominal one."""
        state = replan.state
        strength = self.strength(state)
        acts = (strength > 0)[:, None]
        view = View.of(replan, context, strength)
        view = replace(view, adversary=self.attackers(state, view) & acts)
        guided = view.adversary
        if self.guides_everybody:
            guided = view.active & acts
        samples = guided_samples(
            self.prior,
            replan,
            context,
            loss=partial(self.loss, view=view),
            control=partial(
                self.guidance,
                guided=guided.repeat(self.samples, 1),
                strength=strength.repeat(self.samples),
            ),
        )
        index = self.chosen(samples.motion, view, guided=guided)
        index = index * (acts[:, 0] if index.ndim == 1 else acts)
        kl = state.path_kl + pick(samples.kl, index)
        state = replace(state, adversary=view.adversary, path_kl=kl)
        return state, pick(samples.x0, index)

    def chosen(
        self,
        motion: LaneState,
        view: View,
        guided: Tensor,
    ) -> Tensor:
        """Sample [B] of each scene that is driven: that of least loss over the guided
        vehicles."""
        loss = torch.where(guided, self.loss(motion, view), 0.0)
        return loss.sum(-1).argmin(0)

    def attackers(self, state: State, view: View) -> Tensor:
        """Bool [B, V]: vehicles under adversarial control, all that the prior moves by
        default."""
        return view.active & self.adversarial

    @abstractmethod
    def loss(self, motion: LaneState, view: View) -> Tensor:
        """The loss of a replan (`Loss`)."""

    @abstractmethod
    def guidance(
        self,
        objective: Objective,
        guided: Tensor,
        strength: Tensor,
    ) -> Control:
        """The control of `Prior.sample`; guided [S * B, V] bool, strength [S * B]."""


@dataclass(eq=False, repr=False)
class MeanGuided(Guided):
    """Guided by `MeanGuidance`, clipped at the strength in standard deviations of a
    step's noise."""

    step_size: float = setting(low=0)
    iterations: int = setting(low=1)

    def __post_init__(self) -> None:
        """Raises InputError for samplers whose steps have no noise."""
        super().__post_init__()
        sampler = self.prior.sampler
        if sampler.churn == 0 and sampler.sampler != "euler_maruyama":
            raise InputError(
                f"prior.sampler.churn=0: {type(self).__name__} moves the mean of a step "
                "by a fraction of its noise, of which there is none; set it above 0"
            )

    def guidance(
        self,
        objective: Objective,
        guided: Tensor,
        strength: Tensor,
    ) -> MeanGuidance:
        """The control of `Prior.sample`."""
        return MeanGuidance(
            self.prior,
            objective,
            guided=guided,
            limit=strength,
            step_size=self.step_size,
            iterations=self.iterations,
        )
