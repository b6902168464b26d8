"""The number of scenes of a comparison."""

import math

import pytest
import torch
from scipy.stats import binomtest

from e2rl.evaluation.power import ratio_seen, scenes_needed
from e2rl.run.errors import InputError


def drawn(rate, ratio, correlation, scenes, repetitions, seed=0):
    """Failures of two egos [repetitions, scenes] bool with these rates and correlation."""
    second = rate * ratio
    spread = math.sqrt(rate * (1 - rate) * second * (1 - second))
    both = rate * second + correlation * spread
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(repetitions, scenes, generator=generator)
    return draw < rate, (draw < both) | (draw >= rate) & (draw < rate + second - both)


@pytest.mark.parametrize("correlation", [0.0, 0.4])
@pytest.mark.parametrize(("rate", "ratio"), [(0.3, 0.5), (0.6, 0.75)])
def test_mcnemars_test_sees_it_with_the_chance_asked_for(rate, ratio, correlation):
    """300 repetitions: the share is 0.8 within three standard errors and what the exact
    test loses."""
    scenes = scenes_needed(rate, ratio, correlation=correlation, power=0.8)
    first, second = drawn(rate, ratio, correlation, scenes, 300)
    seen = 0
    for before, after in zip(first, second, strict=True):
        alone = int((before & ~after).sum())
        differ = int((before != after).sum())
        seen += binomtest(alone, differ).pvalue < 0.05
    assert 0.7 < seen / 300 < 0.87


def test_correlated_failures_take_fewer_scenes():
    needed = [
        scenes_needed(0.2, 0.5, correlation=correlation, power=0.8)
        for correlation in (0.0, 0.3, 0.6)
    ]
    assert needed == sorted(needed, reverse=True)


def test_the_ratio_seen_is_the_inverse_of_the_scenes_needed():
    scenes = scenes_needed(0.1, 0.5, correlation=0.0, power=0.8)
    assert ratio_seen(0.1, scenes, correlation=0.0, power=0.8) == pytest.approx(
        0.5, abs=0.01
    )


def test_few_scenes_do_not_even_show_that_failures_vanish():
    assert math.isnan(ratio_seen(0.01, 20, correlation=0.0, power=0.8))


@pytest.mark.parametrize(
    ("rate", "ratio", "correlation", "message"),
    [
        (0.0, 0.5, 0.0, "expected a rate"),
        (0.1, 1.0, 0.0, "a ratio other than 1"),
        (0.6, 2.0, 0.0, "leaves a rate below 1"),
        (0.1, 0.5, 0.9, "at most 0.69"),
    ],
)
def test_what_is_no_comparison_is_refused(rate, ratio, correlation, message):
    with pytest.raises(InputError, match=message):
        scenes_needed(rate, ratio, correlation=correlation, power=0.8)
