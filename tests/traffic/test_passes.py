"""The passes of the network that a rollout costs."""

import torch

from e2rl.rivals.ctg_adv import CTGAdv
from e2rl.rivals.safe_sim_opt import SafeSimOpt
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.replay import Replay
from tests.rivals.attacks import rival
from tests.synthesizer.traffic_scenes import drive, scenes

REPLANS, STEPS = 4, 4  # of two seconds; of the small prior


def passes(on, eta=2.0):
    return drive(scenes(2), on, eta)["passes"].unique().tolist()


def test_every_denoising_step_is_a_pass_of_each_sample_and_a_gradient_doubles_it():
    prior = rival("ctg_adv").prior
    assert passes(Replay()) == [0]
    assert passes(NominalTraffic(prior, "plan")) == [REPLANS * STEPS]
    assert passes(NominalTraffic(prior, "predicted")) == [REPLANS * (STEPS + 1)]  # and one predicts the ego
    assert passes(CTGAdv(prior, samples=3)) == [REPLANS * STEPS * 3]  # its gradients stop at the posterior mean
    assert passes(SafeSimOpt(prior, samples=3)) == [REPLANS * STEPS * 3 * 2]
    assert not prior.denoiser._forward_hooks and torch.is_grad_enabled()
