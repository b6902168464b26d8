"""The network evaluations that a rollout costs."""

import torch

from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.baselines.safe_sim_opt import SafeSimOpt
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import Replay
from tests.traffic.baselines.attacks import baseline
from tests.traffic.e2.traffic_scenes import drive, scenes

REPLANS, STEPS = 4, 4  # of two seconds; of the small prior


def nfe(on, eta=2.0):
    return drive(scenes(2), on, eta).nfe.unique().tolist()


def test_every_denoising_step_is_a_pass_of_each_sample_and_a_gradient_doubles_it():
    prior = baseline("ctg_adv").prior
    assert nfe(Replay()) == [0]
    assert nfe(NominalTraffic(prior, "plan")) == [REPLANS * STEPS]
    assert nfe(NominalTraffic(prior, "predicted")) == [REPLANS * (STEPS + 1)]  # and one predicts the ego
    assert nfe(CTGAdv(prior, samples=3)) == [REPLANS * STEPS * 3]  # its gradients stop at the posterior mean
    assert nfe(SafeSimOpt(prior, samples=3)) == [REPLANS * STEPS * 3 * 2]
    assert not prior.denoiser._forward_hooks and torch.is_grad_enabled()
