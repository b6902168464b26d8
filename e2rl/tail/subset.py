"""Subset simulation (Au and Beck 2001): the probability of a rare failure as a product
of probabilities that are not rare.

Particles are rollouts' noise. In each stage those below a level, of which there are a
fixed fraction, are replaced by copies of others, and all copies are moved above that
level. With levels that no two particles share the estimate is unbiased (Brehier et al.
2015); particles at the level itself are counted as below it; where all are, all are moved
again, and the population is extinct where that does not help.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from e2rl.tail.level import CONTACT
from e2rl.tail.moves import Proposal
from e2rl.tail.sampler import (
    EXTINCT,
    LEAST,
    REACHED,
    SPENT,
    Driven,
    Sampler,
)

RETRIES = 5  # moves of all particles at one level, with ever smaller steps


@dataclass(eq=False)
class Subset(Sampler):
    """A population of particles of one scene."""

    def __post_init__(self) -> None:
        self.normals = torch.empty(0, *self.shape)  # [N, V, D]
        self.particles = Driven(torch.empty(0), torch.empty(0), [])
        self._moving = torch.empty(0, dtype=torch.int64)  # particles
        self._left = 0  # moves of this stage
        self._spread = 1.0  # of the survivors' levels above the stage's
        self._retries = RETRIES
        self._asked: Proposal | None = None  # moves; None: the first rollouts

    def ask(self) -> Tensor:
        """Returns the normals [M, V, D] of the next rollouts, none once it has ended."""
        if self.ended:
            return self.normals[:0]
        if not len(self.normals):
            self.normals = self.fresh(self.settings.first)
            return self.normals
        self._asked = self.moves.propose(self.normals[self._moving])
        return self._asked.normals

    def tell(self, driven: Driven) -> None:
        """Take what became of the rollouts that were asked for last."""
        self.tally.rollouts += len(driven.level)
        if self._asked is None:
            self.particles = driven
        else:
            self._accept(self._asked, driven)
        if self._left == 0:
            self._select()

    def failures(self) -> list[Any]:
        """Returns the results of the particles that reached the target, one for each
        rollout among them."""
        reached = (self.particles.level >= self.target).nonzero()[:, 0].tolist()
        distinct = {id(self.particles.result[row]): row for row in reached}
        return [self.particles.result[row] for row in distinct.values()]

    def _accept(self, proposal: Proposal, driven: Driven) -> None:
        accepted = driven.level > self.tally.level
        change = (driven.level - self.particles.level[self._moving]).abs()
        self.moves.learn(proposal, accepted, change / (change + self._spread))
        rows = self._moving[accepted]
        self.normals[rows] = proposal.normals[accepted]
        self.particles.level[rows] = driven.level[accepted]
        self.particles.counted[rows] = driven.counted[accepted]
        for row, index in zip(rows, accepted.nonzero()[:, 0], strict=True):
            self.particles.result[row] = driven.result[index]
        self._left -= 1

    def _select(self) -> None:
        """Begin the next stage, or end."""
        tally = self.tally
        level = self.particles.level
        count = len(level)
        if tally.level < CONTACT:
            tally.contact = tally.bound * float((level >= CONTACT).double().mean())
            tally.counted = tally.bound * float(self.particles.counted.double().mean())
        kept = math.floor((1 - self.settings.killed) * self.settings.particles)
        threshold = float(level.sort().values[count - max(kept, 1) - 1])
        fraction = float((level >= self.target).double().mean())
        tally.probability = tally.bound * fraction
        if threshold >= self.target:
            tally.end = REACHED
            return
        survivors = (level > threshold).nonzero()[:, 0]
        if not len(survivors):
            self._retry()
            return
        self._retries = RETRIES
        self._spread = float((level[survivors] - threshold).mean())
        tally.bound *= len(survivors) / count
        tally.level = threshold
        if tally.bound < self.settings.least:
            self._end(LEAST)
            return
        self._moving = torch.arange(len(survivors), self.settings.particles)
        if self._affords(len(self._moving)):
            copies = torch.randint(
                len(survivors), self._moving.shape, generator=self.moves.generator
            )
            self._keep(torch.cat([survivors, survivors[copies]]))

    def _retry(self) -> None:
        """Move all particles, which are at one level, once more; they may be copies
        whose moves were all refused."""
        if not self._retries:
            self.tally.end = EXTINCT
            return
        self._retries -= 1
        self._moving = torch.arange(self.settings.particles)
        self._keep(self._moving)  # of the first rollouts, any of them
        self._affords(len(self._moving))

    def _affords(self, moving: int) -> bool:
        """Begin the moves of so many particles, or end where the budget is spent."""
        self._left = self.settings.moves
        needed = self._left * moving
        if self.tally.rollouts + needed <= self.settings.rollouts:
            return True
        self._end(SPENT)
        return False

    def _end(self, reason: str) -> None:
        """End before most particles reach the target: some may have."""
        self.tally.end = REACHED if self.tally.probability > 0 else reason

    def _keep(self, rows: Tensor) -> None:
        """Go on with particles `rows` [N], of which some may be copies."""
        self.normals = self.normals[rows]
        self.particles = Driven(
            self.particles.level[rows],
            self.particles.counted[rows],
            [self.particles.result[row] for row in rows.tolist()],
        )
