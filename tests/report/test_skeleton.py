"""The selection of the skeleton figure: the longest chain of a run."""

import torch

from e2rl.driving.setup import Method
from e2rl.report.skeleton import LongestChain, link_risk
from e2rl.traffic.e2.skeleton import Selection
from e2rl.traffic.e2.topology import TopologySettings
from tests.traffic.e2.traffic_scenes import synthesizer


def selection(*targets, seed=0, risk=0.5):
    """Scenes of whose vehicles each acts on its target (-1: on nobody), every pair of
    the same risk at two moments."""
    target = torch.tensor(targets)
    count, vehicles = target.shape
    weights = torch.full((count, 2, vehicles, vehicles), risk)
    moments = torch.tensor([[0.1, 0.6]]).expand(count, 2)
    acts = target >= 0
    what = (
        torch.arange(count) + seed,
        torch.zeros(count).long(),
        torch.zeros(count, 2, vehicles, 4),
        moments,
        weights,
    )
    return Selection(*what, acts, acts, acts, target, TopologySettings())


def test_links_then_members_then_risk_decide_and_the_first_of_equals_stays():
    chain = LongestChain(Method("e2", synthesizer(), eta=2.0))
    chain(selection([-1, -1, -1, -1]))
    assert chain.selection is None
    for given, seed in (
        (selection([-1, 0, -1, -1], [-1, 0, 0, -1]), 1),
        (selection([-1, 0, 0, -1], seed=10), 1),
        (selection([-1, 0, 0, -1], seed=20, risk=0.9), 20),
        (selection([-1, 0, 0, 0], [-1, 0, 1, -1], seed=30), 31),
        (selection([-1, 0, 0, 0], seed=40), 31),
    ):
        chain(given)
        assert chain.selection.seed.tolist() == [seed]
        assert len(chain.selection.target) == 1


def test_the_risk_of_links_is_that_of_each_member_with_its_target():
    given = selection([-1, 0, 1, -1])
    given.weights[0, 1, 1, 0], given.weights[0, 1, 2, 1], given.weights[0, 1, 2, 0] = (
        0.7,
        0.2,
        0.99,
    )
    torch.testing.assert_close(link_risk(given), torch.tensor([[1.0, 0.9]]))
