"""The margin: minus the distance of closest approach without a contact, what the competent driver spares with one."""

import math

import pytest

from e2rl.metrics.margin import FARTHEST, PREVENTED
from tests.metrics.test_contact import course, row


def test_without_anybody_or_with_whom_the_ego_follows_nobody_is_near():
    assert row(course(0, 0, 0, 5))["margin"] == -FARTHEST
    assert row(course(0, 0, 0, 5), course(20, 0, 0, 5))["margin"] == -FARTHEST


@pytest.mark.parametrize("gap", [4.0, 8.0])
def test_who_passes_at_a_distance_has_it_as_its_margin(gap):
    """Oncoming in a lane that is `gap` m beside: at the closest approach 0 s ahead and gap minus a width away."""
    found = row(course(0, 0, 0, 10), course(60, gap, math.pi, 10))
    assert found["margin"] == pytest.approx(-(gap - 2.0), abs=0.2)


def test_the_margin_grows_with_nearness_to_contact_to_verdict():
    passes = [row(course(0, 0, 0, 10), course(60, gap, math.pi, 10))["margin"] for gap in (8.0, 5.0, 3.0)]
    assert passes == sorted(passes)
    stops = row(course(0, 0, 0, 10), course(60, 0, 0, 0.0))  # a wreck far ahead: the ego drives into it
    assert stops["cfr_preventable"] == 1 and stops["margin"] == PREVENTED
    appears = row(course(0, 0, 0, 10), course(12, -12, math.pi / 2, 10))  # crosses so soon that nobody could brake
    assert 0 <= appears["margin"] < PREVENTED or appears["cfr"] == 0
