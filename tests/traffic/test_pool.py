"""Rows of recorded, stored and live traffic: joined pools, row probabilities, and what is refused."""

import pytest
import torch

from e2rl.errors import InputError
from e2rl.traffic.pool import LIVE, RECORDED, TrafficPool
from tests.learning.small import brake_check, small_scenes

INDEX = torch.tensor([2, 0, 1])


def stored(eta=2.0):
    return TrafficPool.stored(brake_check(small_scenes())(None, INDEX, eta, 0), eta)


def recorded():
    return TrafficPool.recorded(INDEX)


def live(eta=1.0):
    return TrafficPool.live(INDEX, torch.full((3,), eta), torch.tensor([7, 8, 9]))


def test_joined_rows_keep_their_traffic():
    attack = stored()
    both, other_way, twice = attack + recorded() + live(), live() + recorded() + attack, attack + attack
    assert both.source.tolist() == [0, 1, 2] + [RECORDED] * 3 + [LIVE] * 3
    assert other_way.source.tolist() == [LIVE] * 3 + [RECORDED] * 3 + [0, 1, 2]
    assert twice.source.tolist() == list(range(6)) and len(twice.states) == len(twice.adversaries) == 6
    for pool in (both, other_way):
        assert torch.equal(pool.states, attack.states) and len(pool) == 9
        assert torch.equal(pool.scene_index, INDEX.repeat(3))
    assert both.seed.tolist() == [0] * 6 + [7, 8, 9] and both.eta.tolist() == [2.0] * 3 + [0.0] * 3 + [1.0] * 3


def test_rows_with_an_intensity_are_adversarial():
    pool = stored() + recorded() + live(1.0) + live(0.0) + stored(0.0)
    assert pool.adversarial.tolist() == [True] * 3 + [False] * 3 + [True] * 3 + [False] * 6


def test_probabilities_split_by_share_then_by_priority():
    priority = torch.tensor([0.5, 0.25, 0.25, 0.0])
    for attack in (stored(), live()):
        probability = (attack + recorded()).probabilities(priority, 0.8)
        assert probability[:3].tolist() == pytest.approx([0.2, 0.4, 0.2])
        assert probability[3:].tolist() == pytest.approx([0.05, 0.1, 0.05])
        assert attack.probabilities(priority, 0.0).sum().item() == pytest.approx(1.0), "the only kind takes all"


@pytest.mark.parametrize("missing", ["scene_index", "states", "valid", "adversaries"])
def test_traffic_that_lacks_something_is_refused(missing):
    traffic = brake_check(small_scenes())(None, INDEX, 2.0, 0)
    del traffic[missing]
    with pytest.raises(InputError, match=missing):
        TrafficPool.stored(traffic, 2.0)
