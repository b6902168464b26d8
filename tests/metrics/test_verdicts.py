"""The columns of verdicts: what counts, what is unknown, and that a red light needs to be known."""

import math

import pytest
import torch

from e2rl.metrics.score import score_rollouts
from e2rl.metrics.verdicts import DUTIES
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_failure_features import course, scene


def row_of(ego, partner, **extra):
    return score_rollouts(scene(ego, partner).replace(**extra))[0][0]


@pytest.fixture(scope="module")
def rows():
    return score_rollouts(random_rollouts(40, seed=3, vehicles=24, others=2, extent=25.0))[0]


def test_a_collision_counts_if_the_ego_is_at_fault_or_a_competent_driver_prevents_it(rows):
    hits = [row for row in rows if row["cfr"] == 1]
    assert {row["counted"] for row in hits} == {0.0, 1.0}
    for row in hits:
        assert row["counted"] == max(row["at_fault"], row["preventable"]) == row["cfr_counted"]
        assert row["cfr_preventable"] == row["preventable"] and row["duty"] in DUTIES
        assert row["preventable_chain"] <= row["preventable"]


def test_without_a_collision_shares_are_zero_and_verdicts_unknown(rows):
    for row in rows:
        if row["cfr"] == 0:
            assert row["cfr_counted"] == row["cfr_preventable"] == 0 and row["duty"] == ""
            assert all(math.isnan(row[name]) for name in ("counted", "at_fault", "preventable", "preventable_rss"))
        if math.isnan(row["cfr"]):  # the ego overlaps a vehicle at the start
            assert math.isnan(row["cfr_counted"]) and math.isnan(row["cfr_preventable"])


def test_a_slow_vehicle_far_ahead_in_the_lane_counts_and_a_rammer_does_not():
    ahead, behind = row_of(course(0, 0, 0, 12), course(40, 0, 0, 3)), row_of(course(0, 0, 0, 8), course(-20, 0, 0, 14))
    assert ahead["counted"] == ahead["preventable"] == ahead["at_fault"] == 1 and ahead["duty"] == "none"
    assert behind["counted"] == behind["preventable_fsm"] == behind["preventable_rss"] == 0
    assert behind["duty"] == "rear-end"


def test_a_red_light_is_a_duty_where_it_is_known():
    ego, partner = course(0, 0, 0, 12), course(40, 0, 0, 3)
    contact = int(row_of(ego, partner)["contact_step"])
    ran = torch.full((1, 2), -1)
    ran[0, 1] = contact - 5
    assert row_of(ego, partner, ran_light=ran)["duty"] == "light"
    assert row_of(ego, partner, ran_light=torch.full((1, 2), -1))["duty"] == "none"
