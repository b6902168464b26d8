"""The spread of samples: none without noise, and for a linear denoiser what the
sampler's own moments say."""

from dataclasses import replace

import pytest
import torch

from e2rl.prior.sde import SamplerSettings
from e2rl.prior.spread import REGIONS, central, sample_variances
from tests.prior.gaussian import denoiser, moments
from tests.prior.small import curved_scenes, small_prior
from tests.traffic.e2.traffic_scenes import scenes

STD = 0.6


def test_without_noise_all_samples_are_one():
    prior = small_prior(
        sampler=SamplerSettings(
            steps=3,
            temperature=0.0,
        )
    )
    found = sample_variances(prior, scenes(2).scenes, samples=3)
    assert found["vehicles"].min() > 0
    assert all(
        found[name].abs().max() < 1e-9 for name in ("knots", "lateral", "travel")
    )


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver_pp"])
def test_gaussian_samples_have_the_variance_of_the_sampler(sampler, monkeypatch):
    prior = small_prior(sampler=replace(SamplerSettings(), sampler=sampler))
    exact = denoiser(0.0, STD)
    monkeypatch.setattr(prior, "denoise", lambda x, level, context: exact(x, level))
    found = sample_variances(prior, scenes(4).scenes, samples=200)
    _, std = moments(
        exact,
        sampler,
        churn=1.0,
        steps=prior.sampler.steps,
        spacing=prior.sampler.spacing,
    )
    assert found["knots"].sum() / found["vehicles"].sum() == pytest.approx(
        std**2, rel=0.03
    )
    assert found["lateral"].sum() / found["vehicles"].sum() == pytest.approx(
        std**2, rel=0.05
    )


@pytest.mark.parametrize("samples", [3, 16])
@pytest.mark.parametrize("part", [0.5, 0.9])
def test_a_value_of_the_samples_own_law_lies_in_their_central_part_that_often(
    samples, part
):
    """Its rank among them takes each of the samples + 1 values alike."""
    ranks = torch.arange(samples + 1)
    assert central(ranks, samples, part=part).mean().item() == pytest.approx(part)
    assert torch.equal(
        central(ranks, samples, part=part), central(samples - ranks, samples, part=part)
    )


def test_the_regions_are_half_and_nine_tenths_of_the_samples():
    assert REGIONS == {"covered_50": 0.5, "covered_90": 0.9}


def test_vehicles_above_a_metre_a_second_count():
    scene = curved_scenes()
    count = {}
    for speed in (0.95, 1.05):
        scene["start"][:, 4, 3] = speed
        prior = small_prior(sampler=SamplerSettings(steps=2))
        count[speed] = sample_variances(prior, scene, samples=2)["vehicles"].item()
    assert count[1.05] == count[0.95] + 1
