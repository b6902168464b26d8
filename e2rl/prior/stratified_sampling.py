"""Stratified sampling: several joint samples of a scene that lie well apart, each still
drawn from the prior.

Each vehicle's S uniform numbers lie in different S-ths of [0, 1), assigned in a random
order of the vehicle's own. Any single sample is as random as an independent one: its
stratum is uniform, so is its position in the stratum, and vehicles are independent.
Only the S samples of the same vehicle depend on each other.
"""

import torch
from torch import Tensor

from e2rl.prior.lane_relative import SIZE, distance_weights
from e2rl.prior.sde import NoiseSchedule, Past, SamplerSettings


def stratified_uniform(order: Tensor, position: Tensor) -> Tensor:
    """Uniform numbers [S, ...], one in each S-th of [0, 1).

    order [S, ...]: independent uniform numbers, whose ranks assign the S-ths; position
    [...]: uniform, within the S-th.
    """
    return (order.argsort(0).argsort(0) + position) / len(order)


def impulse_response(
    schedule: NoiseSchedule,
    sampler: SamplerSettings,
    device: torch.device | None = None,
) -> Tensor:
    """How far each of the sampler's `steps` noises moves a coordinate of a sample
    [steps], for standard normal x0.

    The sampler is linear then, and the answers to unit impulses are read off.
    """
    levels = sampler.levels(schedule, device)
    noise = torch.eye(sampler.steps, device=device)
    past: Past = None
    x = noise[0]
    step = sampler.on(schedule).step
    for k in range(sampler.steps - 1):
        high = levels[k]
        low = levels[k + 1]
        x0 = schedule.alpha(high) * x  # the mean of a standard normal x0 given x_t
        x, _ = step(x, x0, high, low, noise[k + 1], past)
        past = (x0, high)
    return x * schedule.alpha(levels[-2])


def main_direction(
    schedule: NoiseSchedule,
    sampler: SamplerSettings,
    device: torch.device | None = None,
) -> Tensor:
    """Unit vector [steps, SIZE] of noise along which the travelled distance, in which
    samples differ most, grows fastest."""
    gain = torch.zeros(SIZE, device=device)
    weights = distance_weights(device)
    gain[: len(weights)] = weights
    direction = impulse_response(schedule, sampler, device=device)[:, None] * gain
    return direction / direction.norm()


def stratified_noise(
    noise: Tensor, direction: Tensor, order: Tensor, position: Tensor
) -> Tensor:
    """Standard normal noise [S, steps, B, V, SIZE] whose component along `direction`
    [steps, SIZE] is stratified over the S samples; order [S, B, V] and position [B, V]:
    see `stratified_uniform`."""
    uniform = stratified_uniform(order, position).double().clamp(1e-6, 1 - 1e-6)
    wanted = torch.special.ndtri(uniform).to(noise.dtype)
    change = wanted - torch.einsum("skbvx,kx->sbv", noise, direction)
    return noise + change[:, None, ..., None] * direction[:, None, None]
