"""The selection of the skeleton figure: the longest chain of a run, and the rollout it belongs to."""

import pytest
import torch

from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.planners.idm_planner import IDMEgo
from e2rl.report.skeleton_figure import LongestChain, link_risk
from e2rl.run.errors import InputError
from e2rl.sim.env import SimSettings
from e2rl.traffic.e2.skeleton import Selection
from e2rl.traffic.e2.topology import TopologySettings
from e2rl.traffic.rule_based import Replay
from tests.traffic.e2.traffic_scenes import scenes, synthesizer


def selection(*targets, seed=0, risk=0.5):
    """Scenes of whose vehicles each acts on its target (-1: on nobody), every pair of the same risk at two moments."""
    target = torch.tensor(targets)
    count, vehicles = target.shape
    weights = torch.full((count, 2, vehicles, vehicles), risk)
    moments, acts = torch.tensor([[0.1, 0.6]]).expand(count, 2), target >= 0
    return Selection(
        torch.arange(count) + seed,
        torch.zeros(count).long(),
        torch.zeros(count, 2, vehicles, 4),
        moments,
        weights,
        acts,
        acts,
        acts,
        target,
        TopologySettings(),
    )


def listener():
    return LongestChain(Method("e2", synthesizer(), 2.0))


def test_links_then_members_then_risk_decide_and_the_first_of_equals_stays():
    chain = listener()
    chain(selection([-1, -1, -1, -1]))
    assert chain.longest is None
    for given, seed in (
        (selection([-1, 0, -1, -1], [-1, 0, 0, -1]), 1),
        (selection([-1, 0, 0, -1], seed=10), 1),
        (selection([-1, 0, 0, -1], seed=20, risk=0.9), 20),
        (selection([-1, 0, 0, 0], [-1, 0, 1, -1], seed=30), 31),
        (selection([-1, 0, 0, 0], seed=40), 31),
    ):
        chain(given)
        assert chain.longest.seed.tolist() == [seed] and len(chain.longest.target) == 1


def test_the_risk_of_links_is_that_of_each_member_with_its_target():
    given = selection([-1, 0, 1, -1])
    given.weights[0, 1, 1, 0], given.weights[0, 1, 2, 1], given.weights[0, 1, 2, 0] = 0.7, 0.2, 0.99
    torch.testing.assert_close(link_risk(given), torch.tensor([[1.0, 0.9]]))


def test_the_kept_selection_is_of_a_rollout_of_the_run(tmp_path):
    chain, scene_set = listener(), scenes(3)
    setup = Setup(scene_set, IDMEgo(), "idm", SimSettings(), batch=2)
    run_protocol(setup, [chain.method], [0, 4], tmp_path, only=[1, 2])
    rollout = chain.rollout(scene_set, "idm", tmp_path)
    assert rollout.scene_id in scene_set.scene_id[1:] and rollout.seed in (0, 4)
    members = chain.longest.coalition[0].nonzero()[:, 0].tolist()
    assert members and rollout.adversaries[members].all()


def test_what_chooses_nobody_has_no_figure_and_says_so(tmp_path):
    scene_set = scenes(1)
    for method in (Method("e2", synthesizer(), 0.0), Method("replay", Replay())):
        chain = LongestChain(method)
        run_protocol(Setup(scene_set, IDMEgo(), "idm", SimSettings()), [method], [0])
        with pytest.raises(InputError, match=f"figure=skeleton: {method.name} at eta=0 chose no adversary .*name e2"):
            chain.rollout(scene_set, "idm", tmp_path)
