"""Coalitions: who is chosen, who acts through whom, on which routes, and within which
templates."""

from dataclasses import replace

import pytest
import torch

from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.e2 import coalition
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import FULL, PAIR, SINGLE
from tests.traffic.e2.traffic_scenes import EGO, begin, replanned, scenes, synthesizer


def test_a_coalition_acts_on_the_ego_directly_or_through_members():
    on = synthesizer()
    scene = scenes(4).scenes
    state, plan = replanned(on, scene, eta=2.0)
    assert state.coalition.any(1).all() and not state.coalition[:, 0].any()
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

    def chained(*arguments):
        return replace(
            build(*arguments),
            coalition=acts,
            target=target,
            depth=torch.tensor([[0, 1, 2, 1, 3, 0]]),
        )

    def without_one(scene, world, skeleton, *arguments, **options):
        feasible = skeleton.coalition.clone()
        feasible[:, 1] = False
        return replace(
            propose(scene, world, skeleton, *arguments, **options), feasible=feasible
        )

    monkeypatch.setattr(coalition, "build_skeleton", chained)
    monkeypatch.setattr(coalition, "propose", without_one)
    state, _ = replanned(on, scene, eta=1.0)
    assert (
        state.coalition.nonzero()[:, 1].tolist() == [3] and state.target[0].max() == 0
    )


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
            skeleton={"pursuit": pursuit}, control={"adversarial_clip": 2.0}
        )
        state, plan = replanned(on, scene, eta=2.0)
        assert state.coalition.any(1).tolist() == [pursuit] * 3
        assert (plan.path_kl[state.coalition] > 0).all() and not state.anchor_jump.any()


def test_who_leaves_its_lane_returns_to_it_once_it_meets_nobody():
    on = synthesizer(reselect=0)
    scene = scenes(3).scenes
    world = World.at_start(scene)
    lanes = begin(on, scene, eta=2.0)
    state, _ = on.replan(lanes, world, EGO.plan(world))
    assert state.off_lane.any() and not (state.off_lane & ~state.coalition).any()
    moved = (state.routed.points != lanes.routed.points).flatten(2).any(-1)
    assert torch.equal(moved, state.off_lane)
    nobody = replace(
        state, coalition=state.coalition & False, target=state.target * 0 - 1
    )
    calm, _ = on.replan(nobody, world, EGO.plan(world))
    assert not calm.off_lane.any() and torch.equal(
        calm.routed.points, lanes.routed.points
    )


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
    assert plan.adversary.any() and torch.equal(plan.adversary, again.adversary)
    vehicles = plan.adversary.shape[1]
    assert not (
        plan.adversary & (scene["parked"] | ~scene["valid"])[:, :vehicles]
    ).any()


# --- causal templates limit the coalitions, scene by scene; `full` changes nothing


def test_templates_reach_the_rows_of_synthesized_traffic():
    """Equal scenes of equal noise: a vehicle more acts where the template allows it."""
    scene_set = scenes(4)
    on = synthesizer(reselect=0, responsibility="none")
    synthesize = synthesize_traffic(scene_set, on, sim=SimSettings(), batch=3)
    index = torch.arange(4)
    eta = torch.full((4,), 3.0)

    def acting(*template):
        return synthesize(IDMEgo(), index, eta, 0, *template)["adversaries"].sum(1)

    one, two, most = (acting(torch.full((4,), code)) for code in (SINGLE, PAIR, FULL))
    assert (
        (one <= 1).all() and (two <= 2).all() and (one <= two).all() and two.max() == 2
    )
    assert torch.equal(most, acting())
