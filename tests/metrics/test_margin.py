"""The margin: minus the distance of closest approach without a contact, what the
competent driver spares with one."""

import math

import pytest
import torch

from e2rl.metrics.margin import FARTHEST, PREVENTED, contact_margin
from tests.metrics.test_contact import course, row


def test_without_anybody_or_with_whom_the_ego_follows_nobody_is_near():
    assert row(course(0, 0, heading=0, speed=5))["margin"] == -30.0
    assert (
        row(course(0, 0, heading=0, speed=5), course(20, 0, heading=0, speed=5))[
            "margin"
        ]
        == -FARTHEST
    )


@pytest.mark.parametrize("gap", [4.0, 8.0])
def test_who_passes_at_a_distance_has_it_as_its_margin(gap):
    """Oncoming in a lane that is `gap` m beside: at the closest approach 0 s ahead and
    gap minus a width away."""
    result = row(
        course(0, 0, heading=0, speed=10), course(60, gap, heading=math.pi, speed=10)
    )
    assert result["margin"] == pytest.approx(-(gap - 2.0), abs=0.2)


def test_the_margin_grows_with_nearness_to_contact_to_verdict():
    passes = [
        row(
            course(0, 0, heading=0, speed=10),
            course(60, gap, heading=math.pi, speed=10),
        )["margin"]
        for gap in (8.0, 5.0, 3.0)
    ]
    assert passes == sorted(passes)
    stops = row(
        course(0, 0, heading=0, speed=10), course(60, 0, heading=0, speed=0.0)
    )  # a wreck far ahead: the ego drives into it
    assert stops["cfr_preventable"] == 1
    assert stops["margin"] == PREVENTED


def test_a_contact_has_the_share_of_its_speed_that_the_driver_has_lost_before_it():
    """An ego at 10 m/s whose driver is down to 6 by then; one that creeps; one without
    a driver; a preventable one."""
    states = torch.zeros(4, 5, 2, 4)
    driver = torch.zeros(4, 5, 4)
    states[:, :, 0, 3], driver[:, 3, 3] = 10.0, 6.0
    states[1, :, 0, 3], driver[2] = 0.2, torch.nan
    step = torch.full((4,), 3)
    batch = {"states": states, "driver": driver, "before": step, "stop": step + 1}
    result = contact_margin(batch | {"preventable": torch.tensor([0, 0, 0, 1])})
    torch.testing.assert_close(result, torch.tensor([0.4, 0.0, 0.0, PREVENTED]))


@pytest.mark.parametrize(("speed", "counts"), [(5.9, False), (6.1, True)])
def test_a_pair_counts_from_a_relative_speed_of_a_metre_a_second_on(speed, counts):
    """Beside the ego at 5 m/s, 2 m between the sides, and faster."""
    result = row(course(0, 0, heading=0, speed=5), course(1, 4, heading=0, speed=speed))
    assert (result["margin"] > -FARTHEST) is counts


@pytest.mark.parametrize(("gap", "expected"), [(29.0, -29.0), (31.0, -30.0)])
def test_nobody_is_farther_than_30_m(gap, expected):
    """A vehicle that passes by so far beside."""
    result = row(
        course(0, 0, heading=0, speed=10),
        course(60, gap + 2.0, heading=math.pi, speed=10),
    )
    assert result["margin"] == pytest.approx(expected, abs=0.2)


def test_a_preventable_contact_has_twice_the_most_that_others_have():
    result = row(course(0, 0, heading=0, speed=10), course(60, 0, heading=0, speed=0))
    assert result["margin"] == 2.0
