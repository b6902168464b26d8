"""Every baseline: the prior where it has no gain, the same alone and in a batch, on its
authors' terms and on ours."""

import pytest
import torch

from e2rl.sim.world import World
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import LogReplay
from tests.traffic.baselines.attacks import ADVERSARIES, SMALL, baseline, first_replan
from tests.traffic.e2.traffic_scenes import EGO, begin, executed, replanned, scenes


@pytest.mark.parametrize("knowledge", ["plan", "predicted"])
@pytest.mark.parametrize("name", SMALL)
def test_without_gain_it_is_the_prior_bit_for_bit(name, knowledge):
    on = baseline(
        name,
        gain=0.0,
        knowledge=knowledge,
    )
    scene = scenes(2).scenes
    _, plan = replanned(
        on,
        scene,
        eta=2.0,
        times=3,
    )
    _, nominal = replanned(NominalTraffic(on.prior, knowledge), scene, times=3)
    assert torch.equal(plan.states, nominal.states)
    assert torch.equal(plan.present, nominal.present)
    assert not plan.adversary.any()
    assert (plan.path_kl == 0).all()


@pytest.mark.parametrize("name", ADVERSARIES)
def test_without_intensity_it_is_the_prior_bit_for_bit_also_beside_scenes_with_one(
    name,
):
    on = baseline(name)
    scene = scenes(2).scenes
    world = World.at_start(scene)
    eta = torch.tensor([0.0, 2.0])
    _, plan = on.replan(on.reset(scene, torch.arange(2), eta), world, EGO.plan(world))
    _, nominal = replanned(NominalTraffic(on.prior, on.knowledge), scene)
    torch.testing.assert_close(
        plan.states[0],
        nominal.states[0],
        rtol=0,
        atol=5e-3,
    )
    assert not plan.adversary[0].any()
    _, calm = replanned(on, scene, eta=0.0)
    assert torch.equal(calm.states, nominal.states)


@pytest.mark.parametrize("name", SMALL)
def test_a_scene_is_planned_alike_alone_and_in_a_batch(name):
    on = baseline(name)
    scene = scenes(3).scenes
    _, whole = replanned(
        on,
        scene,
        eta=2.0,
        seeds=[5, 6, 7],
        times=2,
    )
    _, alone = replanned(
        on,
        scene[1:2],
        eta=2.0,
        seeds=[6],
        times=2,
    )
    torch.testing.assert_close(
        alone.states,
        whole.states[1:2],
        rtol=0,
        atol=2e-2,
    )
    assert torch.equal(alone.adversary, whole.adversary[1:2])


@pytest.mark.parametrize("name", ADVERSARIES)
def test_it_attacks_on_the_authors_terms_and_on_ours(name):
    scene = scenes(3).scenes
    for terms in ({}, {"knowledge": "predicted", "responsibility": "full"}):
        _, plan = replanned(baseline(name, **terms), scene, eta=2.0)
        _, nominal = replanned(baseline(name, **terms), scene, eta=0.0)
        assert plan.adversary.any()
        assert not plan.adversary[:, 0].any()
        assert not torch.equal(
            plan.states[plan.adversary], nominal.states[plan.adversary]
        )
        assert plan.states.isfinite().all()


@pytest.mark.parametrize("name", SMALL)
def test_who_predicts_the_ego_does_not_look_at_its_plan(name):
    on = baseline(name, knowledge="predicted")
    scene = scenes(2).scenes
    world = World.at_start(scene)
    plans = [
        on.replan(begin(on, scene, eta=2.0), world, EGO.plan(world) + shift)[1].states
        for shift in (0.0, 50.0)
    ]
    assert torch.equal(plans[0], plans[1])


def test_the_yielding_rule_binds_the_adversaries():
    """On the authors' terms nobody brakes for the ego; with ours who meets it does."""
    scene = scenes(2).scenes
    duties = []
    for responsibility in ("none", "full"):
        bound = baseline("ctg_adv", responsibility=responsibility)
        (current, _), _ = first_replan(bound, scene)
        state, _, context = bound.replan_group(current)
        duties.append(context.obstacles.duty)
        assert torch.equal(duties[-1].exempt | duties[-1].yields, state.adversary)
    assert not duties[0].yields.any()
    assert duties[1].yields.any()


@pytest.mark.parametrize("name", ["ccdiff", "cat"])
def test_who_is_left_alone_replays_and_the_prior_sees_where_they_are(name):
    on = baseline(name)
    scene = scenes(3).scenes
    state = begin(on, scene, eta=2.0)
    world = World.at_start(scene)
    for _ in range(2):
        plan = EGO.plan(world)
        state, traffic = on.replan(state, world, plan)
        logged = LogReplay().replan(None, world, plan)[1]
        driven = state.top if name == "ccdiff" else state.held
        assert torch.equal(traffic.states[~driven], logged.states[~driven])
        assert torch.equal(traffic.present[~driven], logged.present[~driven])
        world = executed(world, traffic, ego_plan=plan)
        here = scene["valid"][:, :8] & ~driven
        torch.testing.assert_close(
            state.lane.states()[here][:, :3], logged.states[here][:, 4, :3]
        )
    assert traffic.adversary.any()
    assert not (traffic.adversary & ~driven).any()
