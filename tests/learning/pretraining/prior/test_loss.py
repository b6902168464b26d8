"""The training loss: mirrors, hidden vehicles, and what a window's masks leave out."""

import pytest
import torch

from e2rl.learning.pretraining.prior import loss
from e2rl.learning.pretraining.prior.loss import (
    DenoisingLoss,
    augment,
    draw,
    loss_weight,
)
from e2rl.learning.pretraining.prior.windows import make_windows
from tests.prior.small import curved_scenes, small_prior

QUIET = {"MIRROR": 0.0, "DROP": 0.0, "ACCEL_NOISE": 0.0}


@pytest.fixture
def augmented(monkeypatch):
    """Windows augmented in one way only."""

    def augmented(windows, **constants):
        for name, value in (QUIET | constants).items():
            monkeypatch.setattr(loss, name, value)
        return augment(windows, seeded())

    return augmented


def terms(prior, batch, generator):
    """The loss of windows and its two terms, without noise on the features."""
    drawn = draw(batch, generator)
    total = loss_weight(batch, drawn).sum().clamp(min=1)
    return DenoisingLoss(prior.denoiser, feature_noise=0.0)(batch, drawn, total)


@pytest.fixture(scope="module")
def windows():
    return make_windows(curved_scenes(2))


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_two_mirrors_cancel_and_none_changes_nothing(windows, augmented):
    once = augmented(windows, MIRROR=1.0)
    assert (once["x0"] != windows["x0"]).any()
    for batch in (augmented(once, MIRROR=1.0), augmented(windows)):
        for key in windows.keys():  # noqa: SIM118 - a TensorDict
            torch.testing.assert_close(batch[key], windows[key], msg=key)


def test_hidden_vehicles_are_absent_weigh_nothing_and_are_never_the_ego(
    windows, augmented
):
    batch = augmented(windows, DROP=1.0)
    assert batch["present"][:, 0].all()
    assert not batch["present"][:, 1:].any()
    assert (batch["weight"][:, 1:] == 0).all()


def test_accelerations_are_noisy_in_feature_and_state_alike(windows, augmented):
    batch = augmented(windows, ACCEL_NOISE=1.0)
    change = batch["a"] - windows["a"]
    assert 0.3 < (change == 0).float().mean() < 0.7
    torch.testing.assert_close(
        batch["nodes"][..., 1] - windows["nodes"][..., 1], change / 2, rtol=0, atol=1e-5
    )


def test_noise_levels_are_stratified_and_a_clean_ego_weighs_nothing(windows):
    drawn = draw(windows, seeded())
    level = drawn["level"]
    assert level.shape == (len(windows), loss.LEVELS)
    assert level.min() >= 0.01
    assert level.max() <= 0.99
    bins = ((level - 0.01) / 0.98 * loss.LEVELS).floor()
    assert torch.equal(bins, torch.arange(float(loss.LEVELS)).expand_as(bins))
    weight = loss_weight(windows, drawn).unflatten(0, (loss.LEVELS, len(windows)))
    assert torch.equal(weight[..., 0], windows["weight"][:, 0] * ~drawn["clean"].T)
    assert torch.equal(
        weight[..., 1:], windows["weight"][:, 1:].expand(loss.LEVELS, -1, -1)
    )


def test_a_perfect_estimate_costs_nothing_but_the_fit_s_own_error(windows):
    prior = small_prior()
    prior.denoiser.forward = lambda x, level, encoding: torch.cat(
        [windows["x0"]] * loss.LEVELS
    )
    total, action, trajectory = terms(prior, windows, generator=seeded())
    assert action == 0
    assert trajectory < 0.05
    assert total == loss.TRAJECTORY * trajectory


def test_the_action_term_is_the_weighted_mean_square_over_known_knots(windows):
    prior = small_prior()
    prior.denoiser.forward = lambda x, level, encoding: torch.cat(
        [windows["x0"] + 0.5] * loss.LEVELS
    )
    drawn = draw(windows, seeded())
    weight = loss_weight(windows, drawn)
    certain = torch.cat([windows["knot_weight"]] * loss.LEVELS).mean(-1)
    expected = (0.25 * certain * weight).sum() / weight.sum()
    torch.testing.assert_close(terms(prior, windows, generator=seeded())[1], expected)


def test_offsets_count_on_lanes_only(windows):
    prior = small_prior()
    free = windows.clone()
    wrong = windows["x0"].clone()
    free["on_lane"] = torch.zeros_like(free["on_lane"])
    wrong[..., -1] += 2.0  # 1 m to the left in the end
    prior.denoiser.forward = lambda x, level, encoding: torch.cat([wrong] * loss.LEVELS)
    observed, unseen = (
        terms(prior, batch, generator=seeded())[2] for batch in (windows, free)
    )
    assert observed > 0.2
    assert unseen < 0.05
