"""Row probabilities, joined pools, and what is refused."""

import pytest
import torch
from e2rl.learning.pool import RECORDED, TrafficPool

from e2rl.errors import InputError
from tests.learning.small import brake_check, small_scenes


def pools(index=(2, 0, 1)):
    scenes = small_scenes()
    index = torch.tensor(index)
    attack = TrafficPool.synthesized(brake_check(scenes)(None, index, 2.0, 0), adversarial=True)
    return attack, TrafficPool.recorded(index)


def test_joined_rows_keep_their_traffic():
    attack, recorded = pools()
    both, other_way, twice = attack + recorded, recorded + attack, attack + attack
    assert both.traffic.tolist() == [0, 1, 2] + [RECORDED] * 3
    assert other_way.traffic.tolist() == [RECORDED] * 3 + [0, 1, 2]
    assert twice.traffic.tolist() == list(range(6)) and len(twice.states) == 6
    assert both.adversarial.tolist() == [True] * 3 + [False] * 3 and len(both) == 6


def test_probabilities_split_by_share_then_by_priority():
    attack, recorded = pools()
    priority = torch.tensor([0.5, 0.25, 0.25, 0.0])
    probability = (attack + recorded).probabilities(priority, 0.8)
    assert probability[:3].tolist() == pytest.approx([0.2, 0.4, 0.2])
    assert probability[3:].tolist() == pytest.approx([0.05, 0.1, 0.05])
    assert attack.probabilities(priority, 0.0).sum().item() == pytest.approx(1.0), "the only kind takes all"


def test_traffic_without_states_is_refused():
    with pytest.raises(InputError, match="states"):
        TrafficPool.synthesized({"scene_index": torch.arange(2), "valid": torch.ones(2, 3)}, True)
