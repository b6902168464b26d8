"""The two ways in which the rivals guide a diffusion prior by a loss of the decoded plan.

`MeanGuidance` moves the posterior mean of a step (CTG, Zhong et al. 2023), `CleanGuidance` the clean estimate
(Safe-Sim, Chang et al. 2024). Both are controls of `Prior.sample`, for S samples of B scenes at once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from e2rl.errors import InputError
from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context, Prior
from e2rl.prior.sde import reverse_step
from e2rl.rivals.samples import motion_of

Loss = Callable[[LaneState], Tensor]  # motion, fields [S, B, V, T] -> [S, B, V]; each row's own, others detached
Denoise = Callable[[Tensor], Tensor]
ROUNDING = 1e-3  # of Adam: its steps are as long for any gradient, so that rounding would decide where there is none


def check_noisy_sampler(prior: Prior, method: str) -> None:
    """InputError for samplers whose steps have no posterior mean and standard deviation."""
    sampler = prior.sampler
    if sampler.sampler == "dpm_solver_pp" or (sampler.sampler == "ddim" and sampler.churn == 0):
        raise InputError(
            f"prior.sampler.sampler={sampler.sampler}, churn={sampler.churn}: {method} moves the mean of ancestral "
            "steps by a share of their noise; use ddim with churn above 0, or euler_maruyama"
        )


@dataclass
class MeanGuidance:
    """Adam steps on the posterior mean z of x at the next level, whose decoded plan the loss rates.

    guided [S * B, V] bool: rows that move; limit [S * B]: largest change of an element, in standard deviations of the
    step's noise. The last step, which has no noise, is not guided.
    """

    prior: Prior
    loss: Loss
    guided: Tensor
    limit: Tensor
    samples: int
    step_size: float
    iterations: int

    def __call__(
        self, x: Tensor, level: Tensor, k: int, context: Context, denoise: Denoise
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `prior.Control`."""
        with torch.no_grad():
            x0 = denoise(x)
        if k == 1:
            return x, x0, x0
        sampler, schedule = self.prior.sampler, self.prior.schedule
        low, zero = schedule.levels(sampler.steps, x.device)[sampler.steps - k + 1], torch.zeros_like(level)
        step = partial(reverse_step, sampler.sampler, schedule, high=level, low=low, noise=zero, past=None)
        mean, variance = step(x=x, x0=x0, churn=sampler.churn)
        per_x0, _ = step(x=zero, x0=zero + 1, churn=sampler.churn)  # a step is affine in x0
        shift = self._shift(mean, self.limit[:, None, None] * variance.sqrt(), context)
        return x, x0, x0 + shift / per_x0

    def _shift(self, mean: Tensor, limit: Tensor, context: Context) -> Tensor:
        with torch.enable_grad():
            z = mean.detach().clone().requires_grad_(True)
            adam = torch.optim.Adam([z], lr=self.step_size, eps=ROUNDING)
            for _ in range(self.iterations):
                value = self.loss(motion_of(self.prior, z, context, self.samples)).sum()
                (z.grad,) = torch.autograd.grad(value, z)
                adam.step()
                z.data = mean + (z.data - mean).clamp(-limit, limit)
        return torch.where(self.guided[..., None], z.detach() - mean, 0.0)


@dataclass
class CleanGuidance:
    """A gradient step on the clean estimate, the gradient taken by the noisy x, through the network.

    guided [S * B, V] bool: rows that move; clip: largest change of an element at a step, in x.
    """

    prior: Prior
    loss: Loss
    guided: Tensor
    samples: int
    step_size: float
    clip: float

    def __call__(
        self, x: Tensor, level: Tensor, k: int, context: Context, denoise: Denoise
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `prior.Control`."""
        with torch.enable_grad():
            variable = x.detach().requires_grad_(True)
            x0 = denoise(variable)
            value = self.loss(motion_of(self.prior, x0, context, self.samples)).sum()
            (gradient,) = torch.autograd.grad(value, variable)
        shift = (self.step_size * gradient).clamp(-self.clip, self.clip)
        x0 = x0.detach()
        return x, x0, x0 - torch.where(self.guided[..., None], shift, 0.0)
