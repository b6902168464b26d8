"""Each misreading is named by plans that are so, and none by sound ones."""

from math import pi

import pytest
import torch

from e2rl.planners.misreadings import misreading
from e2rl.planners.plausibility import plan_faults
from e2rl.scenes.boxes import to_frame
from e2rl.sim import dynamics

STATE = torch.tensor([[[30.0, -12.0, 0.9, 12.0], [5.0, 40.0, -2.1, 9.0]]])
STATES = torch.cat([STATE, STATE + torch.tensor([9.0, 3.0, 0.1, 0.0])])


def plans(first=1, step=1, **action):
    """Plans [2, 2, 50, 4] that begin `first` steps ahead, `step` steps apart."""
    actions = torch.tensor([action.get("acceleration", 0.3), 0.1])
    driven = dynamics.rollout(STATES, actions.expand(2, 2, 300, 2))
    driven = torch.cat([STATES[:, :, None], driven], 2)
    return driven[:, :, first::step][:, :, :50]


def of_the_ego(plan):
    points = to_frame(plan[..., :2], STATES[:, :, None])
    return torch.cat(
        [points, plan[..., 2:3] - STATES[:, :, None, 2:3], plan[..., 3:]], -1
    )


WRONG = {
    "in the frame of the ego": of_the_ego(plans()),
    "of headings in degrees": plans() * torch.tensor([1.0, 1.0, 180 / pi, 1.0]),
    "mirrored: y and headings have the other sign": plans()
    * torch.tensor([1.0, -1.0, -1.0, 1.0]),
    "of headings clockwise from north": plans() * torch.tensor([1.0, 1.0, -1.0, 1.0])
    + torch.tensor([0.0, 0.0, pi / 2, 0.0]),
    "of speeds in km/h": plans() * torch.tensor([1.0, 1.0, 1.0, 3.6]),
    "in coordinates of another origin": plans() + torch.tensor([3e5, 4e6, 0.0, 0.0]),
    "of states from now on": plans(first=0),
    "of states 0.5 s apart": plans(first=5, step=5),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_misreading_is_named(name):
    assert misreading(STATES, WRONG[name]) == name


@pytest.mark.parametrize("acceleration", [-8.0, 0.0, 5.0])
def test_sound_plans_are_none(acceleration):
    assert misreading(STATES, plans(acceleration=acceleration)) is None


def test_a_leap_in_speed_is_of_no_other_unit():
    fast = STATES * torch.tensor([1.0, 1.0, 1.0, 0.0]) + torch.tensor([0.0, 0, 0, 15])
    driven = dynamics.rollout(fast, torch.zeros(2, 2, 50, 2))
    slow = STATES * torch.tensor([1.0, 1.0, 1.0, 0.4])
    assert misreading(slow, driven) is None


def test_what_ends_a_rollout_says_of_what_frame_its_plan_seems():
    plan = WRONG["in coordinates of another origin"]
    (_, why), *_ = plan_faults(STATES[0], plan[0])
    assert "plans seem in coordinates of another origin: shift them" in why
