"""A contact is of the ego's own making where it moves and its front, or a standing agent, is hit."""

import math

import pytest
import torch

from e2rl.sim.neighbours import neighbours_of, own_fault, rotation_into
from e2rl.sim.world import Agents

SIZE = torch.tensor([[4.0, 2.0]])


def judged(ego, others):
    """Of egos [B, 4] among agents [B, M, 4], all of one size."""
    half = SIZE.T[None].expand(len(ego), 2, others.shape[1]) / 2
    still = torch.zeros(others.shape[:2])
    agents = Agents(others, still == 0, still, still)
    near = neighbours_of(ego, rotation_into(ego), SIZE.expand(len(ego), 2), half, agents)
    return own_fault(ego[:, 3], near, near.gap < 0, SIZE.expand(len(ego), 2), half)


@pytest.mark.parametrize(
    ("place", "speed", "other_speed", "expected"),
    [
        ((3.8, 0.0), 5.0, 3.0, True),  # ahead
        ((-3.8, 0.0), 5.0, 8.0, False),  # at the rear
        ((0.0, 1.9), 5.0, 5.0, False),  # beside
        ((0.0, 1.9), 5.0, 0.0, True),  # beside, and standing
        ((3.8, 0.0), 0.05, 3.0, False),  # the ego stands
        ((4.5, 0.0), 5.0, 3.0, False),  # no contact
    ],
)
def test_own_fault_by_place_and_speed(place, speed, other_speed, expected):
    for heading in (0.0, 2.0):  # whichever way the ego looks
        cos, sin = math.cos(heading), math.sin(heading)
        there = torch.tensor([[cos, -sin], [sin, cos]]) @ torch.tensor(place) + torch.tensor([10.0, -5.0])
        ego = torch.tensor([[10.0, -5.0, heading, speed]])
        others = torch.tensor([[[*there.tolist(), heading, other_speed], [60.0, 60.0, 0.0, 5.0]]])
        assert judged(ego, others).tolist() == [expected]


def test_no_other_agent_no_fault():
    assert judged(torch.tensor([[0.0, 0.0, 0.0, 5.0]]), torch.zeros(1, 0, 4)).tolist() == [False]
