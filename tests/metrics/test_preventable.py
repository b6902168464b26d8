"""Preventable or not: constructed collisions whose answer is known, and what an answer must not depend on."""

import math

import pytest
import torch

from e2rl.metrics.drivers import DRIVERS, HumanDriver
from e2rl.metrics.preventable import Collision, preventions
from tests.metrics.test_redrive import SIZE, track

STEPS = 80
LANE = 3.5


def cut_in(gap, speed, other_speed, at=10, side=1.0):
    """A vehicle that comes over from the next lane within a second, `gap` m ahead (bumper to bumper) at step `at`."""
    other = track(other_speed, steps=STEPS)
    other[..., 0] += gap + 4.5 + (speed - other_speed) * 0.1 * at
    share = ((torch.arange(STEPS + 1) - at + 5) / 10.0).clamp(0, 1)
    other[0, :, 1] = side * LANE * (1 - share * share * (3 - 2 * share))
    return other


def collision(ego, *others, partner=1):
    """The Collision of an ego with others, at their first contact with the partner."""
    states = torch.stack([ego[0], *(other[0] for other in others)], 1)[None]
    gap = (states[0, :, 0, :2] - states[0, :, partner, :2]).abs()
    touch = (gap[:, 0] < 4.5) & (gap[:, 1] < 2.0)
    assert touch.any()
    stop = touch.int().argmax()[None]
    present = torch.ones(states.shape[:3], dtype=torch.bool)
    return Collision(states, present, SIZE.expand(1, states.shape[2], 2), torch.tensor([partner]), stop)


def human(case):
    return preventions(case, {"human": HumanDriver()})["human"]


def test_a_cut_in_is_preventable_where_there_is_room_to_brake():
    ego = track(14.0)
    near, far = (human(collision(ego, cut_in(gap, 14.0, 6.0))) for gap in (5.0, 14.0))
    assert not near.avoided.any() and far.avoided.all() and not far.followers.any()
    needed = HumanDriver().stopping_gap(torch.tensor(8.0))
    assert 5.0 < needed < 14.0


def test_a_vehicle_that_runs_into_the_ego_from_behind_is_not_the_driver_s_to_prevent():
    rammer = track(15.0, start=(-25.0, 0.0))
    for result in preventions(collision(track(8.0), rammer)).values():
        assert not result.avoided.any()


def follower(gap, speed=14.0):
    return track(speed, start=(-4.5 - gap, 0.0))


@pytest.mark.parametrize("gap, avoided", [(20.0, True), (1.0, False)])
def test_a_follower_that_is_replayed_into_the_driver_brakes_as_competently_as_it_can(gap, avoided):
    case = collision(track(14.0), cut_in(14.0, 14.0, 6.0), follower(gap))
    result = human(case)
    assert result.avoided.item() is avoided
    assert (result.followers > 0).item() is avoided


def test_a_follower_that_is_slower_anyway_is_not_asked():
    result = human(collision(track(14.0), cut_in(14.0, 14.0, 6.0), follower(30.0, speed=5.0)))
    assert result.avoided.all() and not result.followers.any()


@pytest.mark.parametrize("gap, avoided", [(44.0, True), (30.0, False)])
def test_a_second_follower_must_manage_behind_the_first(gap, avoided):
    result = human(collision(track(14.0), cut_in(14.0, 14.0, 6.0), follower(20.0), follower(gap)))
    assert result.avoided.item() is avoided


def test_the_answer_does_not_depend_on_place_heading_mirror_or_order():
    case = collision(track(14.0), cut_in(13.0, 14.0, 6.0), follower(20.0), track(10.0, start=(3.0, -3.5)))
    expected = {name: result.avoided.item() for name, result in preventions(case).items()}
    turn = 0.7
    states = case.states.clone()
    rotation = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    states[..., :2] = states[..., :2] @ rotation.T + torch.tensor([100.0, -40.0])
    states[..., 2] += turn
    mirrored = case.states * torch.tensor([1.0, -1.0, -1.0, 1.0])
    order = torch.tensor([0, 3, 2, 1])
    changed = [
        case._replace(states=states),
        case._replace(states=mirrored),
        case._replace(states=case.states[:, :, order], partner=torch.tensor([3])),
    ]
    for other in changed:
        assert {name: result.avoided.item() for name, result in preventions(other).items()} == expected


def test_a_batch_gives_the_answers_of_its_members():
    cases = [collision(track(14.0), cut_in(gap, 14.0, 6.0), follower(20.0)) for gap in (4.0, 9.0, 14.0)]
    together = preventions(Collision(*(torch.cat(parts) for parts in zip(*cases, strict=True))))
    for name in DRIVERS:
        alone = [preventions(case)[name].avoided.item() for case in cases]
        assert together[name].avoided.tolist() == alone
