"""Moves in the noise that keep its law: preconditioned Crank-Nicolson (Cotter et al.
2013, eq. 4.8) of blocks of a rollout's standard normals.

x' = (1 - b^2)^(1/2) x + b xi with xi standard normal leaves N(0, 1) as it is, in any
number of dimensions. A block is everything, one vehicle, what comes after some replan,
or one vehicle after some replan. Each kind has a step size b of its own, which follows
how often moves are accepted.

The level depends on few vehicles, and on their noise until some moment. How much a
vehicle, or the noise from a replan on, changes it is learned from the moves. What changes
it more is moved alone more often; in moves of all vehicles what changes it less has larger
steps, up to a draw of its own, so that each move sees others' behaviour anew.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

ACCEPTED = 0.35  # fraction of moves that step sizes aim at
RATE = 1.5  # of the log step size, for each accepted fraction above ACCEPTED
LEAST = 0.02
KINDS = 4  # of blocks: bit 0, one vehicle; bit 1, after some replan
PRIOR = 2.0  # moves of each vehicle and replan that count as made before


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
    """How much moves that name one of N things change the level.

    Args:
        guess: [N] from 0 to 1, before there were any.
    """

    def __init__(self, guess: Tensor) -> None:
        self.total = PRIOR * guess.double()
        self.count = torch.full_like(self.total, PRIOR)

    @property
    def mean(self) -> Tensor:
        """Of each [N], from 0 to 1."""
        return self.total / self.count

    def add(self, index: Tensor, effect: Tensor) -> None:
        """Add moves index [M] int64 with their effects [M]."""
        self.count.index_add_(0, index, torch.ones_like(effect))
        self.total.index_add_(0, index, effect)


@dataclass
class Moves:
    """Proposes moves in one scene, and learns their sizes and blocks there.

    Args:
        vehicle_effect: [V], guess of how much each vehicle changes the level, at most 1;
            0 for who is not moved alone.
        replan: [D] int64, in which each number of a vehicle acts.
        generator: of the moves.
    """

    vehicle_effect: Tensor
    replan: Tensor
    generator: torch.Generator

    def __post_init__(self) -> None:
        self.size = torch.tensor([0.5, 0.8, 0.8, 1.0], dtype=torch.float64)
        self.of_vehicles = Effects(self.vehicle_effect)
        self.of_replans = Effects(torch.ones(int(self.replan.amax()) + 1))

    def propose(self, normals: Tensor) -> Proposal:
        """Returns moves of normals [M, V, D]."""
        count, vehicles, _ = normals.shape
        kind = torch.randint(KINDS, (count,), generator=self.generator)
        vehicle = self._drawn(self.of_vehicles.mean, count).masked_fill(
            kind % 2 == 0, -1
        )
        begin = self._drawn(self.of_replans.mean, count) * (kind >= 2)
        alone = vehicle[:, None] == torch.arange(vehicles)
        everyone = (kind % 2 == 0)[:, None] * self._power()
        power = torch.where(alone, 1.0, everyone)  # 0: not moved
        moved = (power > 0)[..., None] & (self.replan >= begin[:, None])[:, None]
        size = (self.size[kind][:, None] ** power).to(normals.dtype)[..., None] * moved
        fresh = torch.randn(normals.shape, generator=self.generator)
        result = (1 - size**2).sqrt() * normals + size * fresh
        return Proposal(result, kind, vehicle=vehicle, begin=begin)

    def learn(self, proposal: Proposal, accepted: Tensor, effect: Tensor) -> None:
        """Adapt the step sizes to which moves were accepted, by their effects, and the
        blocks to these.

        Args:
            proposal: M moves.
            accepted: [M] bool.
            effect: [M] from 0 to 1, how much the level changed.
        """
        for number in proposal.kind.unique().tolist():
            weight = effect * (proposal.kind == number)
            weight = weight / weight.sum().clamp(min=1)
            change = (weight * (accepted.double() - ACCEPTED)).sum()
            self.size[number] = (self.size[number] * (RATE * change).exp()).clamp(
                LEAST, 1
            )
        alone = proposal.vehicle >= 0
        later = proposal.kind >= 2
        self.of_vehicles.add(proposal.vehicle[alone], effect[alone])
        self.of_replans.add(proposal.begin[later], effect[later])

    def _power(self) -> Tensor:
        """Of the step size of each vehicle [V] in moves of all: 1 for those that change
        the level most, or whose effect is not learned, near 0 for those that do not."""
        mean = self.of_vehicles.mean
        power = mean / mean.amax()
        return power.masked_fill(self.vehicle_effect == 0, 1.0)

    def _drawn(self, weight: Tensor, count: int) -> Tensor:
        return torch.multinomial(
            weight, count, replacement=True, generator=self.generator
        )
