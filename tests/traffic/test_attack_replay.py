"""Attacks that drive as they did: the same against their own planner bit for bit, and the
same traffic for any other."""

import pytest
import torch

from e2rl.planners.log_replay import ReplayEgo
from e2rl.traffic.attack_replay import AttackReplay, AttackTracks
from tests.traffic.e2.traffic_scenes import ROWS, drive, scenes, synthesizer


@pytest.fixture(scope="module")
def attacked():
    return drive(scenes(), synthesizer(), 2.0)


@pytest.fixture(scope="module")
def replay(attacked):
    files = [attacked.rollout(index) for index in range(len(attacked))]
    arrays = {
        name: torch.stack([torch.from_numpy(getattr(file, name)) for file in files])
        for name in ("states", "valid", "adversaries", "routes")
    }
    nats = [attacked.transport_adversary, attacked.transport_others]
    return AttackReplay(AttackTracks(**arrays, nats=torch.stack(nats, 1)))


@pytest.mark.parametrize(
    "column", ["states", "valid", "adversaries", "routes", "ran_light", "contact"]
)
def test_its_own_planner_drives_as_it_did(attacked, replay, column):
    again = drive(scenes(), replay, 0.0)
    assert torch.equal(getattr(again, column), getattr(attacked, column))


def test_the_traffic_is_the_same_for_another_planner(attacked, replay):
    others = drive(scenes(), replay, 0.0, ego=ReplayEgo())
    valid = attacked.valid[:, :, 1:]
    assert torch.equal(others.valid[:, :, 1:], valid)
    expected = attacked.states[:, :, 1:][valid]
    assert torch.equal(others.states[:, :, 1:][valid], expected)


@pytest.mark.parametrize("column", ["transport_adversary", "transport_others"])
def test_it_has_the_nats_of_the_attack(attacked, replay, column):
    again = drive(scenes(), replay, 0.0)
    expected = getattr(attacked, column)
    assert expected.sum() > 0 or column == "transport_others"
    torch.testing.assert_close(getattr(again, column), expected)


def test_the_seed_is_the_number_of_the_attack(attacked, replay):
    turned = drive(scenes(), replay, 0.0, seeds=[2, 2, 2])
    driven = slice(1, None)  # steps: the start is the scene's
    vehicles = slice(1, ROWS)
    valid = attacked.valid[2, driven, vehicles]
    expected = attacked.states[2, driven, vehicles][valid]
    for states in turned.states:
        assert torch.equal(states[driven, vehicles][valid], expected)
