"""CAT picks the future of greatest overlap with the ego's tracks."""

import pytest
import torch

from e2rl.traffic.baselines import cat
from e2rl.traffic.baselines.cat import overlap_value
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes

DECAY = 0.99  # of a contact's worth, a step
SIZE = torch.tensor([[[4.0, 2.0], [4.0, 2.0]]])


def standing(x):
    """States [50, 4] at x."""
    return torch.tensor([x, 0.0, 0.0, 0.0]).repeat(50, 1)


def driving(x, speed):
    states = standing(x)
    states[:, 0] += 0.1 * speed * torch.arange(1, 51)
    states[:, 3] = speed
    return states


def test_overlap_is_worth_more_the_sooner_and_the_more_often_it_comes():
    ways = torch.stack([driving(0.0, 10.0), driving(0.0, 5.0)])[
        :, None
    ]  # two ways of the ego
    futures = torch.stack([standing(x) for x in (500.0, 40.0, 20.0)])[
        :, None, None
    ].repeat(1, 1, 2, 1, 1)
    value = overlap_value(futures, ways, size=SIZE)[:, 0, 1]
    assert value[0] == 0
    assert value[1].item() == pytest.approx(
        DECAY**38 / 2
    )  # the faster way alone gets there: beyond 36 m after 3.6 s
    assert value[2].item() == pytest.approx((DECAY**18 + DECAY**34) / 2)


def test_the_vehicle_and_the_future_of_greatest_value_are_driven(monkeypatch):
    on = baseline(
        "cat",
        tracks=1,
        gain=2.0,
    )  # four candidates at eta = 2
    (current, context), _ = first_replan(on, scenes(2).scenes)
    values = torch.zeros(8, 2, 8)
    values[2, 0, 3], values[1, 0, 1], values[6, 0, 2] = (
        0.5,
        0.4,
        0.9,
    )  # the seventh is not tried
    values[1, 1, 5] = 0.9  # a parked vehicle
    monkeypatch.setattr(cat, "overlap_value", lambda *_, size: values)
    state, x0 = on.attack(current, context)
    assert state.adversary.nonzero().tolist() == [[0, 3]]
    assert torch.equal(state.held, state.adversary)
    nominal = on.prior.sample(context, current.noise[..., 0, :].contiguous()).x0
    same = (x0 == nominal).all(-1)
    assert not same[0, 3]
    assert same[1].all()
    assert same[0].sum() == 7
