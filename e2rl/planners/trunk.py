"""Layers of the learned egos: normalised observations, and a trunk over nearby agents.

Every nearby agent goes through the same layers, and the largest of each unit over the
agents joins the rest of the scene (Qi et al., PointNet, 2017; its effect:
docs/reference/learning.md).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from e2rl.planners.reference import AGENTS
from e2rl.run.fused import fused, is_on
from e2rl.sim.observation import NEAREST, OBSERVATION_SIZE, PER_AGENT

CLIPPED = 5.0  # standard deviations at which normalised numbers are clipped


class Normaliser(nn.Module):
    """Running mean and variance of observations; only `observe` changes them, so
    evaluation leaves them frozen."""

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, size: int, least_scale: float = 0.05) -> None:
        super().__init__()
        self.least_scale = least_scale
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))

    @torch.no_grad()
    def observe(self, observation: Tensor) -> None:
        """Update the statistics with observations [..., D] (Chan et al.'s pairwise
        update)."""
        flat = observation.reshape(-1, observation.shape[-1])
        total = self.count + len(flat)
        weight = (len(flat) / total).float()
        mean = flat.mean(0)
        delta = mean - self.mean
        variance = (
            (flat - mean).square().mean(0)  # as `var` takes long
            if is_on()
            else flat.var(0, correction=0)
        )
        spread = self.variance * (1 - weight) + variance * weight
        self.variance.copy_(spread + delta**2 * weight * (1 - weight))
        self.mean.add_(delta * weight)
        self.count.copy_(total)

    def forward(self, observation: Tensor) -> Tensor:
        """Observations less their mean, over their standard deviation or `least_scale`,
        clipped."""
        scale = self.variance.sqrt().clamp(min=self.least_scale)
        return ((observation - self.mean) / scale).clamp(-CLIPPED, CLIPPED)


class Largest(torch.autograd.Function):
    """`amax(1)` of [B, K, U], whose gradient is a fused function."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        largest = values.amax(1)
        ctx.save_for_backward(values, largest)
        return largest

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        values, largest = ctx.saved_tensors
        return shared(values, largest, grad)


@fused("B K U", "B U", "B U")
def shared(
    values: Tensor,
    largest: Tensor,
    grad: Tensor,
) -> Tensor:
    """The gradient of `Largest`: grad [B, U] is shared equally among the values [B, K,
    U] that are the largest."""
    ties = torch.where(values == largest[:, None], 1.0, 0.0)
    return ties * (grad / ties.sum(1))[:, None]


class Trunk(nn.Module):
    """Normalised observations [..., D] -> [..., out]; orthogonal weights, the last
    layer's (`last`) scaled."""

    def __init__(
        self,
        hidden: Sequence[int],
        agent_units: int,
        out: int,
        last_gain: float,
    ) -> None:
        """hidden: units of the layers of the whole scene, one at least; agent_units: of
        both layers of an agent."""
        super().__init__()
        first, *later = hidden
        self.agent = nn.Sequential(
            *_layer(PER_AGENT, agent_units),
            *_layer(
                agent_units,
                agent_units,
                norm=False,
            ),
        )
        rest_size = OBSERVATION_SIZE - PER_AGENT * NEAREST
        self.rest = nn.Sequential(*_layer(rest_size, first))
        self.joint = nn.Sequential()
        size = first + agent_units
        for units in later:
            self.joint.extend(_layer(size, units))
            size = units
        self.last = linear(size, out, gain=last_gain)

    def forward(self, normalised: Tensor) -> Tensor:
        """[..., out]."""
        agents = self.agent(normalised[..., AGENTS].unflatten(-1, (NEAREST, PER_AGENT)))
        fast = is_on() and agents.requires_grad and agents.dim() == 3
        largest = Largest.apply(agents) if fast else agents.amax(-2)
        before = normalised[..., : AGENTS.start]
        after = normalised[..., AGENTS.stop :]
        rest = self.rest(torch.cat([before, after], -1))
        return self.last(self.joint(torch.cat([rest, largest], -1)))


def _layer(
    fan_in: int,
    fan_out: int,
    norm: bool = True,
) -> list[nn.Module]:
    normalised = [nn.LayerNorm(fan_out)] if norm else []
    return [linear(fan_in, fan_out, gain=2**0.5), *normalised, nn.SiLU()]


def linear(
    fan_in: int,
    fan_out: int,
    gain: float,
) -> nn.Linear:
    """A layer of orthogonal weights, scaled by gain, without bias at first."""
    layer = nn.Linear(fan_in, fan_out)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
