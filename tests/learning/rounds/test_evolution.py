"""A round of Algorithm 1: against whom, in what, what changes, and what it reports."""

import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.learning.logging import GROUPS
from e2rl.learning.rounds.evolution import RoundSettings
from e2rl.learning.rounds.policy import PolicyImprovement
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.run.errors import InputError
from e2rl.sim.settings import SimSettings
from tests.learning.small import rounds, small_run, small_scenes


def test_a_round_improves_moves_on_and_reports():
    run = small_run(nominal="prior")
    (attack,) = run.attacks
    requests = []
    run.attacks = [
        lambda ego, index, eta, seed: (
            requests.append((ego, eta, seed)) or attack(ego, index, eta, seed)
        )
    ]
    before = {key: value.clone() for key, value in run.ego.network.weights().items()}
    metrics = train_round(run)
    etas = [eta.tolist() for _, eta, _ in requests]
    assert etas == [[1.0] * 3, [0.0] * 3], (
        "the attack, then the same scenes by the prior alone"
    )
    assert requests[0][0] is run.ego
    assert requests[0][2] == requests[1][2]
    assert any(
        not torch.equal(value, before[key])
        for key, value in run.ego.network.weights().items()
    )
    assert run.round == 1
    assert all(name.split("/")[0] in GROUPS for name in metrics)
    assert metrics["curriculum/eta"] == 1.0
    assert run.curriculum.eta == 1.25, "no contact at eta 1: it rises"
    assert all(isinstance(value, float) for value in metrics.values())
    train_round(run)
    assert requests[2][2] != requests[0][2], "another round, another seed"


def test_a_round_s_choices_and_their_outcomes_are_counted():
    run = small_run()
    metrics = train_round(run)
    (row,) = run.choices
    assert (row["round"], row["eta"], row["draws"]) == (0, 1.0, 3)
    attacked = run.episodes.adversarial
    assert row["episodes"] == int(attacked.sum()) > 0
    assert row["failures"] == int(run.episodes.failed[attacked].sum())
    assert row["left_out"] == metrics["synthesizer/left_out"] == 0


def test_nominal_traffic_may_be_the_log_or_missing():
    for nominal, kinds in (("log", {True, False}), ("none", {True})):
        run = small_run(nominal=nominal)
        train_round(run)
        assert set(run.episodes.adversarial.tolist()) == kinds
    with pytest.raises(InputError, match="nominal=zero"):
        RoundSettings(nominal="zero")


def test_unfit_combinations_are_refused():
    scenes = small_scenes()
    with pytest.raises(InputError, match="improves ego=actor"):
        PolicyImprovement(LaneGraphEgo(), scenes, sim=SimSettings())
    with pytest.raises(InputError, match="cannot hold an episode"):
        small_run(collect={"steps": 5})


def test_a_copy_on_another_device_learns_what_the_ego_itself_would():
    """cpu:0 is a device of its own to the code, and the same to arithmetic; attacks
    meet the ego at home."""
    run = small_run(seed=3)
    expected = rounds(run, 2)
    weights = run.ego.network.weights()
    run = small_run(seed=3, device="cpu:0")
    assert run.improve.learning is not run.ego
    assert rounds(run, 2) == expected
    assert all(
        torch.equal(value, weights[name])
        for name, value in run.ego.network.weights().items()
    )
