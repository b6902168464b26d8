"""A contact is of the ego's own making where it moves and its front, or an agent that
has stood, is hit."""

import math
from types import SimpleNamespace

import pytest
import torch

from e2rl.sim.neighbours import neighbours_of, own_fault, rotation_into
from e2rl.sim.world import Agents, Tracks

SIZE = torch.tensor([[4.0, 2.0]])
STOOD = 20  # steps: two seconds (UK Highway Code, rule 126)


def judged(
    ego,
    others,
    since=0,
    vehicle=True,
    steps=40,
):
    """Of egos [B, 4] among agents [B, M, 4], all of one size; the first of them have
    had their speed since a step."""
    count, agents = others.shape[:2]
    half = SIZE.T[None].expand(count, 2, agents) / 2
    still = torch.zeros(count, agents)
    static = SimpleNamespace(
        size=SIZE.expand(count, 2),
        half_size=half,
        vehicle=torch.full((count, agents), vehicle),
        row=torch.arange(count)[:, None],
    )
    near = neighbours_of(
        ego,
        rotation_into(ego),
        static=static,
        agents=Agents(
            others,
            still == 0,
            accel=still,
            turn_rate=still,
        ),
    )
    states = torch.cat([ego[:, None], others], 1)[:, None].repeat(1, steps + 1, 1, 1)
    states[:, :since, 1:2, 3] = 6.0
    tracks = Tracks(states, torch.ones_like(states[..., 0], dtype=torch.bool))
    return own_fault(
        ego[:, 3],
        near,
        hit=near.gap < 0,
        static=static,
        tracks=tracks,
        before=torch.full((count,), steps),
    ).tolist()


@pytest.mark.parametrize(
    ("place", "speed", "other_speed", "expected"),
    [
        ((3.8, 0.0), 5.0, 3.0, True),  # ahead
        ((-3.8, 0.0), 5.0, 8.0, False),  # at the rear
        ((0.0, 1.9), 5.0, 5.0, False),  # beside
        ((0.0, 1.9), 5.0, 0.0, True),  # beside, and standing
        ((3.8, 0.0), 0.05, 3.0, False),  # the ego stands
        ((4.5, 0.0), 5.0, 3.0, False),  # no contact
        ((-3.8, 0.0), -2.0, -1.0, True),  # behind an ego that reverses
        ((3.8, 0.0), -2.0, 3.0, False),  # at its trailing front
        ((3.8, 0.0), 5.0, -2.0, True),  # ahead, and reversing
        ((0.0, 1.9), 5.0, -2.0, False),  # beside, and reversing: it does not stand
        ((0.0, 1.9), 5.0, 0.09, True),  # slower than a decimetre a second: it stands
        ((0.0, 1.9), 5.0, 0.11, False),
    ],
)
def test_own_fault_by_place_and_speed(
    place,
    speed,
    other_speed,
    expected,
):
    for heading in (0.0, 2.0):  # whichever way the ego looks
        cos = math.cos(heading)
        sin = math.sin(heading)
        position = torch.tensor([[cos, -sin], [sin, cos]]) @ torch.tensor(
            place
        ) + torch.tensor([10.0, -5.0])
        ego = torch.tensor([[10.0, -5.0, heading, speed]])
        others = torch.tensor(
            [[[*position.tolist(), heading, other_speed], [60.0, 60.0, 0.0, 5.0]]]
        )
        assert judged(ego, others) == [expected]


@pytest.mark.parametrize(
    ("since", "vehicle", "expected"),
    [
        (40 - STOOD, True, True),  # for two seconds
        (41 - STOOD, True, False),  # a step less
        (40, True, False),  # it has just stopped, as one that swerves in and stops
        (40, False, True),  # a pedestrian has just stopped
    ],
)
def test_what_the_front_hits_must_have_stood(since, vehicle, expected):
    ego = torch.tensor([[0.0, 0.0, 0.0, 5.0]])
    others = torch.tensor([[[3.8, 0.0, 0.0, 0.0]]])
    assert judged(
        ego,
        others,
        since=since,
        vehicle=vehicle,
    ) == [expected]


def test_who_stands_since_the_start_has_stood():
    ego = torch.tensor([[0.0, 0.0, 0.0, 5.0]])
    others = torch.tensor([[[3.8, 0.0, 0.0, 0.0]]])
    assert judged(ego, others, steps=3) == [True]
    assert judged(
        ego,
        others,
        since=1,
        steps=3,
    ) == [False]


def test_no_other_agent_no_fault():
    assert judged(torch.tensor([[0.0, 0.0, 0.0, 5.0]]), torch.zeros(1, 0, 4)) == [False]
