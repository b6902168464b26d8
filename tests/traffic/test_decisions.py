"""Decisions: the rule changes nothing, and each of them does what it says."""

import pytest
import torch

from e2rl.sim.settings import SimSettings
from e2rl.traffic.decisions import BESIDE, LEADER, ONCOMING, RULE, WHOM, eligible
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rollout import roll_out
from tests.traffic.e2.crossing import make_world
from tests.traffic.e2.traffic_scenes import EGO, drive, scenes, synthesizer

EGO_STATE = (0.0, 0.0, 0.0, 10.0)


def driven(scene_set, on, decisions):
    index = torch.arange(len(scene_set))
    inputs = torch.tensor([decisions] * len(index))
    return roll_out(
        scene_set,
        index,
        seed=index,
        eta=torch.full((len(index),), 2.0),
        ego=EGO,
        traffic=on,
        sim=SimSettings(),
        decisions=inputs,
    )


def test_decisions_of_the_rule_are_none():
    scene_set = scenes(2, steps=10)
    on = synthesizer()
    assert torch.equal(
        driven(scene_set, on, decisions=RULE).states, drive(scene_set, on, 2.0).states
    )


def test_without_strength_nobody_is_controlled_bit_for_bit():
    scene_set = scenes(2, steps=10)
    on = synthesizer()
    idle = driven(scene_set, on, decisions=RULE._replace(strength=0.0))
    assert torch.equal(
        idle.states, drive(scene_set, NominalTraffic(on.prior), 0.0).states
    )
    assert not idle.adversaries.any()


@pytest.mark.parametrize(
    ("vehicle", "kind"),
    [((40.0, 3.5, 3.1, 9.0), "oncoming"), ((30.0, 0.0, 0.0, 9.0), "leader"), ((-15.0, 3.5, 0.0, 9.0), "beside"),
     ((25.0, -20.0, 1.57, 9.0), "crossing")],
)  # fmt: skip
def test_whom_names_one_kind_of_vehicle(vehicle, kind):
    world = make_world([EGO_STATE, vehicle])
    named = {
        name: bool(eligible(world, torch.tensor([k]), lawful=True)[0, 1])
        for k, name in enumerate(WHOM)
    }
    assert [name for name in WHOM[1:] if named[name]] == [kind]
    assert named["any"] == (kind != "leader"), "planners know how to follow"
    assert eligible(world, torch.tensor([0]), lawful=False)[0, 1]
    assert {ONCOMING, BESIDE, LEADER} <= set(range(len(WHOM)))


@pytest.mark.parametrize("kind", ["oncoming", "crossing", "beside"])
def test_nobody_else_acts_by_proposal_or_by_kernel(kind):
    others = [
        (40.0, 3.5, 3.1, 9.0),
        (-15.0, 3.5, 0.0, 9.0),
        (25.0, -20.0, 1.57, 9.0),
        (60.0, -3.5, 3.1, 9.0),
    ]
    world = make_world([EGO_STATE, *others], 4)
    on = synthesizer()
    inputs = torch.tensor([RULE._replace(whom=WHOM.index(kind))] * 4)
    state = on.reset(
        world.scene, torch.arange(4), torch.full((4,), 2.0), decisions=inputs
    )
    plan = on.replan(state, world, EGO.plan(world))[1]
    assert plan.adversary.any()
    assert not (plan.adversary & ~eligible(world, inputs[:, 1], lawful=False)).any()
