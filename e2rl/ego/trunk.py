"""The network of the learned ego: every nearby agent passes the same layers, and the largest of each unit over the
agents joins the rest of the scene.

A flat network learns anew in each of the observation's twelve places what an agent there means. Which place one takes
says how near it is, not what it does; with shared layers, every agent teaches them (Qi et al., PointNet, 2017; what it
is worth here stands in docs/learning.md).
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from e2rl.ego.reference import AGENTS
from e2rl.sim.observation import NEAREST, OBSERVATION_SIZE, PER_AGENT


class Trunk(nn.Module):
    """Normalised observations [..., D] -> [..., out]; orthogonal weights, the last layer's (`last`) scaled."""

    def __init__(self, hidden: Sequence[int], agent_units: int, out: int, last_gain: float) -> None:
        """hidden: units of the layers of the whole scene, one at least; agent_units: of both layers of an agent."""
        super().__init__()
        rest, *later = hidden
        sizes = [rest + agent_units, *later]
        self.agent = nn.Sequential(*_layer(PER_AGENT, agent_units), *_layer(agent_units, agent_units, norm=False))
        self.rest = nn.Sequential(*_layer(OBSERVATION_SIZE - PER_AGENT * NEAREST, rest))
        deeper = zip(sizes[:-1], sizes[1:], strict=True)
        self.joint = nn.Sequential(*(module for pair in deeper for module in _layer(*pair)))
        self.last = linear(sizes[-1], out, last_gain)

    def forward(self, seen: Tensor) -> Tensor:
        """[..., out]."""
        agents = self.agent(seen[..., AGENTS].unflatten(-1, (NEAREST, PER_AGENT))).amax(-2)
        rest = self.rest(torch.cat([seen[..., : AGENTS.start], seen[..., AGENTS.stop :]], -1))
        return self.last(self.joint(torch.cat([rest, agents], -1)))


def _layer(fan_in: int, fan_out: int, norm: bool = True) -> list[nn.Module]:
    return [linear(fan_in, fan_out, 2**0.5), *([nn.LayerNorm(fan_out)] if norm else []), nn.SiLU()]


def linear(fan_in: int, fan_out: int, gain: float) -> nn.Linear:
    """A layer of orthogonal weights, scaled by gain, without bias at first."""
    layer = nn.Linear(fan_in, fan_out)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
