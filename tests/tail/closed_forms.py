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


REVERSION = 1.0  # 1/s, of the Ornstein-Uhlenbeck process
SPAN = 4.0  # s, of both processes
NOISE = 0.45  # of the double well
WELL_STEPS = 50


def by_time(x: Tensor) -> Tensor:
    """N(0, 1) [M, D]: numbers [M, V, D] of the first vehicle, which act one after the
    other."""
    return x[:, 0].double()


def ornstein_uhlenbeck(x: Tensor) -> Tensor:
    """The end of dX = -X dt + dW, in units of its standard deviation: P(level > b) =
    P(N(0, 1) > b), of which the last second has most."""
    noise = by_time(x)
    count = noise.shape[1]
    left = torch.arange(count - 1, -1, -1, dtype=torch.float64) * SPAN / count
    weight = torch.exp(-REVERSION * left)
    return noise @ (weight / weight.norm())


def double_well(x: Tensor) -> Tensor:
    """The largest value of dX = (X - X^3) dt + NOISE dW in WELL_STEPS steps from the
    lower well, X = -1."""
    noise = by_time(x).unflatten(1, (WELL_STEPS, -1)).sum(2)
    noise = noise / math.sqrt(x.shape[2] / WELL_STEPS)
    step = SPAN / WELL_STEPS
    place = torch.full_like(noise[:, 0], -1.0)
    highest = place
    for moment in range(WELL_STEPS):
        drift = place - place**3
        place = place + step * drift + NOISE * math.sqrt(step) * noise[:, moment]
        highest = torch.maximum(highest, place)
    return highest


def double_well_probability(barrier: float, points: int = 2001) -> float:
    """P(double_well > barrier) by quadrature: what is below the barrier after each
    step, on a grid."""
    grid = torch.linspace(-3.5, barrier, points, dtype=torch.float64)
    step = SPAN / WELL_STEPS
    mean = grid + step * (grid - grid**3)
    deviation = NOISE * math.sqrt(step)
    density = torch.exp(-(((grid - mean[:, None]) / deviation) ** 2) / 2)
    kernel = density / (deviation * math.sqrt(2 * math.pi))
    weight = torch.full_like(grid, float(grid[1] - grid[0]))
    weight[[0, -1]] /= 2
    start = torch.tensor(-1.0, dtype=torch.float64)
    first = start + step * (start - start**3)
    below = torch.exp(-(((grid - first) / deviation) ** 2) / 2)
    below = below / (deviation * math.sqrt(2 * math.pi))
    for _ in range(WELL_STEPS - 1):
        below = (below * weight) @ kernel
    return 1 - float((below * weight).sum())


def barrier(probability: float) -> float:
    """b with P(double_well > b) = probability."""
    low = -0.5
    high = 3.0
    for _ in range(30):
        middle = (low + high) / 2
        if double_well_probability(middle, points=801) > probability:
            low = middle
        else:
            high = middle
    return (low + high) / 2


FORMS: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[float], float]]] = {
    "linear": (linear, quantile),
    "union of two": (union, lambda p: quantile(1 - math.sqrt(1 - p))),
    "rotated corner": (corner, lambda p: quantile(math.sqrt(p))),
    "Ornstein-Uhlenbeck": (ornstein_uhlenbeck, quantile),
    "double well": (double_well, barrier),
}  # a level, and the threshold of a probability


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
