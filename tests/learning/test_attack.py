"""The traffic of a round: whoever makes which part of it, it is the same."""

import pytest
import torch

from e2rl.learning.attack import Order, make_traffic
from e2rl.learning.solvability import unsearched
from e2rl.traffic.template import FULL
from tests.learning.small import brake_check, small_scenes

SCENES = torch.tensor([3, 0, 4, 1, 2])
ETA = torch.tensor([0.5, 2.0, 0.0, 3.0, 1.5])


def odd_ones_left_out(traffic):
    solved = unsearched(traffic["states"])
    return solved._replace(kept=traffic["scene_index"] % 2 == 0, span=traffic["scene_index"][:, None].repeat(1, 2))


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_are_joined_in_the_order_of_the_scenes(nominal, batch):
    order = Order(0, SCENES, ETA, torch.full_like(SCENES, FULL), 7, None)
    traffic = make_traffic(order, brake_check(small_scenes(5)), odd_ones_left_out, nominal, batch)
    kept = [0, 4, 2]
    every = kept + SCENES.tolist() * nominal
    assert traffic["scene_index"].tolist() == every and traffic["kept"].tolist() == (SCENES % 2 == 0).tolist()
    assert traffic["eta"].tolist() == [2.0, 0.0, 1.5] + [0.0] * (len(every) - 3)
    assert traffic["span"][:3, 0].tolist() == kept and not traffic["span"][3:].any()
    assert traffic["attacked"] == 4 / 5 and traffic["contact"] == 3 / 5  # of all that were attacked
    whole = make_traffic(order, brake_check(small_scenes(5)), odd_ones_left_out, nominal)
    assert all(torch.equal(traffic[name], whole[name]) for name in whole) and set(traffic) == set(whole)


def test_templates_are_given_by_scene_and_to_the_attack_alone():
    given = []

    def synthesize(ego, index, eta, seed, *template):
        given.append((index.tolist(), [part.tolist() for part in template]))
        return brake_check(small_scenes(5))(ego, index, eta, seed)

    order = Order(0, SCENES, ETA, torch.tensor([0, 0, 0, 1, 0]), 7, None)
    make_traffic(order, synthesize, batch=3)
    assert given == [([3, 0, 4], [[0, 0, 0]]), ([1, 2], [[1, 0]]), ([3, 0, 4], []), ([1, 2], [])]
