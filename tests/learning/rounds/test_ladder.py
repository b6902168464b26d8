"""The mix of two attacks of which a wanted fraction hits."""

import pytest
import torch

from e2rl.learning.rounds.ladder import Ladder

COUNT = 100_000


def seen(*rates, hits=0.35):
    """A ladder that has met so many attacks of each kind that their rates are known."""
    ladder = Ladder(hits)
    attack = torch.arange(2).repeat_interleave(COUNT)
    hit = torch.cat([torch.arange(COUNT) < rate * COUNT for rate in rates])
    ladder.observe(attack, hit)
    return ladder


@pytest.mark.parametrize(
    ("rates", "share"),
    [((0.05, 0.65), 0.5), ((0.35, 0.9), 0.0), ((0.6, 0.2), 0.0), ((0.1, 0.2), 1.0)],
)
def test_the_mix_hits_as_wanted_where_it_can(rates, share):
    assert seen(*rates).share() == pytest.approx(share, abs=1e-3)


def test_it_begins_with_the_first_attack_alone():
    assert Ladder(0.35).draw(50).sum() == 0


def test_what_has_not_been_made_is_tried_once_the_first_misses():
    ladder = Ladder(0.5)
    ladder.observe(torch.zeros(9, dtype=torch.int64), torch.zeros(9, dtype=torch.bool))
    assert ladder.draw(90).sum() == 40, "(0.5 - 1/10) / (1 - 1/10) of 90"


def test_wanting_none_keeps_the_harder_one_out():
    assert seen(0.0, 1.0, hits=0.0).share() == 0


def test_the_last_round_weighs_most():
    ladder = seen(0.0, 1.0)
    for _ in range(5):
        ladder.observe(
            torch.zeros(COUNT, dtype=torch.int64), torch.ones(COUNT, dtype=torch.bool)
        )
    assert ladder.share() == 0


def test_a_restored_ladder_draws_the_same():
    ladder = seen(0.1, 0.9)
    ladder.draw(8)
    again = Ladder(0.35)
    again.load_state_dict(ladder.state_dict())
    assert torch.equal(again.draw(50), ladder.draw(50))
