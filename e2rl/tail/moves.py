"""Moves in the noise that keep its law: preconditioned Crank-Nicolson (Cotter et al.
2013, eq. 4.8) of blocks of a rollout's standard normals.

x' = (1 - b^2)^(1/2) x + b xi with xi standard normal leaves N(0, 1) as it is, in any
number of dimensions. A block is everything, one vehicle, what comes after some replan,
or one vehicle after some replan; each kind has a step size b of its own, which follows
how often moves are accepted.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

ACCEPTED = 0.35  # fraction of moves that step sizes aim at
RATE = 1.5  # of the log step size, for each accepted fraction above ACCEPTED
LEAST = 0.02
KINDS = 4  # of blocks: bit 0, one vehicle; bit 1, after some replan


class Proposal(NamedTuple):
    """Moves of M particles: normals [M, V, D], and the kind of block [M] int64."""

    normals: Tensor
    kind: Tensor


@dataclass
class Moves:
    """Proposes moves in one scene, and learns their sizes there.

    Args:
        vehicle_weight: [V], how often a vehicle alone is moved, 0 for who never is.
        replan: [D] int64, in which each number of a vehicle acts.
        generator: of the moves.
    """

    vehicle_weight: Tensor
    replan: Tensor
    generator: torch.Generator

    def __post_init__(self) -> None:
        self.size = torch.tensor([0.5, 0.8, 0.8, 1.0], dtype=torch.float64)

    def propose(self, normals: Tensor) -> Proposal:
        """Returns moves of normals [M, V, D]."""
        count, vehicles, _ = normals.shape
        kind = torch.randint(KINDS, (count,), generator=self.generator)
        chosen = torch.ones(count, vehicles, dtype=torch.bool)
        alone = torch.multinomial(
            self.vehicle_weight, count, replacement=True, generator=self.generator
        )
        chosen[kind % 2 == 1] = False
        chosen[torch.arange(count), alone] = True
        replans = int(self.replan.amax()) + 1
        begin = torch.randint(replans, (count,), generator=self.generator)
        begin = begin * (kind >= 2)
        block = chosen[..., None] & (self.replan >= begin[:, None])[:, None]
        size = self.size[kind].to(normals.dtype)[:, None, None] * block
        fresh = torch.randn(normals.shape, generator=self.generator)
        return Proposal((1 - size**2).sqrt() * normals + size * fresh, kind)

    def learn(self, kind: Tensor, accepted: Tensor) -> None:
        """Adapt the step sizes to which moves [M] bool of kinds [M] were accepted."""
        for number in kind.unique().tolist():
            fraction = accepted[kind == number].double().mean()
            factor = torch.exp(RATE * (fraction - ACCEPTED))
            self.size[number] = (self.size[number] * factor).clamp(LEAST, 1.0)
