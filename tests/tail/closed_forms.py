"""Failures of standard normals whose probabilities are known."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from e2rl.tail.moves import Moves
from e2rl.tail.sampler import Driven, SamplerSettings, Tally
from e2rl.tail.subset import Subset

VEHICLES = 4
REPLANS = 16


def quantile(probability: float) -> float:
    """b with P(N(0, 1) > b) = probability."""
    tail = torch.tensor(1 - 2 * probability, dtype=torch.float64)
    return math.sqrt(2) * float(torch.erfinv(tail))


def direction(x: Tensor, part: slice = slice(None)) -> Tensor:
    """N(0, 1) [M]: the mean direction of some vehicles of x [M, V, D], scaled."""
    chosen = x[:, part].flatten(1)
    return (chosen.sum(1) / math.sqrt(chosen.shape[1])).double()


def linear(x: Tensor) -> Tensor:
    """P(level > b) = P(N(0, 1) > b)."""
    return direction(x)


def union(x: Tensor) -> Tensor:
    """Of two independent halves, P(level > b) = 1 - (1 - P(N(0, 1) > b))^2."""
    return torch.maximum(direction(x, slice(0, 2)), direction(x, slice(2, 4)))


def corner(x: Tensor) -> Tensor:
    """Of two independent directions across all numbers, P(level > b) = P(N(0, 1) >
    b)^2."""
    first = direction(x, slice(0, 2))
    second = direction(x, slice(2, 4))
    return torch.minimum(first + second, first - second) / math.sqrt(2)


def tally(
    level: Callable[[Tensor], Tensor],
    threshold: float,
    *,
    numbers: int,
    seed: int,
    settings: SamplerSettings,
) -> Tally:
    """The tally of a population of x [VEHICLES, numbers / VEHICLES]."""
    each = numbers // VEHICLES
    generator = torch.Generator().manual_seed(seed)
    replan = torch.arange(each) * REPLANS // each
    subset = Subset(
        target=threshold,
        settings=settings,
        moves=Moves(torch.ones(VEHICLES), replan, generator),
        shape=(VEHICLES, each),
    )
    while not subset.ended:
        reached = level(subset.ask())
        subset.tell(Driven(reached, reached >= threshold, [None] * len(reached)))
    return subset.tally
