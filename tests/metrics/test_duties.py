"""Duties: the angles, times and fractions by which they are told apart."""

import math

import pytest
import torch

from e2rl.metrics.contact import FRONT, REAR
from e2rl.metrics.duties import DUTIES, drives_against_lane, duties, turns
from tests.metrics.pairs import lane, pair, straight

STOP = 50
NOT_STRUCK = torch.tensor([False])


def duty_at(degrees, ego_speed=10.0, speed=5.0, kind=FRONT):
    """The duty of a partner that comes into the ego's path at an angle, at the last
    moment."""
    ego = straight(0, 0, heading=0, speed=ego_speed, at=STOP)
    partner = straight(4, 0, heading=math.radians(degrees), speed=speed, at=STOP)
    index, _ = duties(pair(ego, partner, STOP, kind=kind), NOT_STRUCK)
    return DUTIES[index.item()]


@pytest.mark.parametrize(
    ("degrees", "expected"), [(-28, "entry"), (-32, "right of way")]
)
def test_up_to_30_degrees_a_partner_enters_beyond_it_crosses(degrees, expected):
    assert duty_at(degrees) == expected


@pytest.mark.parametrize(
    ("degrees", "expected"), [(148, "none"), (152, "right of way")]
)
def test_from_150_degrees_on_a_partner_comes_towards_the_ego(degrees, expected):
    """From the right; who comes towards an ego that does not turn gives way."""
    assert duty_at(degrees) == expected


@pytest.mark.parametrize(("degrees", "expected"), [(58, "rear-end"), (62, "none")])
def test_within_60_degrees_a_faster_partner_runs_into_the_rear(degrees, expected):
    assert duty_at(degrees, ego_speed=2.0, speed=12.0, kind=REAR) == expected


def test_a_slower_partner_does_not_run_into_the_rear():
    assert duty_at(58, ego_speed=2.0, speed=3.0, kind=REAR) == "none"


def turned(degrees, first, last):
    """Whether a vehicle turns that changes its heading evenly in the steps first..last
    before the contact."""
    track = straight(0, 0, heading=0, speed=5)
    share = (torch.arange(81) - (STOP - first)) / (first - last)
    track[:, 2] = math.radians(degrees) * share.clamp(0, 1)
    states = torch.stack([track, track], 1)[None]
    return turns(states, torch.tensor([STOP]))[0, 0].item()


@pytest.mark.parametrize(("degrees", "expected"), [(25.5, False), (26, True)])
def test_a_seventh_of_a_half_turn_is_a_turn(degrees, expected):
    assert turned(degrees, first=20, last=5) is expected


@pytest.mark.parametrize(("first", "expected"), [(40, True), (42, False)])
def test_a_turn_is_of_the_last_four_seconds(first, expected):
    """Of 26 degrees at a constant rate, all or all but a part within them."""
    assert turned(26, first=first, last=0) is expected


@pytest.mark.parametrize(
    ("first", "last", "expected"), [(5, 1, True), (4, 1, False), (10, 6, True)]
)
def test_half_of_the_last_second_against_the_lane_is_the_wrong_way(
    first, last, expected
):
    partner = straight(0, 0, heading=0, speed=5)
    partner[STOP - first : STOP - last + 1, 2] = math.pi
    line = lane(*((float(x), 0.0) for x in range(-10, 60, 2)))
    collisions = pair(straight(0, 50, 0, speed=5), partner, STOP, lanes=line)
    against = drives_against_lane(collisions.states, collisions)
    assert against.tolist() == [[False, expected]]
