"""Boxes that pass through each other in a step: the same as a fine look at where they
are in between."""

import math
from types import SimpleNamespace

import pytest
import torch

from e2rl.scenes.boxes import separation
from e2rl.sim.neighbours import neighbours_of, passed, rotation_into
from e2rl.sim.passing import is_fast, time_inside
from e2rl.sim.world import Agents, Tracks

FINE = 400  # moments of a step that are looked at


def random_steps(count, generator):
    """Offset, change, turn of `count` boxes past a box, and half sizes of both."""

    def draw(low, high):
        return low + (high - low) * torch.rand(
            count,
            generator=generator,
            dtype=torch.float64,
        )

    offset = torch.stack([draw(-8, 8), draw(-5, 5)])
    change = torch.stack([draw(-9, 9), draw(-6, 6)])
    return (
        offset,
        change,
        draw(-math.pi, math.pi),
        torch.stack([draw(1, 3), draw(0.4, 1)]),
    )


def test_the_interval_is_that_of_a_fine_look():
    generator = torch.Generator().manual_seed(0)
    offset, change, turn, other = random_steps(3000, generator)
    ours = torch.tensor([[2.3], [0.95]], dtype=torch.float64).expand(2, 3000)
    begin, end = time_inside(
        offset,
        change,
        direction=torch.stack([turn.cos(), turn.sin()]),
        own=ours,
        other=other,
    )
    time = torch.linspace(0, 1, FINE + 1, dtype=torch.float64)
    place = offset[..., None] + change[..., None] * time
    box = torch.stack(
        [*place, turn[:, None].expand(-1, FINE + 1), torch.zeros(3000, FINE + 1)], -1
    )
    still = torch.zeros(4, dtype=torch.float64)
    gap = separation(
        still,
        2 * ours.T[:, None],
        second=box,
        second_size=2 * other.T[:, None],
    )
    inside = (gap < 0).any(1)
    assert torch.equal(inside | ((gap.amin(1) < 0.02) & (begin < end)), begin < end)
    first = time[(gap < 0).int().argmax(1)]
    assert (first - begin)[inside].abs().max() < 1.5 / FINE
    assert 300 < inside.sum() < 2700


def test_what_moves_no_farther_than_half_of_the_smallest_extent_is_not_looked_at():
    ours = torch.tensor([[2.0], [1.0]])
    other = torch.tensor([[2.0], [0.4]])
    assert not is_fast(torch.tensor([[0.3], [0.2]]), ours, other=other).any()
    assert is_fast(torch.tensor([[0.3], [0.3]]), ours, other=other).all()


@pytest.mark.parametrize(
    ("lateral", "known", "hits"),
    [(0.0, True, True), (0.0, False, False), (2.0, True, False)],
)
def test_a_neighbour_that_has_passed_is_where_it_touched(lateral, known, hits):
    """Head-on at 78 m/s: from 4.2 m before the ego to 3.6 m behind it. Who was not
    there did not pass."""
    ego_before = torch.tensor([[0.0, 0.0, 0.0, 38.0]])
    ego = torch.tensor([[3.8, 0.0, 0.0, 38.0]])
    before = torch.tensor([[[4.2, lateral, math.pi, 40.0]]])
    current = before - torch.tensor([4.0, 0.0, 0.0, 0.0])
    size = torch.tensor([[4.0, 1.9]])
    still = torch.zeros(1, 1)
    half = torch.tensor([[[1.1], [0.4]]])
    agents = Agents(
        current,
        still == 0,
        accel=still,
        turn_rate=still,
    )
    first = torch.zeros(1, 1, dtype=torch.int64)
    static = SimpleNamespace(
        size=size,
        half_size=half,
        row=first,
    )
    near = neighbours_of(
        ego,
        rotation_into(ego),
        static=static,
        agents=agents,
    )
    tracks = torch.stack(
        [torch.cat([ego[:, None], at], 1) for at in (before, current)], 1
    )
    place = torch.tensor([[[True, known], [True, True]]])
    result = passed(
        near,
        ego=ego,
        ego_before=ego_before,
        tracks=Tracks(tracks, place),
        static=static,
        before=first[0],
    )
    assert (near.gap > 0).all()
    assert bool((result.gap < 0).all()) == hits
    if hits:
        assert result.position[0, :, 0].tolist() == pytest.approx([3.1, 0.0], abs=1e-4)
    else:
        assert torch.equal(result.gap, near.gap)
        assert torch.equal(result.position, near.position)


def tiny_pass(displacement, speed, past):
    """Whether the ego, which stands, is passed by a box of its size, 10 cm, that moves
    `displacement` m along x to `past` m behind the ego's centre, at `speed` m/s."""
    (passes,) = tiny_passes(displacement, [speed], past=past)
    return passes


def tiny_passes(displacement, speeds, past):
    """`tiny_pass` for each of several egos, at once."""
    count = len(speeds)
    ego = torch.zeros(count, 4)
    agent = torch.tensor([[[past, 0.0, 0.0, speed]] for speed in speeds])
    before = agent - torch.tensor([displacement, 0.0, 0.0, 0.0])
    still = torch.zeros(count, 1)
    static = SimpleNamespace(
        size=torch.full((count, 2), 0.1),
        half_size=torch.full((count, 2, 1), 0.05),
        row=torch.arange(count)[:, None],
    )
    agents = Agents(
        agent,
        still == 0,
        accel=still,
        turn_rate=still,
    )
    near = neighbours_of(
        ego,
        rotation_into(ego),
        static=static,
        agents=agents,
    )
    states = torch.stack(
        [torch.cat([ego[:, None], at], 1) for at in (before, agent)], 1
    )
    tracks = Tracks(states, torch.ones_like(states[..., 0], dtype=torch.bool))
    result = passed(
        near,
        ego=ego,
        ego_before=ego,
        tracks=tracks,
        static=static,
        before=torch.zeros(count, dtype=torch.int64),
    )
    return (result.gap[:, 0] < 0).tolist()


def test_each_ego_is_passed_by_its_own_neighbours():
    speeds = [1.9, 2.1, 1.9, 3.0]
    assert tiny_passes(0.25, speeds, past=0.12) == [False, True, False, True]


@pytest.mark.parametrize(("speed", "looked_at"), [(1.9, False), (2.1, True)])
def test_who_is_slower_than_half_a_pedestrian_in_a_step_is_not_looked_at(
    speed, looked_at
):
    assert (
        tiny_pass(
            0.25,
            speed=speed,
            past=0.12,
        )
        == looked_at
    )


@pytest.mark.parametrize(("past", "looked_at"), [(1.55, True), (1.65, False)])
def test_who_is_farther_than_half_as_much_again_as_it_moves_is_not_looked_at(
    past, looked_at
):
    """At 10 m/s: 1 m in a step; gaps of 1.45 and 1.55 m."""
    assert (
        tiny_pass(
            3.0,
            speed=10.0,
            past=past,
        )
        == looked_at
    )
