"""What draws rollouts of one scene to estimate how likely a failure is: `ask` for noise to
drive, `tell` what became of it, until it has ended; `tally` is the estimate."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.tail.moves import Moves

# why a population ended
REACHED = "reached"  # failures were drawn
EXTINCT = "extinct"  # all particles stay at one level
LEAST = "least"  # the target is less likely than `least`
SPENT = "spent"  # the budget of rollouts
ALONE = "alone"  # no vehicle is driven by the prior, so nothing is left to chance


@configured("rate", "rate")
@dataclass(frozen=True)
class SamplerSettings:
    """How the rollouts of a population are spent; conf/rate.yaml explains each."""

    first: int = setting(low=4)
    particles: int = setting(low=4)
    killed: float = setting(low=0.05, high=0.95)
    moves: int = setting(low=1)
    rollouts: int = setting(low=4)
    least: float = setting(low=0, high=1)

    def __post_init__(self) -> None:
        if self.first < self.particles:
            raise InputError(
                f"rate.first={self.first}: fewer than rate.particles={self.particles}; "
                "raise the first or lower the other"
            )


@dataclass
class Tally:
    """The estimate of one population.

    Args:
        probability: of the target; 0 until rollouts reached it.
        bound: what the probability may be where `end` is another.
        hits: number of failures among independent rollouts; None where they are not.
        contact: probability of a contact.
        counted: probability of a failure that counts.
        rollouts: that were driven.
        end: why it ended.
        level: that all particles exceed.
    """

    probability: float = 0.0
    bound: float = 1.0
    hits: int | None = None
    contact: float = 0.0
    counted: float = 0.0
    rollouts: int = 0
    end: str = ""
    level: float = -math.inf


class Driven(NamedTuple):
    """What became of M rollouts.

    Args:
        level: [M] float64.
        counted: [M] bool, failures that count.
        result: of each, what is to be kept.
    """

    level: Tensor
    counted: Tensor
    result: list[Any]


@dataclass(eq=False)
class Sampler(ABC):
    """Draws rollouts of one scene.

    Args:
        target: level of the failure.
        settings: how rollouts are spent.
        moves: in this scene; its generator draws everything.
        shape: (V, D) of a rollout's normals.
    """

    target: float
    settings: SamplerSettings
    moves: Moves
    shape: tuple[int, int]
    tally: Tally = field(default_factory=Tally, init=False)

    repeated: ClassVar[bool] = True  # intervals are of several populations

    @property
    def ended(self) -> bool:
        """Whether nothing more is asked for."""
        return bool(self.tally.end)

    @abstractmethod
    def ask(self) -> Tensor:
        """Returns the normals [M, V, D] of the next rollouts."""

    @abstractmethod
    def tell(self, driven: Driven) -> None:
        """Take what became of the rollouts that were asked for last."""

    @abstractmethod
    def failures(self) -> list[Any]:
        """Returns the results of the distinct rollouts that reached the target."""

    def fresh(self, count: int) -> Tensor:
        """Returns normals [count, V, D] of the prior."""
        return torch.randn((count, *self.shape), generator=self.moves.generator)
