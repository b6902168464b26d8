"""Tests of e2rl/search/portfolio.py."""

import torch

from e2rl.search.portfolio import (
    CHANCE_TRIES,
    FAMILY_TRIES,
    LEAST,
    SCENE_TRIES,
    Portfolio,
    nearness,
)
from e2rl.search.tries import Family

SURE = 1000.0  # a chance that draws hardly differ from


def portfolio(
    scenes: int = 2, chance: float = SURE, nfe: tuple[float, ...] = (100.0,)
) -> Portfolio:
    return Portfolio(
        [
            Family(str(k), "e2", ranges={}, chance=chance, nfe=cost)
            for k, cost in enumerate(nfe)
        ],
        scenes,
    )


def mean_worth(found: Portfolio, draws: int = 400) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.stack([found.worth(generator) for _ in range(draws)]).mean(0)


def close(found: float, expected: float) -> bool:
    return abs(found / expected - 1) < 0.01


def test_a_family_is_worth_its_own_chance_and_less_in_a_scene_where_it_failed():
    result = portfolio()
    torch.testing.assert_close(
        mean_worth(result), torch.full((2, 1), SURE).double(), rtol=0.01, atol=0
    )
    result.tell(0, 0, reward=0.0, margin=0.0, nfe=100.0)
    worth = mean_worth(result)
    family = SURE * CHANCE_TRIES / (CHANCE_TRIES + 1)
    after = nearness(torch.tensor(0.0)).item() / (
        (1 + 1 / SCENE_TRIES) * (1 + 1 / FAMILY_TRIES)
    )
    assert close(worth[1].item(), family)
    assert close(worth[0].item(), family * after)


def test_what_a_family_finds_in_one_scene_raises_its_worth_in_all():
    chance = 0.1
    finds = 20
    result = portfolio(chance=chance, nfe=(100.0, 100.0))
    for _ in range(finds):
        result.tell(0, 0, reward=1.0, margin=2.0, nfe=100.0)
    near = nearness(torch.tensor(2.0))
    tries = torch.arange(1, finds)
    exposed = (
        CHANCE_TRIES
        + 1
        + (near / ((1 + tries / SCENE_TRIES) * (1 + tries / FAMILY_TRIES))).sum().item()
    )
    worth = mean_worth(result, 4000)[1]
    assert abs(worth[0].item() / ((CHANCE_TRIES * chance + finds) / exposed) - 1) < 0.05
    assert worth[0] > 2 * worth[1]


def test_late_tries_where_all_others_failed_tell_less_against_a_family_than_first_ones():
    result = portfolio(scenes=20, nfe=(100.0, 100.0))
    for scene in range(10):
        result.tell(scene, 0, reward=0.0, margin=0.0, nfe=100.0)
    for _ in range(10):
        result.tell(10, 1, reward=0.0, margin=0.0, nfe=100.0)
    worth = mean_worth(result)[19]
    assert worth[1] > 1.2 * worth[0]


def test_a_scene_forgets_what_its_tries_told_and_others_do_not():
    result = portfolio(scenes=3)
    for _ in range(20):
        result.tell(0, 0, reward=0.0, margin=0.0, nfe=100.0)
        result.tell(1, 0, reward=0.0, margin=0.0, nfe=100.0)
    result.forget(0)
    worth = mean_worth(result)[:, 0]
    assert close(worth[0].item(), worth[2].item())
    assert worth[1] < 0.05 * worth[0]


def test_a_dear_family_is_worth_less_in_proportion():
    result = portfolio(nfe=(100.0, 400.0))
    worth = mean_worth(result)[0]
    assert close(
        worth[0].item() / worth[1].item(), 4.0 * (1 + 1 / SCENE_TRIES)
    )  # it would be the second, besides
    for _ in range(int(CHANCE_TRIES)):
        result.tell(
            1, 1, reward=0.0, margin=0.0, nfe=200.0
        )  # it costs less than it was said to: 300 in the mean
    worth = mean_worth(result)[0]
    exposed = result.exposed[1].item()
    assert close(
        worth[0].item() / worth[1].item(),
        3.0 * (1 + 1 / SCENE_TRIES) * exposed / CHANCE_TRIES,
    )


def test_tries_of_one_scene_in_a_round_are_worth_less_one_after_another():
    result = portfolio(scenes=1, nfe=(100.0, 110.0, 120.0))
    result.tell(0, 2, reward=0.0, margin=0.0, nfe=120.0)
    share = result.share()[0]
    worth = mean_worth(result)[0]
    alone = (
        share
        * (result.found / result.exposed)
        * 120.0
        / torch.tensor([100.0, 110.0, 120.0])
    )
    rank = torch.tensor([0.0, 1.0, 2.0])
    torch.testing.assert_close(
        worth,
        alone * (1 + 1 / SCENE_TRIES) / (1 + (1 + rank) / SCENE_TRIES),
        rtol=0.02,
        atol=0,
    )


def test_the_nearer_a_scene_came_the_likelier_is_a_find_there():
    margin = torch.linspace(-30, 1, 100)
    near = nearness(margin)
    assert bool((near.diff() >= 0).all())
    assert near[0] == LEAST
    assert near[-1] > 2
    assert nearness(torch.tensor(torch.nan)) == 1
    assert nearness(torch.tensor(0.0)) < 1
    result = portfolio(scenes=3)
    for scene, nearest in enumerate((-30.0, 0.5)):
        result.tell(scene, 0, reward=0.0, margin=nearest, nfe=100.0)
        result.tell(
            scene, 0, reward=0.0, margin=-40.0, nfe=100.0
        )  # the nearest try tells
    worth = mean_worth(result)[:, 0]
    assert close(
        (worth[1] / worth[0]).item(), (nearness(torch.tensor(0.5)) / LEAST).item()
    )


def test_without_learning_nothing_that_was_told_changes_the_choice():
    result = Portfolio(
        [Family("a", "e2", ranges={}), Family("b", "e2", ranges={})], 2, learns=False
    )
    for _ in range(50):
        result.tell(0, 0, reward=1.0, margin=2.0, nfe=100.0)
    torch.testing.assert_close(
        mean_worth(result, 4000), torch.full((2, 2), 0.5).double(), atol=0.03, rtol=0
    )


def test_after_two_tries_in_a_scene_the_next_has_half_the_chance():
    """Of a family that has not been tried there."""
    result = portfolio(nfe=(100.0, 100.0))
    for _ in range(2):
        result.tell(0, 0, reward=0.0, margin=0.0, nfe=100.0)
    near = nearness(torch.tensor(0.0))
    assert close(result.share()[0, 1].item(), near.item() / 2)


def test_after_four_tries_of_a_family_in_a_scene_it_has_half_of_another_s_chance():
    result = portfolio(nfe=(100.0, 100.0))
    for _ in range(4):
        result.tell(0, 0, reward=0.0, margin=0.0, nfe=100.0)
    tried, other = result.share()[0].tolist()
    assert close(tried, other / 2)
