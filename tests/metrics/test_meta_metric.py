"""The meta-metric's likelihoods: closed forms of smoothed histograms, and what they do not depend on."""

import pytest
import torch

from e2rl.metrics.meta_metric import (
    FEATURES,
    HISTOGRAMS,
    INDICATIONS,
    SMOOTHING,
    Feature,
    bin_counts,
    bin_index,
    likelihood,
    log_bernoulli,
    log_probability,
    meta_metric,
)

ONE = torch.zeros(1, dtype=torch.int64)  # every track in scene 0


def everywhere(index):
    return torch.ones_like(index, dtype=torch.bool)


def likelihood_of(counts, index):
    return likelihood(log_probability(counts, index), everywhere(index), ONE.expand(len(index)), 1).item()


def test_weights_sum_to_one_so_that_a_certain_log_has_one():
    assert sum(feature.weight for feature in FEATURES.values()) == pytest.approx(1)
    assert meta_metric(dict.fromkeys(FEATURES, torch.ones(3))).tolist() == pytest.approx([1] * 3)
    for name, feature in FEATURES.items():
        alone = {other: torch.tensor(float(other == name)) for other in FEATURES}
        assert meta_metric(alone).item() == pytest.approx(feature.weight)
    assert set(HISTOGRAMS) | set(INDICATIONS) == set(FEATURES) and not set(HISTOGRAMS) & set(INDICATIONS)


def test_bins_are_equal_parts_of_the_range_and_the_outer_ones_take_the_rest():
    feature = Feature(1.0, -2.0, 6.0, 4)
    values = torch.tensor([-100.0, -2.0, -0.01, 0.0, 1.9, 2.0, 5.9, 6.0, 1e6])
    assert bin_index(values, feature).tolist() == [0, 0, 0, 1, 1, 2, 3, 3, 3]


def test_counts_are_of_known_values_only_and_add_up_over_parts():
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(5, (3, 40), generator=generator)
    known = torch.rand(3, 40, generator=generator) < 0.7
    counts = bin_counts(index, known, 5)
    assert torch.equal(counts.sum(1), known.sum(1).double())
    for row in range(3):
        assert torch.equal(counts[row], torch.bincount(index[row][known[row]], minlength=5).double())
    halves = bin_counts(index[:, :13], known[:, :13], 5) + bin_counts(index[:, 13:], known[:, 13:], 5)
    assert torch.equal(counts, halves)


@pytest.mark.parametrize("bins", [2, 5, 11])
def test_a_uniform_histogram_gives_one_over_bins_however_many_values_it_holds(bins):
    index = torch.arange(bins)[None]
    for count in (0, 3, 1000):
        counts = torch.full((1, bins), float(count), dtype=torch.float64)
        assert likelihood_of(counts, index) == pytest.approx(1 / bins)


@pytest.mark.parametrize("number", [1, 10, 1000])
def test_a_log_in_the_only_bin_is_as_likely_as_the_smoothing_lets_it_be(number):
    for bins in (5, 10):
        counts = torch.zeros(1, bins, dtype=torch.float64)
        counts[0, 2] = number
        expected = (number + SMOOTHING) / (number + SMOOTHING * bins)
        assert likelihood_of(counts, torch.tensor([[2, 2, 2]])) == pytest.approx(expected)
        assert likelihood_of(counts, torch.tensor([[1]])) == pytest.approx(SMOOTHING / (number + SMOOTHING * bins))
    assert number < 1000 or expected > 0.999


def test_probabilities_of_all_bins_sum_to_one():
    counts = torch.rand(4, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 30
    every = torch.arange(7).expand(4, -1)
    assert log_probability(counts, every).exp().sum(1).tolist() == pytest.approx([1] * 4)


def test_an_indication_has_the_share_of_rollouts_smoothed():
    hits, happened = torch.tensor([0.0, 8.0, 2.0, 2.0]), torch.tensor([False, True, True, False])
    p = log_bernoulli(hits, 8, happened).exp()
    sure = (8 + SMOOTHING) / (8 + 2 * SMOOTHING)
    assert p.tolist() == pytest.approx([sure, sure, 2.1 / 8.2, 6.1 / 8.2])
    assert torch.allclose(log_bernoulli(hits, 8, ~happened).exp() + p, torch.ones(4))


def test_a_scene_s_likelihood_is_the_geometric_mean_over_its_known_values():
    p = torch.tensor([[0.5, 0.25], [0.125, 0.9], [0.3, 0.3]], dtype=torch.float64)
    known = torch.tensor([[True, True], [True, False], [True, True]])
    scene = torch.tensor([2, 2, 0])
    found = likelihood(p.log(), known, scene, 3)
    assert found[0].item() == pytest.approx(0.3) and found[1].isnan()
    assert found[2].item() == pytest.approx((0.5 * 0.25 * 0.125) ** (1 / 3))
    order = torch.tensor([1, 2, 0])
    assert torch.allclose(likelihood(p.log()[order], known[order], scene[order], 3), found, equal_nan=True)
