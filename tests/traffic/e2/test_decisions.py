"""Decisions: the rule changes nothing, each of them does what it says, and what is alike so far is planned once."""

import pytest
import torch

from e2rl.search.tries import Family, scripts_of
from e2rl.sim.env import SimSettings
from e2rl.traffic.e2.decisions import BESIDE, LEADER, ONCOMING, RULE, WHOM, eligible, script_of
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rollout import roll_out
from tests.traffic.e2.crossing import make_world
from tests.traffic.e2.traffic_scenes import EGO, drive, scenes, synthesizer

EGO_STATE = (0.0, 0.0, 0.0, 10.0)


def driven(scene_set, on, script=None, seeds=None, index=None, eta=2.0):
    index = torch.arange(len(scene_set)) if index is None else torch.tensor(index)
    seeds = index if seeds is None else torch.as_tensor(seeds)
    etas = torch.full((len(index),), eta)
    return roll_out(scene_set, index, seeds, etas, EGO, on, SimSettings(), script=script)


def test_a_script_of_the_rule_is_no_script():
    scene_set, on = scenes(3), synthesizer()
    assert torch.equal(driven(scene_set, on, script_of(RULE, 3)).states, drive(scene_set, on, 2.0).states)


def test_without_strength_nobody_is_controlled_bit_for_bit():
    scene_set, on = scenes(3), synthesizer()
    idle = driven(scene_set, on, script_of(RULE._replace(strength=0.0), 3))
    assert torch.equal(idle.states, drive(scene_set, NominalTraffic(on.prior), 0.0).states)
    assert not idle.adversaries.any()


def test_until_its_onset_an_attack_is_the_prior_s_traffic():
    scene_set, on = scenes(3, steps=30), synthesizer()
    nominal = drive(scene_set, NominalTraffic(on.prior), 0.0).states
    late = driven(scene_set, on, scripts_of([Family("late", "e2", {"onset": 3}).draw(0, 0, 0, 0, True)] * 3)[1]).states
    assert torch.equal(late[:, :16], nominal[:, :16]) and not torch.equal(late, nominal)


@pytest.mark.parametrize(
    ("vehicle", "kind"),
    [((40.0, 3.5, 3.1, 9.0), "oncoming"), ((30.0, 0.0, 0.0, 9.0), "leader"), ((-15.0, 3.5, 0.0, 9.0), "beside"),
     ((25.0, -20.0, 1.57, 9.0), "crossing")],
)  # fmt: skip
def test_whom_names_one_kind_of_vehicle(vehicle, kind):
    world = make_world([EGO_STATE, vehicle])
    named = {name: bool(eligible(world, torch.tensor([k]), True)[0, 1]) for k, name in enumerate(WHOM)}
    assert [name for name in WHOM[1:] if named[name]] == [kind]
    assert named["any"] == (kind != "leader"), "planners know how to follow"
    assert eligible(world, torch.tensor([0]), False)[0, 1]
    assert {ONCOMING, BESIDE, LEADER} <= set(range(len(WHOM)))


def test_attempts_that_are_alike_so_far_are_planned_once_and_alike():
    """Two branches of a try share its first three replans: states agree, and half of their evaluations are saved."""
    scene_set, on = scenes(1, steps=30), synthesizer()
    parent = Family("rule", "e2", {}).draw(0, 0, 5, 0, True)
    tries = [parent, parent, parent.branch(1, 3, 77)]
    seeds, script = scripts_of(tries)
    out = driven(scene_set, on, script, seeds, [0, 0, 0])
    assert torch.equal(out.states[0], out.states[1]), "the same try twice"
    assert torch.equal(out.states[0, :16], out.states[2, :16]) and not torch.equal(out.states[0], out.states[2])
    alone = driven(scene_set, on, script[:1], seeds[:1], [0])
    torch.testing.assert_close(alone.states[0], out.states[0], rtol=0, atol=5e-3)
    whole, shared = float(alone.nfe[0]), float(out.nfe.sum())
    assert shared == pytest.approx(whole * (1 + 3 / 6), rel=0.15), "three of six replans are shared by all"
