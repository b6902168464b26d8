"""What no vehicle can drive, each fault from its bound on."""

import pytest
import torch

from e2rl.planners.ego import PLAN_STEPS, track
from e2rl.planners.plausibility import (
    BACKWARDS,
    LARGEST,
    WILD,
    action_faults,
    drivable,
    strays,
)

STATE = torch.tensor([[0.0, 0.0, 0.0, 10.0]])


def plan_at(speed):
    """A plan [1, 50, 4] straight on at a speed."""
    x = 0.1 * speed * torch.arange(1, 51)
    return torch.stack([x, 0 * x, 0 * x, torch.full_like(x, speed)], -1)[None]


@pytest.mark.parametrize(("speed", "expected"), [(49.0, True), (51.0, False)])
def test_plans_drive_50_metres_a_second_at_most(speed, expected):
    assert drivable(STATE, plan_at(speed)).item() == expected


def test_what_comes_after_the_length_of_a_plan_is_not_looked_at():
    plan = plan_at(10.0)
    plan[:, 30:] = torch.nan
    assert drivable(STATE, plan, length=torch.tensor([30])).item()
    assert not drivable(STATE, plan, length=torch.tensor([31])).item()


@pytest.mark.parametrize(
    ("shift", "expected"),
    [
        ((1.9, 0.0, 0.0), False),
        ((2.1, 0.0, 0.0), True),
        ((0.0, 4.9, 0.0), False),
        ((0.0, 5.1, 0.0), True),
        ((0.0, 0.0, 0.95), False),
        ((0.0, 0.0, 1.05), True),
    ],
)
def test_a_plan_begins_near_where_the_ego_will_be(shift, expected):
    """1 m ahead in a step at 10 m/s."""
    first = torch.tensor([[1.0, 0.0, 0.0, 10.0]])
    first[:, :3] += torch.tensor(shift)
    assert strays(STATE, first).item() == expected


@pytest.mark.parametrize(("speed", "expected"), [(0.45, False), (0.55, True)])
def test_who_creeps_may_have_any_heading(speed, expected):
    state = torch.tensor([[0.0, 0.0, 0.0, speed]])
    first = torch.tensor([[0.0, 0.0, 2.0, speed]])
    assert strays(state, first).item() == expected


@pytest.mark.parametrize(
    ("action", "expected"), [((95.0, -95.0), None), ((105.0, 0.0), WILD)]
)
def test_actions_are_at_most_100(action, expected):
    reasons = [
        why
        for wrong, why in action_faults(STATE, plan_at(10.0), torch.tensor([action]))
        if wrong.any()
    ]
    assert reasons == ([expected] if expected else [])


def test_who_plans_to_stand_at_once_brakes():
    state = torch.tensor([[0.0, 0.0, 0.0, 30.0]])
    plan = torch.zeros(1, PLAN_STEPS, 4)
    action = track(state, state, following=plan[:, 0])
    assert action[0, 0] < -LARGEST
    assert not any(wrong.any() for wrong, _ in action_faults(state, plan, action))


def test_a_wild_action_on_a_plan_backwards_is_told_so():
    plan = plan_at(-5.0)
    faults = action_faults(STATE, plan, torch.tensor([[-150.0, 0.0]]))
    wrong, why = next(faults)
    assert wrong.item()
    assert why == BACKWARDS
