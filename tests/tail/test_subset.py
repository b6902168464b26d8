"""Subset simulation, on failures of known probability."""

import math
from dataclasses import replace

import pytest
import torch

from e2rl.tail.moves import Moves
from e2rl.tail.sampler import EXTINCT, LEAST, REACHED, SPENT, Driven, SamplerSettings
from e2rl.tail.subset import Subset
from tests.tail.closed_forms import FORMS, linear, quantile, tally

SETTINGS = SamplerSettings(
    first=64, particles=64, killed=0.5, moves=4, rollouts=100_000, least=1e-12
)
P = 1e-3


@pytest.mark.parametrize("form", ["linear", "union of two", "rotated corner"])
def test_estimates_are_unbiased(form):
    level, threshold = FORMS[form]
    tallies = [
        tally(level, threshold(P), numbers=400, seed=seed, settings=SETTINGS)
        for seed in range(16)
    ]
    estimates = torch.tensor([each.probability for each in tallies]) / P
    error = float(estimates.std()) / math.sqrt(len(estimates))
    assert error < 0.4
    assert abs(float(estimates.mean()) - 1) < 3 * error


def test_a_likely_failure_is_counted_in_the_first_stage():
    result = tally(linear, quantile(0.8), numbers=40, seed=0, settings=SETTINGS)
    assert result.end == REACHED
    assert result.rollouts == SETTINGS.particles
    assert (result.probability * SETTINGS.particles) % 1 == 0


def test_equal_levels_are_an_extinction_and_no_estimate():
    result = tally(
        lambda x: torch.zeros(len(x), dtype=torch.float64),
        1.0,
        numbers=40,
        seed=0,
        settings=SETTINGS,
    )
    assert result.end == EXTINCT
    assert result.probability == 0
    assert result.bound == 1


def test_one_particle_survives_a_stage_that_kills_most():
    settings = replace(SETTINGS, first=8, particles=8, killed=0.95)
    result = tally(linear, quantile(0.01), numbers=40, seed=0, settings=settings)
    assert result.end == REACHED


def test_it_spends_no_more_rollouts_than_asked_for():
    settings = SamplerSettings(
        first=64, particles=64, killed=0.5, moves=2, rollouts=300, least=1e-12
    )
    result = tally(linear, 8.0, numbers=40, seed=0, settings=settings)
    assert result.end == SPENT
    assert result.rollouts <= 300


def test_failures_among_the_first_rollouts_are_an_estimate_where_the_budget_ends():
    settings = replace(SETTINGS, first=512, rollouts=512)
    threshold = quantile(0.01)
    result = tally(linear, threshold, numbers=40, seed=0, settings=settings)
    assert result.end == REACHED
    assert result.rollouts == 512
    assert 0 < result.probability < 0.03
    assert (result.probability * 512) % 1 == 0


def test_it_stops_below_the_least_probability():
    settings = SamplerSettings(
        first=64, particles=64, killed=0.5, moves=1, rollouts=100_000, least=0.1
    )
    result = tally(linear, 8.0, numbers=40, seed=0, settings=settings)
    assert result.end == LEAST
    assert 0.05 < result.bound < 0.1


def test_failures_are_distinct_rollouts_that_reached_the_target():
    generator = torch.Generator().manual_seed(0)
    moves = Moves(torch.ones(4), torch.zeros(10, dtype=torch.int64), generator)
    subset = Subset(
        target=quantile(0.01), settings=SETTINGS, moves=moves, shape=(4, 10)
    )
    while not subset.ended:
        level = linear(subset.ask())
        subset.tell(Driven(level, level > 0, [[value] for value in level.tolist()]))
    failures = [value for (value,) in subset.failures()]
    assert min(failures) >= quantile(0.01)
    assert len(set(failures)) == len(failures)
    reached = (subset.particles.level >= quantile(0.01)).sum()
    assert 1 < len(failures) <= reached


def test_copies_whose_moves_were_refused_are_moved_again():
    """A population of a single rollout and its copies goes on from it."""
    generator = torch.Generator().manual_seed(0)
    moves = Moves(torch.ones(4), torch.zeros(10, dtype=torch.int64), generator)
    subset = Subset(target=3.0, settings=SETTINGS, moves=moves, shape=(4, 10))
    subset.ask()
    count = SETTINGS.particles
    equal = torch.zeros(count, dtype=torch.float64)
    subset.tell(Driven(equal, equal > 0, [None] * count))
    assert not subset.ended
    nearer = torch.arange(count, dtype=torch.float64) / count
    for _ in range(SETTINGS.moves):
        assert len(subset.ask()) == count
        subset.tell(Driven(nearer, nearer > 1, [None] * count))
    assert not subset.ended
    assert subset.tally.bound == 0.5


def population_of_512():
    """A population of 64 particles that begins with 512 rollouts."""
    generator = torch.Generator().manual_seed(0)
    return Subset(
        target=quantile(P),
        settings=replace(SETTINGS, first=512),
        moves=Moves(torch.ones(4), torch.zeros(10, dtype=torch.int64), generator),
        shape=(4, 10),
    )


def test_many_first_rollouts_are_one_stage_of_a_smaller_fraction():
    """The best of 512 go on: 32 of them in the second stage, without a loss."""
    subset = population_of_512()
    level = linear(subset.ask())
    subset.tell(Driven(level, level > 9, list(range(512))))
    assert subset.tally.bound == 32 / 512
    best = set(level.argsort()[-32:].tolist())
    assert set(subset.particles.result[:32]) == best
    assert set(subset.particles.result[32:]) <= best
    assert len(subset.ask()) == 32


def test_a_second_stage_of_equal_first_rollouts_is_of_as_many_as_asked_for():
    subset = population_of_512()
    level = torch.zeros(len(subset.ask()), dtype=torch.float64)
    subset.tell(Driven(level, level > 9, list(range(512))))
    assert subset.tally.bound == 1
    assert len(subset.ask()) == 64
