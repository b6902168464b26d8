"""Probabilities of collision: what is certain, and what is left out."""

import math

import pytest
import torch

from e2rl.planners.hazard import Prediction, collision_hazard

SIZE = torch.tensor([[4.0, 2.0]])
REACH = math.hypot(4.0, 2.0)  # m between the centres of two cars that touch at corners


def hazard(distance):
    """-log(1 - P) of one pose beside another car, whose centre is so far ahead; w_t is
    1/m."""
    others = Prediction(
        torch.tensor([[[distance, 0.0, 0.0]]]), SIZE, scene=torch.tensor([0])
    )
    return collision_hazard(
        torch.zeros(1, 1, 1, 3), SIZE, others, slope=1.0, growth=0.0
    ).item()


def test_in_contact_the_probability_is_all_but_a_millionth():
    assert hazard(1.0) == pytest.approx(-math.log(1e-6), rel=1e-4)


@pytest.mark.parametrize(("probability", "counts"), [(1.1e-4, True), (0.9e-4, False)])
def test_a_probability_below_a_ten_thousandth_is_left_out(probability, counts):
    """Of circles around the boxes, at the distance at which 1 - tanh(d) is that."""
    distance = REACH + math.atanh(1 - probability)
    assert (hazard(distance) > 0) is counts
