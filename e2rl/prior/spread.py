"""Several joint samples of one scene that lie well apart, each still drawn from the prior: stratified sampling.

Of S samples, each vehicle's uniform numbers are put one into each S-th of [0, 1), in an order drawn anew for each
vehicle. Any one sample is as random as before: its stratum is uniform, so is its place there, and both are independent
between vehicles. Only the samples of a vehicle know of each other.
"""

import torch
from torch import Tensor

from e2rl.prior.lane_relative import SIZE, way_weights
from e2rl.prior.prior import SamplerSettings
from e2rl.prior.sde import NoiseSchedule, reverse_step


def stratified(order: Tensor, place: Tensor) -> Tensor:
    """Uniform numbers [S, ...], one in each S-th of [0, 1).

    order [S, ...]: independent uniform numbers whose ranks say which S-th; place [...]: uniform, where in it.
    """
    return (order.argsort(0).argsort(0) + place) / len(order)


def impulses(schedule: NoiseSchedule, sampler: SamplerSettings, device=None) -> Tensor:
    """How much each of the `steps` slices of noise moves a coordinate of a sample [steps], were x0 standard normal: the
    sampler is then linear, and its answers to unit impulses are read off."""
    levels, noise = schedule.levels(sampler.steps, device), torch.eye(sampler.steps, device=device)
    x, past = noise[0], None
    for k in range(sampler.steps - 1):
        high, low = levels[k], levels[k + 1]
        x0 = schedule.alpha(high) * x  # the mean of a standard normal x0 given x_t
        x, _ = reverse_step(sampler.sampler, schedule, x, x0, high, low, noise[k + 1], sampler.churn, past)
        past = (x0, high)
    return x * schedule.alpha(levels[-2])


def main_direction(schedule: NoiseSchedule, sampler: SamplerSettings, device=None) -> Tensor:
    """Unit vector [steps, SIZE] of noise: along it the way driven grows fastest, in which samples differ most."""
    way = torch.zeros(SIZE, device=device)
    weights = way_weights(device)
    way[: len(weights)] = weights
    direction = impulses(schedule, sampler, device)[:, None] * way
    return direction / direction.norm()


def spread_noise(noise: Tensor, direction: Tensor, order: Tensor, place: Tensor) -> Tensor:
    """Standard normal noise [S, steps, B, V, SIZE] whose component along `direction` [steps, SIZE] is stratified over
    the S samples; order [S, B, V], place [B, V]: of `stratified`."""
    uniform = stratified(order, place).double().clamp(1e-6, 1 - 1e-6)
    wanted = torch.special.ndtri(uniform).to(noise.dtype)
    change = wanted - torch.einsum("skbvx,kx->sbv", noise, direction)
    return noise + change[:, None, ..., None] * direction[:, None, None]
