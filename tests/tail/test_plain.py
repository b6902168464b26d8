"""Plain Monte Carlo, on a failure of known probability."""

import pytest
import torch

from e2rl.tail.interval import of_counts
from e2rl.tail.moves import Moves
from e2rl.tail.plain import Plain
from e2rl.tail.sampler import REACHED, SPENT, Driven, SamplerSettings
from tests.tail.closed_forms import linear, quantile

P = 0.1
SETTINGS = SamplerSettings(
    first=64, particles=64, killed=0.5, moves=1, rollouts=1000, least=0
)


def drawn(target):
    generator = torch.Generator().manual_seed(0)
    moves = Moves(torch.ones(4), torch.zeros(10, dtype=torch.int64), generator)
    plain = Plain(target=target, settings=SETTINGS, moves=moves, shape=(4, 10))
    while not plain.ended:
        level = linear(plain.ask())
        plain.tell(Driven(level, level > target, level.tolist()))
    return plain


@pytest.fixture(scope="module")
def plain():
    return drawn(quantile(P))


def test_the_estimate_is_the_fraction_of_hits(plain):
    assert plain.tally.end == REACHED
    assert plain.tally.rollouts == SETTINGS.rollouts
    assert plain.tally.probability == len(plain.failures()) / SETTINGS.rollouts
    assert plain.tally.counted == plain.tally.probability


def test_the_interval_of_its_hits_holds_the_probability(plain):
    bounds = of_counts(plain.tally.hits, plain.tally.rollouts)
    assert bounds.low < P < bounds.high


def test_failures_are_the_rollouts_at_the_target(plain):
    assert min(plain.failures()) >= quantile(P)


def test_without_a_hit_the_bound_is_where_that_has_a_chance_of_5_percent():
    tally = drawn(9.0).tally
    assert tally.end == SPENT
    assert tally.probability == 0
    assert (1 - tally.bound) ** tally.rollouts == pytest.approx(0.05)
