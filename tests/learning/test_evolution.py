"""A round of Algorithm 1: against whom, in what, what changes, and what it reports."""

import copy
import math

import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.learning.bandit import BanditCurriculum
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.logging import GROUPS
from e2rl.learning.planner_tuning import PlannerImprovement
from e2rl.learning.policy import PolicyImprovement
from e2rl.learning.schedules import AdaptiveCurriculum
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import SimSettings
from e2rl.traffic.traffic import CHAIN, FULL, PAIR, keep_velocity
from tests.learning.small import Ambush, brake_check, rounds, small_run, small_scenes


def test_a_round_improves_moves_on_and_reports():
    run = small_run(nominal="prior")
    attack = run.synthesize
    asked = []
    run.synthesize = lambda ego, index, eta, seed: (
        asked.append((ego, eta, seed)) or attack(ego, index, eta, seed)
    )
    before = {key: value.clone() for key, value in run.ego.network.weights().items()}
    metrics = train_round(run)
    etas = [eta.tolist() for _, eta, _ in asked]
    assert etas == [[1.0] * 3, [0.0] * 3], (
        "the attack, then the same scenes by the prior alone"
    )
    assert asked[0][0] is run.ego and asked[0][2] == asked[1][2]
    assert any(
        not torch.equal(value, before[key])
        for key, value in run.ego.network.weights().items()
    )
    assert run.round == 1 and all(name.split("/")[0] in GROUPS for name in metrics)
    assert metrics["curriculum/eta"] == 1.0 and run.curriculum.eta == 1.25, (
        "no contact at eta 1: it rises"
    )
    assert all(isinstance(value, float) for value in metrics.values())
    train_round(run)
    assert asked[2][2] != asked[0][2], "another round, another seed"


def test_a_data_set_made_once_meets_the_policy_that_the_run_began_with():
    run = small_run(against="start")
    begun = small_run().ego.network.weights()
    attack = run.synthesize
    met = []
    run.synthesize = lambda ego, *given: (
        met.append(copy.deepcopy(ego.network.weights())) or attack(ego, *given)
    )
    for _ in range(2):
        train_round(run)
    assert any(
        not torch.equal(value, begun[key])
        for key, value in run.ego.network.weights().items()
    )
    assert all(
        torch.equal(value, begun[key])
        for weights in met
        for key, value in weights.items()
    )
    with pytest.raises(InputError, match=r"against=start"):
        RoundSettings(against="start", traffic="live")


def test_templates_are_given_to_the_attack_only_where_one_is_not_full():
    run = small_run(nominal="prior")
    attack = run.synthesize
    asked = []
    run.synthesize = lambda ego, index, eta, seed, *limits: (
        asked.append(limits) or attack(ego, index, eta, seed)
    )
    train_round(run)
    run.curriculum = BanditCurriculum(
        4, 4, etas=[0.5, 2.0], templates=["pair", "chain"]
    )
    run.curriculum.round = 1
    train_round(run)
    assert asked[:2] == [(), ()] and asked[3] == (), "the nominal traffic has none"
    assert set(asked[2][0].tolist()) <= {PAIR, CHAIN}
    newest = run.memory.rounds[-1].traffic["template"].tolist()
    assert newest == [*asked[2][0].tolist(), FULL, FULL, FULL]
    assert run.memory.pool(1.0).template.tolist() == newest + [FULL] * 6


@pytest.mark.parametrize("live", [None, Ambush()], ids=["replay", "live"])
def test_a_round_s_choices_and_their_outcomes_are_counted(live):
    run = small_run(live=live)
    metrics = train_round(run)
    (row,) = run.choices
    assert (row["round"], row["eta"], row["template"], row["draws"]) == (
        0,
        1.0,
        "full",
        3,
    )
    own = run.episodes.adversarial
    assert row["episodes"] == int(own.sum()) > 0 and row["failures"] == int(
        run.episodes.failed[own].sum()
    )
    assert row["left_out"] == metrics["synthesizer/left_out"] == 0


def test_nominal_traffic_may_be_the_log_or_missing():
    for nominal, kinds in (("log", {True, False}), ("none", {True})):
        run = small_run(nominal=nominal)
        train_round(run)
        assert set(run.episodes.adversarial.tolist()) == kinds
    with pytest.raises(InputError, match="nominal=zero"):
        RoundSettings(nominal="zero")


def test_live_traffic_reacts_to_the_learning_policy():
    told = []

    class Watched(Ambush):
        def replan(self, state, world, ego_plan):
            if not world.step.any():
                told.append(
                    (
                        ego_plan.clone(),
                        run.ego.plan(world),
                        keep_velocity(world.states[:, 0]),
                    )
                )
            return super().replan(state, world, ego_plan)

    run = small_run(nominal="prior", live=Watched())
    run.synthesize = None
    before = {key: value.clone() for key, value in run.ego.network.weights().items()}
    metrics = train_round(run)
    assert all(math.isfinite(value) for value in metrics.values())
    given, planned, straight = told[0]
    torch.testing.assert_close(given, planned)
    assert (given - straight).abs().max() > 0.5, "the plan is the policy's own"
    assert metrics["train/contact_adversarial"] == metrics["synthesizer/contact"] == 1.0
    assert metrics["train/contact_nominal"] == 0.0 and run.curriculum.eta < 1.0
    assert any(
        not torch.equal(value, before[key])
        for key, value in run.ego.network.weights().items()
    )


def planner_run(space, live=None):
    scenes = small_scenes(3, steps=40)
    present = {"desired_speed": 10.0, "headway": 1.0, "use_limits": False}
    given = {
        "search": {"trials": 3, "startup": 3},
        "space": space,
        "batch": 3,
        "traffic": live,
    }
    improve = PlannerImprovement(
        IDMEgo(**present), present, scenes=scenes, sim=SimSettings(), **given
    )
    return Evolution(
        AdaptiveCurriculum(3, 2),
        improve,
        synthesize=brake_check(scenes),
        settings=RoundSettings(scenes=3, nominal="log"),
    )


def test_planners_are_tuned_and_attacked_as_tuned():
    run = planner_run({"desired_speed": [0.1, 12.0]})
    metrics = train_round(run)
    assert metrics["train/trials"] == 3 and len(run.improve.trials) == 3
    assert run.ego.desired_speed > 5, "standing still is no improvement"
    assert metrics["train/objective"] <= metrics["train/objective_before"]
    assert not torch.isnan(run.curriculum.regret()).any(), (
        "its episodes feed the curriculum"
    )
    asked = []
    attack = run.synthesize
    run.synthesize = lambda ego, *rest: asked.append(ego) or attack(ego, *rest)
    current = run.ego
    train_round(run)
    assert asked == [current]


def test_unfit_combinations_are_refused():
    scenes = small_scenes()
    with pytest.raises(InputError, match="improves ego=actor"):
        PolicyImprovement(LaneGraphEgo(), scenes, sim=SimSettings())
    with pytest.raises(InputError, match="cannot hold an episode"):
        small_run(collect={"steps": 5})
    with pytest.raises(InputError, match="traffic=live"):
        planner_run({"headway": [1.0, 2.0]}, live=Ambush())


def test_a_copy_on_another_device_learns_what_the_ego_itself_would():
    """cpu:0 is a device of its own to the code, and the same to arithmetic; attacks
    meet the ego at home."""
    run = small_run(seed=3)
    expected = rounds(run, 2)
    weights = run.ego.network.weights()
    run = small_run(seed=3, expert={"device": "cpu:0"})
    assert run.improve._learning is not run.ego
    assert rounds(run, 2) == expected
    assert all(
        torch.equal(value, weights[name])
        for name, value in run.ego.network.weights().items()
    )
