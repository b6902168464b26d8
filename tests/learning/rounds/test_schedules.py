"""Intensities and fractions of the curricula that follow a plan."""

import pytest
import torch

from e2rl.learning.rounds.schedules import (
    AdaptiveCurriculum,
    ConstantCurriculum,
    LinearCurriculum,
)
from e2rl.run.errors import InputError

SCENES = torch.zeros(4000, dtype=torch.int64)


def test_linear_values_rise_to_the_final_ones_and_stay():
    curriculum = LinearCurriculum(
        6, 10, eta=0.5, eta_final=2.5, ramp=0.5, fraction=0.0, fraction_final=0.9
    )
    etas = []
    fractions = []
    for _ in range(10):
        etas.append(curriculum.eta), fractions.append(curriculum.fraction)
        curriculum.advance(1.0)
    assert etas == pytest.approx([0.5, 0.9, 1.3, 1.7, 2.1] + [2.5] * 5)
    assert fractions == pytest.approx([0.0, 0.18, 0.36, 0.54, 0.72] + [0.9] * 5)


def test_adaptive_intensity_seeks_the_band_within_its_bounds():
    band = {
        "eta_step": 0.5,
        "eta_min": 0.5,
        "eta_max": 2.0,
        "target_low": 0.2,
        "target_high": 0.4,
    }
    curriculum = AdaptiveCurriculum(
        6,
        10,
        eta=1.0,
        **band,
    )
    observed = []
    for rate in (0.0, 0.2, 0.4, 0.1, 0.1, 0.9, 0.9, 0.9, 0.9, 0.9):
        curriculum.advance(rate)
        observed.append(curriculum.eta)
    assert observed == [1.5, 1.5, 1.5, 2.0, 2.0, 1.5, 1.0, 0.5, 0.5, 0.5], (
        "the band's ends belong to it"
    )
    curriculum.advance()
    assert curriculum.eta == 0.5
    assert curriculum.round == 11, "no collision rate is known: it stays"


@pytest.mark.parametrize(
    ("eta", "spread", "low", "high"),
    [
        (2.0, 1.0, 1.0, 3.0),
        (0.5, 1.0, 0.25, 1.5),
        (4.5, 1.0, 3.5, 5.0),
        (1.0, 0.0, 1.0, 1.0),
    ],
)
def test_scenes_have_intensities_uniform_around_the_round_s_cut_at_the_bounds(
    eta, spread, low, high
):
    etas = AdaptiveCurriculum(
        6, 10, eta=eta, spread=spread, eta_min=0.25, eta_max=5.0
    ).etas(SCENES)
    assert etas.min() >= low
    assert etas.max() <= high
    assert etas.mean().item() == pytest.approx((low + high) / 2, abs=0.05)
    assert etas.std().item() == pytest.approx((high - low) / 12**0.5, abs=0.05)


def test_a_linear_intensity_is_never_below_zero():
    etas = LinearCurriculum(
        6,
        10,
        eta=0.5,
        eta_final=2.0,
        spread=1.0,
    ).etas(SCENES)
    assert 0 <= etas.min() < 0.05
    assert 1.4 < etas.max() <= 1.5


def test_constant_intensities_take_turns():
    curriculum = ConstantCurriculum(
        6,
        10,
        eta=[1.0, 2.0, 3.0],
        fraction=0.3,
    )
    observed = []
    for _ in range(3):
        observed.append(curriculum.etas(torch.arange(4)).tolist())
        curriculum.advance(0.0)
    assert observed == [
        [1.0, 2.0, 3.0, 1.0],
        [2.0, 3.0, 1.0, 2.0],
        [3.0, 1.0, 2.0, 3.0],
    ]
    assert curriculum.eta == 2.0
    assert curriculum.fraction == 0.3


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (AdaptiveCurriculum, {"target_low": 0.6}),
        (LinearCurriculum, {"spread": -1.0}),
        (ConstantCurriculum, {"eta": [1.0, -1.0]}),
    ],
)
def test_wrong_settings_are_refused(kind, settings):
    with pytest.raises(InputError, match=f"curriculum.{next(iter(settings))}"):
        kind(6, 10, **settings)
