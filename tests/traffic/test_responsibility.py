"""The yielding rule: who gives way to the ego, and who waits before it does."""

import math

import pytest
import torch

from e2rl.traffic.responsibility import YieldingSettings, duty_of, followed, leading
from tests.traffic.e2.crossing import make_world

EGO = (0.0, 0.0, 0.0, 12.0)


def world_of(*cars):
    world = make_world([EGO, *cars])
    vehicles = world.scene["route_log"].shape[1]
    coalition = torch.zeros(1, vehicles, dtype=torch.bool)
    coalition[0, 1 : len(cars) + 1] = True
    return world, coalition


def test_in_its_track_ahead_it_is_followed_and_beside_it_leads_only():
    world, _ = world_of(
        (20.0, 0.0, 0.0, 10.0),
        (20.0, 3.5, 0.0, 10.0),
        (-20.0, 0.0, 0.0, 10.0),
        (20.0, 0, math.pi, 9.0),
    )
    assert followed(world, 5)[0].tolist() == [False, True, False, False, False]
    assert leading(world, 5)[0].tolist() == [False, True, True, False, False]


def test_all_but_those_that_the_ego_follows_give_way_and_only_those_ahead_of_it_wait():
    ahead = (8, 0, 0, 2.0)
    rammer = (-12, 0, 0, 20.0)
    beside = (0, 6, 0, 12.0)
    oncoming = (40, 0, math.pi, 8.0)
    world, coalition = world_of(ahead, rammer, beside, oncoming)
    duty = duty_of(
        "full",
        YieldingSettings(),
        world=world,
        coalition=coalition,
        eta=torch.tensor([2.0]),
    )
    assert duty.exempt[0, 1:5].tolist() == [True, False, False, False]
    assert torch.equal(duty.yields, coalition & ~duty.exempt)
    assert duty.patience[0, :5].tolist() == [0.0, 2.0, 0.0, 0.0, 2.0], (
        "who is not ahead of the ego brakes at once"
    )


def test_who_crosses_from_the_left_gives_way_at_once():
    from_left = (20, 20, -math.pi / 2, 8.0)
    from_right = (20, -20, math.pi / 2, 8.0)
    oncoming = (40, 0, math.pi, 8.0)
    world, coalition = world_of(from_left, from_right, oncoming)
    duty = duty_of(
        "full",
        YieldingSettings(),
        world=world,
        coalition=coalition,
        eta=torch.tensor([2.0]),
    )
    assert duty.patience[0, 1:4].tolist() == [0.0, 2.0, 2.0]


def test_patience_grows_with_intensity_up_to_its_bound():
    world, coalition = world_of((40.0, 0.0, math.pi, 8.0))
    settings = YieldingSettings(patience=1.5, max_patience=2.5)
    result = [
        duty_of(
            "full", settings, world=world, coalition=coalition, eta=torch.tensor([eta])
        ).patience[0, 1]
        for eta in (0.5, 1, 2, 3)
    ]
    assert result == [0.75, 1.5, 2.5, 2.5]


@pytest.mark.parametrize(
    "responsibility, exempt", [("none", [True, True]), ("rear", [True, False])]
)
def test_less_responsibility_binds_only_those_behind_or_nobody(responsibility, exempt):
    world, coalition = world_of((15.0, 4.0, 0.0, 10.0), (-15.0, 0.0, 0.0, 14.0))
    duty = duty_of(
        responsibility,
        YieldingSettings(),
        world=world,
        coalition=coalition,
        eta=torch.tensor([2.0]),
    )
    assert duty.exempt[0, 1:3].tolist() == exempt
    assert not duty.yields.any()
    assert not duty.patience.any()


def test_by_default_patience_is_1_m_s2_per_intensity_up_to_2():
    world, coalition = world_of((40.0, 0.0, math.pi, 8.0))
    result = [
        duty_of(
            "full",
            YieldingSettings(),
            world=world,
            coalition=coalition,
            eta=torch.tensor([eta]),
        ).patience[0, 1]
        for eta in (0.5, 1.5, 3.0)
    ]
    assert result == [0.5, 1.5, 2.0]
