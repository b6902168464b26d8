"""Whose fault a collision is: what each number of the rules means."""

import math

import pytest
import torch

from e2rl.metrics.fault import (
    blocks_lane,
    ego_at_fault,
    enters_path,
    has_stood,
    is_moving,
    turned_on_the_spot,
)
from tests.metrics.pairs import LENGTH, WIDTH, lane, pair, straight

STOP = 50
NO = torch.tensor([False])
YES = torch.tensor([True])


def fault(collisions, prevented):
    moved_into = torch.tensor([[False, False]])
    return ego_at_fault(
        collisions, moved_into, struck=NO, broke=NO, prevented=prevented
    ).item()


@pytest.mark.parametrize(
    ("beside_until", "prevented", "expected"),
    [(11, YES, True), (10, YES, False), (21, NO, True), (20, NO, False)],
)
def test_who_enters_in_the_last_second_cuts_in_or_two_where_nobody_prevents_it(
    beside_until, prevented, expected
):
    ego = straight(0, 0, heading=0, speed=10, at=STOP)
    partner = straight(LENGTH, 0, heading=0, speed=5, at=STOP)
    partner[: STOP - beside_until + 1, 1] = 10.0
    assert fault(pair(ego, partner, STOP), prevented) is expected


@pytest.mark.parametrize(("speed", "expected"), [(27.0, False), (35.0, True)])
def test_the_path_goes_on_for_30_m_beyond_the_contact(speed, expected):
    """An oncoming partner that was on it a second before, or beyond its end: 30 m ahead
    of the ego's front."""
    ego = straight(0, 0, heading=0, speed=0)
    partner = straight(LENGTH, 0, heading=math.pi, speed=speed, at=STOP)
    assert enters_path(pair(ego, partner, STOP), 10).item() is expected


@pytest.mark.parametrize(("speed", "expected"), [(0.09, False), (0.11, True)])
def test_a_vehicle_moves_above_a_tenth_of_a_metre_a_second(speed, expected):
    ego = straight(0, 0, heading=0, speed=speed)
    collisions = pair(ego, straight(4, 0, heading=0, speed=0), STOP)
    assert is_moving(collisions).tolist() == [[expected, False]]


@pytest.mark.parametrize(("steps", "expected"), [(20, True), (19, False)])
def test_two_seconds_make_a_stand(steps, expected):
    partner = straight(LENGTH, 0, heading=0, speed=0)
    partner[: STOP - 1 - steps, 3] = 1.0
    collisions = pair(straight(0, 0, heading=0, speed=10, at=STOP), partner, STOP)
    assert has_stood(collisions)[0, 1].item() is expected


@pytest.mark.parametrize(("angle", "expected"), [(0.9e-3, False), (1.1e-3, True)])
def test_a_heading_that_changes_by_a_milliradian_has_turned(angle, expected):
    """Beside the ego by 1 mm, and in it by its turn alone."""
    ego = straight(0, 0, heading=0, speed=5, at=STOP)
    partner = straight(3, WIDTH + 1e-3, heading=0, speed=0)
    partner[STOP - 5 :, 2] = angle
    ego[STOP:, :2] = 0.0
    assert turned_on_the_spot(pair(ego, partner, STOP)).item() is expected


@pytest.mark.parametrize(("steps", "expected"), [(10, False), (11, True)])
def test_a_turn_alone_makes_no_contact_that_would_come_within_a_second(steps, expected):
    """The ego drives into the partner, whatever its heading, so many steps later."""
    ego = straight(-3, 0, heading=0, speed=0)
    ego[STOP + steps :, 0] = 0.0
    partner = straight(4, 0, heading=0, speed=0)
    partner[STOP - 5 :, 2] = math.pi / 2
    assert turned_on_the_spot(pair(ego, partner, STOP)).item() is expected


def blocks(offset=0.0, ego_degrees=90.0, lane_degrees=0.0):
    """Whether a standing ego is in the way of a partner that comes along +x."""
    angle = math.radians(lane_degrees)
    side = torch.tensor([-math.sin(angle), math.cos(angle)]) * offset
    line = lane(
        *(
            (s * math.cos(angle) + side[0].item(), s * math.sin(angle) + side[1].item())
            for s in range(-20, 22, 2)
        )
    )
    ego = straight(0, 0, heading=math.radians(ego_degrees), speed=0)
    partner = straight(-4, 0, heading=0, speed=5, at=STOP)
    return blocks_lane(pair(ego, partner, STOP, lanes=line)).item()


@pytest.mark.parametrize(("offset", "expected"), [(1.7, True), (1.8, False)])
def test_an_ego_is_on_a_lane_up_to_half_its_width_of_three_and_a_half_metres(
    offset, expected
):
    assert blocks(offset=offset) is expected


@pytest.mark.parametrize(("degrees", "expected"), [(29, False), (31, True)])
def test_an_ego_stands_across_from_30_degrees_on(degrees, expected):
    assert blocks(ego_degrees=degrees) is expected


@pytest.mark.parametrize(("degrees", "expected"), [(29, True), (31, False)])
def test_a_lane_runs_as_the_partner_drives_up_to_30_degrees(degrees, expected):
    assert blocks(lane_degrees=degrees) is expected
