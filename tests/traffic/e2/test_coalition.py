"""Coalitions: who is chosen, who acts through whom, and on which routes."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from e2rl.sim.world import World
from e2rl.traffic.e2 import coalition
from tests.traffic.e2.traffic_scenes import EGO, begin, replanned, scenes, synthesizer


def test_a_coalition_acts_on_the_ego_directly_or_through_members():
    on = synthesizer()
    scene = scenes(4).scenes
    state, plan = replanned(on, scene, eta=2.0)
    assert state.coalition.any(1).all()
    assert not state.coalition[:, 0].any()
    assert torch.equal(state.coalition, state.target >= 0)
    assert torch.equal(plan.adversary, state.coalition | state.drawn)
    members = state.coalition.clone()
    members[:, 0] = True
    assert members.gather(1, state.target.clamp(min=0)).all(), (
        "no chain leads over somebody who is not controlled"
    )
    assert (plan.path_kl[plan.adversary] > 0).all()


def test_a_chain_over_a_pruned_member_is_pruned(monkeypatch):
    """Vehicle 4 acts on 2, which acts on 1, which has no proposal."""
    on = synthesizer()
    scene = scenes(1).scenes
    target = torch.tensor([[-1, 0, 1, 0, 2, -1]])  # the rows in use
    acts = target >= 0
    build = coalition.build_skeleton
    propose = coalition.propose

    def chained(world, **arguments):
        return replace(
            build(world, **arguments),
            coalition=acts,
            target=target,
            depth=torch.tensor([[0, 1, 2, 1, 3, 0]]),
        )

    def without_one(world, skeleton, **options):
        feasible = skeleton.coalition.clone()
        feasible[:, 1] = False
        return replace(propose(world, skeleton, **options), feasible=feasible)

    monkeypatch.setattr(coalition, "build_skeleton", chained)
    monkeypatch.setattr(coalition, "propose", without_one)
    state, _ = replanned(on, scene, eta=1.0)
    assert state.coalition.nonzero()[:, 1].tolist() == [3]
    assert state.target[0].max() == 0


def test_pursuit_draws_vehicles_where_nobody_has_a_proposal(monkeypatch):
    """Without it nobody takes part then, and the plans are the prior's; with it V_adv
    alone moves the coalition."""
    scene = scenes(3).scenes
    propose = coalition.propose

    def nothing(*arguments, **options):
        anchor = propose(*arguments, **options)
        return replace(
            anchor, feasible=anchor.feasible & False, cost=anchor.cost + torch.inf
        )

    monkeypatch.setattr(coalition, "propose", nothing)
    for pursuit in (False, True):
        on = synthesizer(
            skeleton={"pursuit": pursuit},
            guidance={"adversarial_clip": 2.0, "scaling": "sigma", "feasibility": 0.0},
            kernels={"samples": 1},
        )
        state, plan = replanned(on, scene, eta=2.0)
        assert state.coalition.any(1).tolist() == [pursuit] * 3
        assert (plan.path_kl[state.coalition] > 0).all()
        assert not state.anchor_jump.any()


def test_who_leaves_its_lane_returns_to_it_once_it_meets_nobody():
    on = synthesizer(reselect=0)
    scene = scenes(3).scenes
    world = World.at_start(scene)
    lanes = begin(on, scene, eta=2.0)
    state, _ = on.replan(lanes, world, EGO.plan(world))
    assert state.off_lane.any()
    assert not (state.off_lane & ~state.coalition).any()
    moved = (state.routed.points != lanes.routed.points).flatten(2).any(-1)
    assert torch.equal(moved, state.off_lane)
    nobody = replace(
        state, coalition=state.coalition & False, target=state.target * 0 - 1
    )
    calm, _ = on.replan(nobody, world, EGO.plan(world))
    assert not calm.off_lane.any()
    assert torch.equal(calm.routed.points, lanes.routed.points)


@pytest.mark.parametrize("support", ["topology", "random"])
def test_the_other_supports_choose_a_coalition_too(support):
    """The ablations: whoever topology finds, or anybody who is there and not parked,
    drawn by the scene's seed."""
    scene = scenes(3).scenes
    _, plan = replanned(
        synthesizer(support=support, responsibility="none"),
        scene,
        eta=2.0,
        seeds=[5, 6, 7],
    )
    _, again = replanned(
        synthesizer(support=support, responsibility="none"),
        scene,
        eta=2.0,
        seeds=[5, 6, 7],
    )
    assert plan.adversary.any()
    assert torch.equal(plan.adversary, again.adversary)
    vehicles = plan.adversary.shape[1]
    assert not (
        plan.adversary & (scene["parked"] | ~scene["valid"])[:, :vehicles]
    ).any()


@pytest.mark.parametrize(("gap", "nats"), [(1.0, 20.0), (2.4, 48.0), (2.6, 50.0)])
def test_a_new_route_costs_its_log_probability_up_to_50_nats(gap, nats):
    """Of two routes, the other one by `gap` more likely, at the least temperature of
    0.05."""
    prior = SimpleNamespace(
        sampler=SimpleNamespace(route_temperature=0.0),
        route_choice=lambda _: torch.tensor([[[0.0, gap]]]),
    )
    result = coalition.Selector._route_nats(
        SimpleNamespace(prior=prior), None, torch.tensor([[0]])
    )
    assert result.item() == pytest.approx(nats, abs=1e-3)
