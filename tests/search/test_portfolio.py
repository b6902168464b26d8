"""Tests of e2rl/search/portfolio.py."""

import torch

from e2rl.search.portfolio import LEAST, Portfolio
from e2rl.search.tries import Family

NEAR = 2.0  # a margin of a scene whose tries are not discounted


def portfolio(scenes: int = 2, chance: float = 0.1, nfe: tuple[float, ...] = (100.0, 100.0)) -> Portfolio:
    return Portfolio([Family(str(k), "e2", {}, chance=chance, nfe=cost) for k, cost in enumerate(nfe)], scenes)


def mean_worth(found: Portfolio, draws: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.stack([found.worth(generator) for _ in range(draws)]).mean(0)


def test_a_family_is_worth_its_own_chance_and_half_of_it_in_a_scene_where_it_failed_once():
    found = portfolio(chance=0.2)
    torch.testing.assert_close(mean_worth(found), torch.full((2, 2), 0.2).double(), atol=0.02, rtol=0)
    found.tell(0, 0, 0.0, NEAR, 100.0)
    worth, family = mean_worth(found), 0.2 * 20 / 21
    torch.testing.assert_close(worth[:, 0], torch.tensor([family / 2, family]).double(), atol=0.02, rtol=0)


def test_what_a_family_finds_in_one_scene_raises_its_worth_in_all_and_there_the_most():
    found = portfolio()
    for _ in range(20):
        found.tell(0, 0, 1.0, NEAR, 100.0)
    worth = mean_worth(found)
    expected = (0.1 * 20 + 20) / (20 + 20)  # of the other scene
    torch.testing.assert_close(worth[1, 0].item(), expected, atol=0.03, rtol=0)
    assert worth[0, 0] > worth[1, 0] > worth[1, 1]


def test_a_scene_forgets_what_its_tries_told_and_others_do_not():
    found = portfolio()
    for _ in range(20):
        found.tell(0, 0, 0.0, NEAR, 100.0)
        found.tell(1, 0, 0.0, NEAR, 100.0)
    found.forget(0)
    worth = mean_worth(found)
    torch.testing.assert_close(worth[0, 0].item(), 0.1 * 20 / (20 + 40), atol=0.01, rtol=0)
    assert worth[1, 0] < 0.2 * worth[0, 0]


def test_a_dear_family_is_worth_less_in_proportion():
    worth = mean_worth(portfolio(nfe=(100.0, 400.0)))
    torch.testing.assert_close(worth[:, 0] / worth[:, 1], torch.full((2,), 4.0).double(), atol=0.4, rtol=0)


def test_a_scene_in_which_nobody_comes_near_is_worth_the_least_share():
    found = portfolio(scenes=3)
    found.tell(0, 1, 0.0, -30.0, 100.0)
    found.tell(1, 1, 0.0, 0.5, 100.0)
    worth = mean_worth(found)[:, 0]
    torch.testing.assert_close(worth / worth[2], torch.tensor([LEAST, 0.625, 1.0]).double(), atol=0.06, rtol=0)
