"""The prior as a decoder of latents: deterministic DDIM from pure noise, differentiable, in few steps."""

import torch
from torch import Tensor

from e2rl.prior.prior import Context, Prior
from e2rl.prior.sde import ddim_step


def decode_latent(prior: Prior, latent: Tensor, context: Context, steps: int) -> Tensor:
    """x0 [B, V, SIZE] of latents [B, V, SIZE], the noise at the highest level, by `steps` passes of the network."""
    levels, x = prior.schedule.levels(steps, latent.device), latent
    zero = torch.zeros_like(levels[0])
    for high, low in zip(levels[:-2], levels[1:-1], strict=True):
        x = ddim_step(prior.schedule, x, prior.denoise(x, high, context), high, low, zero, 0.0)[0]
    return prior.denoise(x, levels[-2], context)
