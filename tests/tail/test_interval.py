"""Intervals, where their coverage is known."""

import math

import pytest
import torch

from e2rl.tail.interval import (
    Side,
    of_counts,
    of_logs,
    of_ratio,
    ratio_of_ratios,
)

COVERED = 0.93  # of 400 experiments, at least, for an interval of 95%


def test_intervals_of_log_normal_estimates_cover_their_mean():
    generator = torch.Generator().manual_seed(0)
    spread = 0.8
    logs = torch.randn(400, 6, generator=generator) * spread - spread**2 / 2
    bounds = [of_logs(row + math.log(1e-4)) for row in logs]
    covered = [bound.low < 1e-4 < bound.high for bound in bounds]
    assert sum(covered) / len(covered) > COVERED


def test_no_probability_is_above_one():
    assert of_logs(torch.tensor([-0.01, -1.0])).high == 1


def test_no_hit_in_n_rollouts_bounds_by_clopper_and_pearson():
    bounds = of_counts(0, 100)
    assert bounds.value == 0
    assert bounds.low == 0
    assert bounds.high == pytest.approx(1 - 0.025 ** (1 / 100))


def side_of(estimates, exposure, place=None, unresolved=0.0):
    """A Side of scenes, each at a place of its own by default."""
    place = torch.arange(len(estimates)) if place is None else torch.tensor(place)
    return Side(estimates, exposure, place, unresolved)


def test_a_ratio_is_the_sum_of_probabilities_over_the_sum_of_exposure():
    estimates = 5 * [torch.tensor([0.1, 0.3]), torch.tensor([0.0])]
    bounds = of_ratio(side_of(estimates, torch.tensor(5 * [2.0, 3.0])))
    assert bounds.value == pytest.approx(0.2 / 5)
    assert bounds.low < bounds.value < bounds.high


def test_fewer_than_ten_places_have_no_interval():
    estimates = 20 * [torch.tensor([0.1])]
    side = side_of(estimates, torch.ones(20), place=[k % 9 for k in range(20)])
    for bounds in (of_ratio(side), ratio_of_ratios(side, side)):
        assert math.isfinite(bounds.value)
        assert math.isnan(bounds.low)
        assert math.isnan(bounds.high)


def test_scenes_of_one_place_are_drawn_together():
    """As if each place were one scene, which fails as often as its scenes do in all."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(12, generator=generator)
    exposure = torch.ones(24)
    twice = [value.reshape(1) for value in values.repeat(2)]
    pairs = side_of(twice, exposure, place=[*range(12), *range(12)])
    once = side_of([value.reshape(1) for value in values], torch.ones(12))
    assert of_ratio(pairs) == pytest.approx(of_ratio(once))


def test_ratios_over_scenes_cover_the_population_s():
    generator = torch.Generator().manual_seed(0)
    covered = 0
    for _ in range(100):
        scene = torch.rand(30, generator=generator)  # mean 0.5
        noise = torch.rand(30, 4, generator=generator) - 0.5
        estimates = list(scene[:, None] + noise * scene[:, None])
        bounds = of_ratio(side_of(estimates, torch.full((30,), 2.0)))
        covered += bounds.low < 0.25 < bounds.high
    assert covered / 100 > 0.88


def test_the_quotient_of_equal_egos_is_one_without_an_interval():
    estimates = 4 * [torch.tensor([0.1]), torch.tensor([0.2]), torch.tensor([0.0])]
    side = side_of(estimates, torch.tensor(4 * [1.0, 2.0, 1.0]))
    bounds = ratio_of_ratios(side, side)
    assert bounds == (1, 1, 1)


def test_scenes_are_paired():
    generator = torch.Generator().manual_seed(0)
    first = [torch.rand(1, generator=generator) for _ in range(30)]
    second = [2 * value for value in first]
    exposure = torch.ones(30)
    bounds = ratio_of_ratios(side_of(second, exposure), side_of(first, exposure))
    assert bounds.low == pytest.approx(2)
    assert bounds.high == pytest.approx(2)


def test_one_without_a_failure_bounds_the_quotient_on_one_side():
    """Scenes fail with 0.1, and in none of as many others with up to 0.5 in all: at
    least 2 times, and nobody knows how much more; the other way round at most half."""
    exposure = torch.ones(10)
    failing = side_of([torch.tensor([0.1])] * 10, exposure)
    none = side_of([torch.tensor([0.0])] * 10, exposure, unresolved=0.5)
    assert ratio_of_ratios(failing, none) == (math.inf, pytest.approx(2), math.inf)
    assert ratio_of_ratios(none, failing) == (0, 0, pytest.approx(0.5))
