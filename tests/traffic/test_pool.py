"""Rows of recorded, stored and live traffic: joined pools, row probabilities, and what
is refused."""

import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.traffic.pool import LIVE, RECORDED, TrafficPool
from tests.learning.small import brake_check, small_scenes

INDEX = torch.tensor([2, 0, 1])


def stored(eta=2.0):
    return TrafficPool.stored(brake_check(small_scenes())(None, INDEX, eta, 0), eta)


def recorded():
    return TrafficPool.recorded(INDEX)


def live(eta=1.0):
    return TrafficPool.live(INDEX, torch.full((3,), eta), seed=torch.tensor([7, 8, 9]))


def test_joined_rows_keep_their_traffic():
    attack = stored()
    both = attack + recorded() + live()
    other_way = live() + recorded() + attack
    twice = attack + attack
    assert both.source.tolist() == [0, 1, 2] + [RECORDED] * 3 + [LIVE] * 3
    assert other_way.source.tolist() == [LIVE] * 3 + [RECORDED] * 3 + [0, 1, 2]
    assert twice.source.tolist() == list(range(6))
    assert len(twice.parts) == 2
    for pool in (both, other_way):
        assert pool.parts[0] is attack.parts[0], "the tracks are shared"
        assert len(pool) == 9, "the tracks are shared"
        assert torch.equal(pool.scene_index, INDEX.repeat(3))
    assert both.seed.tolist() == [0] * 6 + [7, 8, 9]
    assert both.eta.tolist() == [2.0] * 3 + [0.0] * 3 + [1.0] * 3


def test_tracks_are_gathered_from_the_parts_as_from_one():
    """In any order, with repetition."""
    parts = [stored(eta) for eta in (0.5, 1.0, 2.0)]
    pool = parts[0] + recorded() + parts[1] + live() + parts[2]
    at = torch.tensor([8, 0, 4, 4, 3, 7, 2])
    states, valid = pool.tracks(at)
    assert torch.equal(states, torch.cat([part.parts[0].states for part in parts])[at])
    assert torch.equal(valid, torch.cat([part.parts[0].valid for part in parts])[at])
    assert torch.equal(pool.tracks(pool.source[7:8])[0], parts[1].parts[0].states[1:2])


def test_a_kind_has_its_share_and_its_rows_theirs_by_priority():
    """Scenes 2, 0, 1 by priorities 3, 1, 1."""
    priority = torch.tensor([0.2, 0.2, 0.6])
    probability = (stored() + recorded()).probabilities(priority, 0.8)
    assert probability[:3].tolist() == pytest.approx([0.48, 0.16, 0.16])
    assert probability[3:].tolist() == pytest.approx([0.12, 0.04, 0.04])


@pytest.mark.parametrize("missing", ["scene_index", "states", "valid"])
def test_traffic_that_lacks_something_is_refused(missing):
    traffic = brake_check(small_scenes())(None, INDEX, 2.0, 0)
    del traffic[missing]
    with pytest.raises(InputError, match=missing):
        TrafficPool.stored(traffic, 2.0)


def test_neither_recorded_nor_live_rows_are_positions_in_stored_traffic():
    sources = [set(pool.source.tolist()) for pool in (stored(), recorded(), live())]
    assert sources[0].isdisjoint(sources[1])
    assert sources[0].isdisjoint(sources[2])
    assert sources[1].isdisjoint(sources[2])
