"""The training loss: mirrors, hidden vehicles, and what a window's masks leave out."""

import pytest
import torch

from e2rl.learning.prior_training.loss import augment, denoising_loss, held_out_loss
from e2rl.learning.prior_training.training_settings import TrainingSettings
from e2rl.learning.prior_training.windows import make_windows
from tests.prior.small import curved_scenes, small_prior

QUIET = {"drop": 0.0, "feature_noise": 0.0, "accel_noise": 0.0, "bf16": False}


@pytest.fixture(scope="module")
def windows():
    return make_windows(curved_scenes(2))


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_two_mirrors_cancel_and_none_changes_nothing(windows):
    mirror, plain = TrainingSettings(mirror=1.0, **QUIET), TrainingSettings(mirror=0.0, **QUIET)
    once = augment(windows, mirror, seeded())
    assert (once["x0"] != windows["x0"]).any()
    for batch in (augment(once, mirror, seeded()), augment(windows, plain, seeded())):
        for key in windows.keys():  # noqa: SIM118 - a TensorDict
            torch.testing.assert_close(batch[key], windows[key], msg=key)


def test_the_loss_of_a_mirrored_network_input_is_defined_by_the_same_targets(windows):
    """An untrained network is odd in the sided entries, so its loss does not see the mirror."""
    mirror = TrainingSettings(mirror=1.0, **QUIET)
    prior = small_prior()
    torch.nn.init.zeros_(prior.denoiser.head[1].weight)
    torch.nn.init.zeros_(prior.denoiser.head[1].bias)
    settings = TrainingSettings(mirror=0.0, levels=1, **QUIET)
    there = augment(windows, mirror, seeded())
    losses = [denoising_loss(prior, batch, settings, seeded(3))[1]["trajectory"] for batch in (windows, there)]
    assert losses[0] == pytest.approx(losses[1].item(), rel=0.2)


def test_hidden_vehicles_are_absent_weigh_nothing_and_are_never_the_ego(windows):
    batch = augment(windows, TrainingSettings(**{**QUIET, "drop": 1.0}), seeded())
    assert batch["present"][:, 0].all() and not batch["present"][:, 1:].any() and (batch["weight"][:, 1:] == 0).all()


def test_the_windows_themselves_are_left_alone(windows):
    before = windows.clone()
    augment(windows, TrainingSettings(), seeded())
    assert all(torch.equal(before[key], windows[key]) for key in before.keys())  # noqa: SIM118


def test_accelerations_are_noisy_in_feature_and_state_alike(windows):
    settings = TrainingSettings(**{**QUIET, "accel_noise": 1.0, "mirror": 0.0})
    batch = augment(windows, settings, seeded())
    change = batch["a"] - windows["a"]
    assert 0.3 < (change == 0).float().mean() < 0.7
    torch.testing.assert_close(batch["nodes"][..., 1] - windows["nodes"][..., 1], change / 2, rtol=0, atol=1e-5)


def test_a_perfect_estimate_costs_nothing_but_the_fit_s_own_error(windows):
    prior, settings = small_prior(), TrainingSettings(levels=2, **QUIET)
    batch = windows.clone()
    prior.denoiser.forward = lambda x, level, encoding: torch.cat([batch["x0"]] * 2)
    loss, parts = denoising_loss(prior, batch, settings, seeded())
    assert parts["action"] == 0 and parts["trajectory"] < 0.05 and loss.isfinite()


def test_offsets_count_on_lanes_only(windows):
    prior, settings = small_prior(), TrainingSettings(levels=1, **QUIET)
    lane, free = windows.clone(), windows.clone()
    free["on_lane"] = torch.zeros_like(free["on_lane"])
    wrong = windows["x0"].clone()
    wrong[..., -1] += 2.0  # 1 m to the left in the end
    prior.denoiser.forward = lambda x, level, encoding: wrong
    seen, unseen = (denoising_loss(prior, batch, settings, seeded())[1]["trajectory"] for batch in (lane, free))
    assert seen > 0.2 and unseen < 0.05


def test_held_out_loss_is_the_same_each_time(windows):
    prior, settings = small_prior(), TrainingSettings(batch=4)
    assert held_out_loss(prior, windows, settings) == held_out_loss(prior, windows, settings)
