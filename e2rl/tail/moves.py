"""Moves in the noise that keep its law: preconditioned Crank-Nicolson (Cotter et al.
2013, eq. 4.8) of blocks of a rollout's standard normals.

x' = (1 - b^2)^(1/2) x + b xi with xi standard normal leaves N(0, 1) as it is, in any
number of dimensions. A block is everything, one vehicle, what comes after some replan,
or one vehicle after some replan. Each kind has a step size b of its own, which follows
how often moves are accepted. Vehicles that the level does not depend on, and replans
after the moment that it is taken at, are found out by moves that leave it as it is, and
become rarer.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

ACCEPTED = 0.35  # fraction of moves that step sizes aim at
RATE = 1.5  # of the log step size, for each accepted fraction above ACCEPTED
LEAST = 0.02
KINDS = 4  # of blocks: bit 0, one vehicle; bit 1, after some replan


PRIOR = 2.0  # moves of each vehicle and replan that count as made before, with effect


class Proposal(NamedTuple):
    """Moves of M particles.

    Args:
        normals: [M, V, D].
        kind: of block, [M] int64.
        vehicle: that is moved alone, [M] int64; -1 for all.
        begin: first replan of the block, [M] int64.
    """

    normals: Tensor
    kind: Tensor
    vehicle: Tensor
    begin: Tensor


class Effects:
    """How often moves that name one of N things changed the level."""

    def __init__(self, count: int) -> None:
        self.changed = torch.full((count,), PRIOR, dtype=torch.float64)
        self.tried = torch.full((count,), PRIOR, dtype=torch.float64)

    @property
    def share(self) -> Tensor:
        """Of each [N], the share of its moves with an effect."""
        return self.changed / self.tried

    def count(self, index: Tensor, changed: Tensor) -> None:
        """Count moves index [M] int64, of which some `changed` [M] bool the level."""
        ones = torch.ones(len(index), dtype=torch.float64)
        self.tried.index_add_(0, index, ones)
        self.changed.index_add_(0, index, changed.double())


@dataclass
class Moves:
    """Proposes moves in one scene, and learns their sizes and blocks there.

    Args:
        vehicle_weight: [V], how often a vehicle alone is moved at first, 0 for who never
            is.
        replan: [D] int64, in which each number of a vehicle acts.
        generator: of the moves.
    """

    vehicle_weight: Tensor
    replan: Tensor
    generator: torch.Generator

    def __post_init__(self) -> None:
        self.size = torch.tensor([0.5, 0.8, 0.8, 1.0], dtype=torch.float64)
        self.of_vehicles = Effects(len(self.vehicle_weight))
        self.of_replans = Effects(int(self.replan.amax()) + 1)

    def propose(self, normals: Tensor) -> Proposal:
        """Returns moves of normals [M, V, D]."""
        count, vehicles, _ = normals.shape
        kind = torch.randint(KINDS, (count,), generator=self.generator)
        weight = self.vehicle_weight * self.of_vehicles.share
        vehicle = self._drawn(weight, count).masked_fill(kind % 2 == 0, -1)
        begin = self._drawn(self.of_replans.share, count) * (kind >= 2)
        chosen = (vehicle[:, None] == torch.arange(vehicles)) | (kind % 2 == 0)[:, None]
        block = chosen[..., None] & (self.replan >= begin[:, None])[:, None]
        size = self.size[kind].to(normals.dtype)[:, None, None] * block
        fresh = torch.randn(normals.shape, generator=self.generator)
        moved = (1 - size**2).sqrt() * normals + size * fresh
        return Proposal(moved, kind, vehicle=vehicle, begin=begin)

    def learn(self, proposal: Proposal, accepted: Tensor, changed: Tensor) -> None:
        """Adapt the step sizes to which moves were accepted of those with an effect, and
        the blocks to which had one.

        Args:
            proposal: M moves.
            accepted: [M] bool.
            changed: [M] bool, the level is another than before.
        """
        for number in proposal.kind[changed].unique().tolist():
            fraction = accepted[changed & (proposal.kind == number)].double().mean()
            factor = torch.exp(RATE * (fraction - ACCEPTED))
            self.size[number] = (self.size[number] * factor).clamp(LEAST, 1.0)
        alone = proposal.vehicle >= 0
        later = proposal.kind >= 2
        self.of_vehicles.count(proposal.vehicle[alone], changed[alone])
        self.of_replans.count(proposal.begin[later], changed[later])

    def _drawn(self, weight: Tensor, count: int) -> Tensor:
        return torch.multinomial(
            weight, count, replacement=True, generator=self.generator
        )
