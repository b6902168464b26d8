"""The choice among joint samples, and its price."""

import pytest
import torch

from e2rl.prior.lane_relative import SIZE
from e2rl.traffic.e2.choice import best_try, choice_nats, joint_tries
from e2rl.traffic.e2.kernels import Kernels


def test_the_prices_of_a_choice_are_those_of_a_law_over_the_samples():
    """A code is one: the weights exp(-price) of a scene's samples sum to 1, and no
    choice has no price."""
    price = choice_nats(torch.tensor([1]), 2, count=5)
    assert price.shape == (7,)
    assert price[0] == 0
    assert float((-price[1:]).exp().sum()) == pytest.approx(1.0)


def test_the_best_of_a_scene_s_tries_is_taken_and_the_plain_one_where_there_are_no_others():
    vehicle = torch.tensor([[-1, -1], [2, 1], [-1, -1], [3, -1]])
    kernels = Kernels(
        torch.arange(8.0).view(4, 2, 1).expand(4, 2, SIZE), vehicle, vehicles=5
    )
    rows = torch.tensor([1, 3])
    samples = joint_tries(kernels, rows)
    assert samples.scenes.tolist() == [0, 1, 2, 3, 1, 1, 3, 3]
    assert samples.drawn.nonzero().tolist() == [[4, 2], [5, 1], [6, 3]]
    assert samples.goal[4:, 0, 0].tolist() == [2.0, 3.0, 6.0, 7.0]
    value = torch.tensor([9.0, 1.0, 0.0, 5.0, 2.0, 3.0, 4.0, 5.0])
    assert best_try(value, rows, batch=4).tolist() == [0, 5, 2, 3]
    assert best_try(value[:4], rows[:0], batch=4).tolist() == [0, 1, 2, 3]


def test_drawn_samples_have_a_tenth_of_the_weight_together():
    price = choice_nats(torch.tensor([0]), 1, count=5)
    assert float((-price[1:]).exp().sum()) == pytest.approx(0.1)
