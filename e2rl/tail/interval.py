"""Intervals of a probability from independent estimates of it, and of a rate over
places."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.statistics import LEAST, bootstrap_draws

LEVEL = 0.95
DRAWS = 2000  # of the bootstrap
LEAST_VARIANCE = 1e-4  # of log(probability): estimates may happen to be equal


class Bounds(NamedTuple):
    """An estimate with its interval of 95%."""

    value: float
    low: float
    high: float


def of_logs(logs: Tensor) -> Bounds:
    """Returns the probability of which exp(logs [R]), R >= 2, are unbiased estimates:
    their mean, with the interval of log-normal ones (Cox's method: Zhou and Gao 1997).

    It is around mean + s^2 / 2 of the logarithms, whose variance s^2 / R + s^4 / (2 (R
    - 1)) is that of a t law. It has R - 2 degrees of freedom, as populations' estimates
    have longer tails (tools/tail_coverage.py).
    """
    from scipy import stats  # takes half a second to load

    count = len(logs)
    variance = float(logs.var().clamp(min=LEAST_VARIANCE))
    centre = float(logs.mean()) + variance / 2
    spread = math.sqrt(variance / count + variance**2 / (2 * (count - 1)))
    freedom = max(count - 2, 1)
    half = spread * float(stats.t.ppf((1 + LEVEL) / 2, freedom))
    value = float(logs.exp().mean())
    low = min(math.exp(centre - half), value)
    return Bounds(value, low, high=min(max(math.exp(centre + half), value), 1.0))


def of_counts(hits: int, count: int) -> Bounds:
    """Returns the fraction of hits in independent rollouts (Clopper and Pearson 1934)."""
    from scipy import stats  # takes half a second to load

    interval = stats.binomtest(hits, count).proportion_ci(LEVEL, "exact")
    return Bounds(hits / count, float(interval.low), float(interval.high))


class Side(NamedTuple):
    """What is known of S scenes: estimates of each, of R repetitions, [R]; exposure
    [S], such as km driven; place [S], where each is, 0 .. P - 1; unresolved: the sum
    over scenes of what their probabilities may be beyond these, where nothing was
    drawn."""

    estimates: Sequence[Tensor]
    exposure: Tensor
    place: Tensor
    unresolved: float = 0.0


def of_ratio(side: Side) -> Bounds:
    """Returns sum over scenes of probability / sum of exposure, with an interval over
    places and repetitions: a bootstrap that draws places, and in each of their scenes
    its repetitions, with replacement.

    Fewer than LEAST places give none. It knows nothing of places that fail often and
    were not driven.
    """
    value, draws = drawn_ratios(side)
    return bounded(value, draws)


def ratio_of_ratios(first: Side, second: Side) -> Bounds:
    """Returns the quotient of two `of_ratio` in the same scenes, which are drawn
    together. Its lower end holds what the second may have unresolved, its upper end what
    the first may."""
    value, draws = drawn_ratios(first)
    other, other_draws = drawn_ratios(second)
    more = first.unresolved / first.exposure.sum()
    other_more = second.unresolved / second.exposure.sum()
    ratio = value / other
    low = bounded(ratio, draws / (other_draws + other_more)).low
    high = bounded(ratio, (draws + more) / other_draws).high
    return Bounds(float(ratio), low, high)


def bounded(value: Tensor, draws: Tensor) -> Bounds:
    """Returns a value with the interval of its draws [DRAWS], of those that are known."""
    known = draws[~draws.isnan()]
    if not len(known):
        return Bounds(float(value), math.nan, math.nan)
    tails = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
    low, high = (float(known.quantile(tail, interpolation="nearest")) for tail in tails)
    return Bounds(float(value), low, high)


def drawn_ratios(side: Side) -> tuple[Tensor, Tensor]:
    """Returns `of_ratio`'s value, and DRAWS of it, none from fewer than LEAST places;
    the places drawn depend on their number alone."""
    estimates, exposure, place, _ = side
    value = torch.stack([values.mean() for values in estimates]).sum() / exposure.sum()
    places = int(place.amax()) + 1
    if places < LEAST:
        return value, torch.empty(0, dtype=torch.float64)
    times = bootstrap_draws(places, DRAWS)[1:, place]
    generator = torch.Generator().manual_seed(0)
    draw = torch.arange(DRAWS)
    total = torch.zeros(DRAWS, dtype=torch.float64)
    for scene, values in enumerate(estimates):
        drawn = draw.repeat_interleave(times[:, scene].long())
        again = torch.randint(
            len(values), (len(drawn), len(values)), generator=generator
        )
        total.index_add_(0, drawn, values.double()[again].mean(1))
    return value, total / (times @ exposure.double())
