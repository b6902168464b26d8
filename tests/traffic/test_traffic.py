"""The plans of a rollout and what it costs in network evaluations."""

import pytest
import torch

from e2rl.sim.world import World
from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.baselines.safe_sim_opt import SafeSimOpt
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import LogReplay
from e2rl.traffic.traffic import POINT_STEPS, REPLAN_STEPS
from tests.traffic.baselines.attacks import baseline
from tests.traffic.e2.traffic_scenes import EGO, ROWS, drive, scenes, synthesizer


@pytest.fixture(scope="module")
def attacked():
    """Rollouts of e2 on three scenes."""
    return drive(scenes(), synthesizer(), 2.0)


def test_the_first_point_of_a_plan_is_where_its_vehicle_is_half_a_second_later(
    attacked,
):
    out = attacked
    assert out.plans.shape == (3, 20 // REPLAN_STEPS, ROWS, 50 // POINT_STEPS, 2)
    later = out.states[:, REPLAN_STEPS::REPLAN_STEPS, :ROWS, :2]
    driven = (out.simulated[:, None] & out.valid[:, REPLAN_STEPS::REPLAN_STEPS])[
        :, :, :ROWS
    ]
    driven[:, :, 0] = False
    assert POINT_STEPS == REPLAN_STEPS
    assert driven.sum() > 40
    torch.testing.assert_close(
        out.plans[:, :, :, 0][driven], later[driven], rtol=0, atol=1e-4
    )


def test_the_ego_s_first_plan_is_what_it_plans_at_the_start(attacked):
    scene_set = scenes()
    planned = EGO.plan(World.at_start(scene_set.scenes))[
        :, POINT_STEPS - 1 :: POINT_STEPS, :2
    ]
    torch.testing.assert_close(attacked.plans[:, 0, 0], planned)


def test_whoever_aims_is_an_adversary_and_aims_at_the_ego_or_at_another_one(
    attacked,
):
    out = attacked
    aims = out.targets >= 0
    assert aims.any()
    assert torch.equal(aims.any(1), out.adversaries[:, :ROWS])
    for scene, replan, vehicle in aims.nonzero().tolist():
        target = out.targets[scene, replan, vehicle]
        assert target != vehicle
        assert target == 0 or aims[scene, replan, target]


REPLANS, STEPS = 2, 4  # of a second; of the small prior


def nfe(on, eta=2.0):
    return drive(scenes(2, steps=10), on, eta).nfe.unique().tolist()


def test_every_denoising_step_is_a_pass_of_each_sample_and_a_gradient_doubles_it():
    prior = baseline("ctg_adv").prior
    assert nfe(LogReplay()) == [0]
    assert nfe(NominalTraffic(prior, "plan")) == [REPLANS * STEPS]
    assert nfe(NominalTraffic(prior, "predicted")) == [
        REPLANS * (STEPS + 1)
    ]  # and one predicts the ego
    assert nfe(CTGAdv(prior, samples=3)) == [
        REPLANS * STEPS * 3
    ]  # its gradients stop at the posterior mean
    assert nfe(SafeSimOpt(prior, samples=3)) == [REPLANS * STEPS * 3 * 2]
    assert not prior.denoiser._forward_hooks
    assert torch.is_grad_enabled()
