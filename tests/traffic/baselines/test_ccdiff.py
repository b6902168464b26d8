"""CCDiff's risk against closed forms, and who is ranked first."""

import numpy as np
import pytest
import torch

from e2rl.traffic.baselines.ccdiff import ranked, recent_states, risk, top_cliques
from tests.traffic.e2.crossing import make_world

SIZE = torch.tensor([[4.0, 2.0], [4.0, 2.0]])


def scene_of(vehicles):
    """One scene of vehicles (x, y, heading, speed) that came straight on."""
    scene = make_world(vehicles).scene
    scene["past"][..., 0] = -0.1 * scene["start"][:, :8, 3:] * torch.arange(1, 11)
    return scene


def pair(*states):
    return risk(torch.tensor(states), SIZE)


def test_risk_is_the_time_until_the_gap_closes_on_both_axes():
    closing = pair(
        [0.0, 0.0, 0.0, 10.0], [24.0, 0.0, 0.0, 0.0]
    )  # 20 m of gap at 10 m/s, side by side on y
    assert closing[0, 1].item() == pytest.approx((20 - 2) / 20)
    assert torch.equal(closing, closing.T)
    assert (
        pair([0.0, 0.0, 0.0, 0.0], [24.0, 0.0, 0.0, 10.0])[0, 1] == 0
    )  # it drives away
    assert (
        pair([0.0, 0.0, 0.0, 10.0], [24.0, 5.0, 0.0, 0.0])[0, 1] == 0
    )  # a lane that is never left
    follower = pair([0.0, 0.0, 0.0, 0.0], [-24.0, 0.0, 0.0, 10.0])
    assert follower[0, 1].item() == pytest.approx(0.9)  # from behind, too
    assert pair([0.0, 0.0, 0.0, 5.0], [3.0, 1.0, 0.0, 5.0])[0, 1] == 1


def test_the_past_ends_at_the_start():
    scene = scene_of([(0, 0, 0.0, 8.0), (20, 0, 0.7, 5.0)])
    states = recent_states(scene)
    assert states.shape[2] == 11
    torch.testing.assert_close(
        states[:, :2, -1],
        scene["start"][:, :2],
        rtol=1e-4,
        atol=1e-3,
    )
    torch.testing.assert_close(
        states[0, 1, 0, :2],
        torch.tensor([20.0, 0.0]) - 5.0 * torch.tensor([0.7648, 0.6442]),
        rtol=0,
        atol=1e-2,
    )


def test_those_in_cliques_come_first_and_chance_fills_up():
    """The ego and two vehicles close in on each other; a fourth and a fifth are far and
    drive away."""
    vehicles = [
        (0, 0, 0.0, 10.0),
        (30, 0, 0.0, 2.0),
        (60, 0, 3.14159, 8.0),
        (0, 300, 0.0, 10.0),
        (0, -300, 3.1, 10.0),
    ]
    scene = scene_of(vehicles)
    draw = torch.tensor([[0.0, 0.9, 0.8, 0.7, 0.1, 0.5, 0.5, 0.5]])
    assert ranked(scene, 2, draw=draw)[0].nonzero()[:, 0].tolist() == [1, 2]
    assert ranked(scene, 3, draw=draw)[0].nonzero()[:, 0].tolist() == [
        1,
        2,
        4,
    ]  # the least draw
    scene["parked"][:, 1] = True
    assert not ranked(scene, 8, draw=draw)[0, [0, 1, 5, 6, 7]].any()


def cliques_of(*groups):
    """The top cliques of a graph of groups of vehicles, each heavier than the last."""
    adjacency = np.zeros((12, 12), np.uint8)
    weight = np.zeros((12, 12))
    for number, group in enumerate(groups):
        pairs = np.ix_(group, group)
        adjacency[pairs] = 1
        weight[pairs] = 1.0 + number
    np.fill_diagonal(adjacency, 0)
    return top_cliques(adjacency, weight)


def test_pairs_are_no_cliques_that_count():
    assert cliques_of([0, 1]) == []
    assert cliques_of([0, 1, 2]) == [(0, 1, 2)]


def test_the_three_heaviest_cliques_count():
    groups = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]]
    assert cliques_of(*groups) == [(9, 10, 11), (6, 7, 8), (3, 4, 5)]


@pytest.mark.parametrize(("gap", "counts"), [(89.0, True), (111.0, False)])
def test_three_who_meet_within_10_seconds_are_a_clique(gap, counts):
    """A risk above a half: the ego stands, one comes at 10 m/s, a third at 20 m/s."""
    vehicles = [
        (0, 0, 0.0, 0.0),
        (-gap - 4.5, 0, 0.0, 10.0),
        (-2 * gap - 9.0, 0, 0.0, 20.0),
        (0, 300, 0.0, 10.0),
    ]
    draw = torch.tensor([[0.5, 0.5, 0.5, 0.1, 0.5, 0.5, 0.5, 0.5]])
    first = ranked(scene_of(vehicles), 2, draw=draw)[0].nonzero()[:, 0].tolist()
    assert (first == [1, 2]) == counts
