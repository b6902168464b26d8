"""Plain Monte Carlo: independent rollouts of the prior. What other samplers are compared
with."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from e2rl.tail.level import CONTACT
from e2rl.tail.sampler import REACHED, SPENT, Driven, Sampler

NO_HIT = 0.05  # chance of no hit in all rollouts at the bound


@dataclass(eq=False)
class Plain(Sampler):
    """Independent rollouts of one scene, `particles` at a time."""

    repeated = False  # its counts tell their own interval

    def __post_init__(self) -> None:
        self.tally.hits = 0
        self._contacts = 0
        self._counted = 0
        self._failures: list[Any] = []

    def ask(self) -> Tensor:
        """Returns the normals [M, V, D] of the next rollouts."""
        left = self.settings.rollouts - self.tally.rollouts
        return self.fresh(min(self.settings.particles, left))

    def tell(self, driven: Driven) -> None:
        """Take what became of them."""
        tally = self.tally
        tally.rollouts += len(driven.level)
        hits = (driven.level >= self.target).nonzero()[:, 0].tolist()
        self._failures += [driven.result[row] for row in hits]
        self._contacts += int((driven.level >= CONTACT).sum())
        self._counted += int(driven.counted.sum())
        tally.hits = len(self._failures)
        if tally.rollouts >= self.settings.rollouts:
            tally.probability = tally.hits / tally.rollouts
            tally.contact = self._contacts / tally.rollouts
            tally.counted = self._counted / tally.rollouts
            tally.bound = 1 - NO_HIT ** (1 / tally.rollouts)
            tally.end = REACHED if tally.hits else SPENT

    def failures(self) -> list[Any]:
        """Returns the results of the rollouts that reached the target."""
        return self._failures
