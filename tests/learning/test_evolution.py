"""A round of Algorithm 1: against whom, in what, what changes, and what it reports."""

import pytest
import torch

from e2rl.ego.idm import IDMEgo
from e2rl.ego.lane_graph import LaneGraphEgo
from e2rl.errors import InputError
from e2rl.learning.curriculum import CurriculumScheduler, CurriculumSettings
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.imitation import ImitationSettings, recorded_pairs
from e2rl.learning.improvement import CollectSettings, PlannerImprovement, PolicyImprovement
from e2rl.learning.logging import GROUPS
from e2rl.learning.update import UpdateSettings
from e2rl.sim.env import SimSettings
from tests.learning.small import brake_check, small_run, small_scenes


def test_a_round_improves_moves_on_and_reports():
    seen = []
    run = small_run(nominal="prior", measure=lambda ego, number: seen.append((ego, number)) or {"cfr": 0.5})
    attack, asked = run.synthesize, []
    run.synthesize = lambda ego, index, eta, seed: asked.append((ego, eta, seed)) or attack(ego, index, eta, seed)
    before = {key: value.clone() for key, value in run.ego.network.weights().items()}
    metrics = run.run_round()
    assert [eta for _, eta, _ in asked] == [1.0, 0.0], "the attack, then the same scenes by the prior alone"
    assert asked[0][0] is run.ego and asked[0][2] == asked[1][2]
    assert seen == [(run.ego, 0)] * 2 and metrics["eval/before_cfr"] == metrics["eval/after_cfr"] == 0.5
    assert any(not torch.equal(value, before[key]) for key, value in run.ego.network.weights().items())
    assert run.round == 1 and all(name.split("/")[0] in GROUPS for name in metrics)
    assert metrics["curriculum/eta"] == 1.0 and run.curriculum.eta == 1.25, "no contact at eta 1: it rises"
    assert all(isinstance(value, float) for value in metrics.values())
    run.run_round()
    assert asked[2][2] != asked[0][2], "another round, another seed"


def test_contacts_of_the_attack_lower_the_intensity():
    run = small_run()
    etas = [run.run_round()["curriculum/eta"] for _ in range(4)]
    assert etas == [1.0, 1.25, 1.0, 1.25], "the trivial synthesizer hits above eta 1"


def test_nominal_traffic_may_be_the_log_or_missing():
    for nominal, kinds in (("log", {True, False}), ("none", {True})):
        run = small_run(nominal=nominal)
        run.run_round()
        assert set(run.episodes.adversarial.tolist()) == kinds
    with pytest.raises(InputError, match="nominal=zero"):
        RoundSettings(nominal="zero")


def test_recorded_and_corrective_pairs_are_cloned():
    scenes = small_scenes()
    expert = recorded_pairs(scenes, SimSettings(), ImitationSettings(drives=0)).select("observation", "action")
    run = small_run(scenes=scenes, cloning=0.5)
    run.improve.expert, run.improve.teacher = expert, IDMEgo()
    metrics = run.run_round()
    assert metrics["train/expert_pairs"] > len(expert) and "train/loss_cloning" in metrics


def planner_run(grid, scenes=None):
    scenes = scenes or small_scenes(3, steps=40)
    present = {"desired_speed": 10.0, "headway": 1.0, "use_limits": False}
    improve = PlannerImprovement(IDMEgo, present, grid, scenes, SimSettings(), batch=3)
    curriculum = CurriculumScheduler(3, 2, CurriculumSettings())
    return Evolution(curriculum, improve, brake_check(scenes), RoundSettings(scenes=3, nominal="log"))


def test_planners_are_tuned_and_attacked_as_tuned():
    run = planner_run({"desired_speed": [0.1, 12.0]})
    metrics = run.run_round()
    assert metrics["train/trials"] == 3 and len(run.improve.trials) == 3
    assert run.ego.desired_speed != 0.1, "standing still is no improvement"
    assert metrics["train/objective"] <= metrics["train/objective_before"]
    assert not torch.isnan(run.curriculum.regret()).any(), "its episodes feed the curriculum"
    asked = []
    attack = run.synthesize
    run.synthesize = lambda ego, *rest: asked.append(ego) or attack(ego, *rest)
    current = run.ego
    run.run_round()
    assert asked == [current]


def test_unfit_combinations_are_refused():
    scenes = small_scenes()
    with pytest.raises(InputError, match="speeed"):
        planner_run({"speeed": [1.0]})
    with pytest.raises(InputError, match="improves ego=actor"):
        PolicyImprovement(LaneGraphEgo(), scenes, SimSettings(), UpdateSettings(), CollectSettings())
    with pytest.raises(InputError, match="cannot hold an episode"):
        small_run(collect=CollectSettings(batch=4, steps=5, iterations=2))
