"""The duty that a partner broke, in constructed collisions."""

import math

import pytest
import torch

from e2rl.metrics.verdicts import DUTIES, Lanes, duties
from tests.metrics.test_preventable import collision, cut_in
from tests.metrics.test_redrive import track

NO_LANES = Lanes(torch.zeros(1, 2, 2, dtype=torch.float64), torch.full((1, 2), -1))


def duty(case, rear=False, red=-1, lanes=NO_LANES):
    return DUTIES[duties(case, torch.tensor([rear]), torch.tensor([red]), lanes).item()]


def crossing(speed, from_left):
    """A straight crossing of the ego at 10 m/s, whose front meets the other's side."""
    sign = 1 if from_left else -1
    return collision(track(10.0), track(speed, -sign * math.pi / 2, (40.0, sign * (speed * 3.6 + 0.0))))


def test_who_runs_into_the_ego_from_behind_broke_the_duty_of_a_follower():
    assert duty(collision(track(8.0), track(15.0, start=(-25.0, 0.0))), rear=True) == "rear-end"


@pytest.mark.parametrize("gap, expected", [(3.0, "entry"), (25.0, "none")])
def test_a_cut_in_owes_what_a_competent_driver_needs(gap, expected):
    assert duty(collision(track(14.0), cut_in(gap, 14.0, 6.0))) == expected


def test_a_leader_that_brakes_in_its_own_lane_breaks_no_duty():
    slowing = track(torch.linspace(12, 0, 81).clamp(min=0), start=(12.0, 0.0))
    assert duty(collision(track(12.0), slowing)) == "none"


@pytest.mark.parametrize("from_left, expected", [(True, "right of way"), (False, "none")])
def test_without_another_rule_who_comes_from_the_left_gives_way(from_left, expected):
    assert duty(crossing(8.0, from_left)) == expected


def test_a_red_light_counts_if_it_was_run_shortly_before():
    case = crossing(8.0, from_left=False)
    stop = case.stop.item()
    assert duty(case, red=stop - 10) == "light"
    assert duty(case, red=-1) == "none"


def test_against_every_lane_that_it_is_on_is_the_wrong_way():
    case = collision(track(8.0), track(8.0, math.pi, (60.0, 0.0)))
    x = torch.arange(-20, 80, 2, dtype=torch.float64)
    line = torch.stack([x, torch.zeros_like(x)], -1)[None]
    with_ego = Lanes(line, torch.zeros(1, len(x), dtype=torch.long))
    assert duty(case, lanes=with_ego) == "wrong way"
    assert duty(case, lanes=Lanes(line.flip(1), with_ego.lane)) != "wrong way"


def test_mirrored_collisions_but_for_the_side_that_gives_way_have_the_same_duty():
    for case in (collision(track(14.0), cut_in(3.0, 14.0, 6.0, side=side)) for side in (1.0, -1.0)):
        assert duty(case) == "entry"
