"""Contacts of two boxes on known courses: when, with whom, where on the ego, how hard, whose fault."""

import math

import pytest
import torch

from e2rl.metrics.contact import touched_columns
from e2rl.metrics.score import score_rollouts
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import random_rollouts

SIZE = (4.8, 2.0)


def course(x, y, heading, speed, steps=80, appears=0, accel=0.0):
    """States [T+1, 4] on a straight line at a constant acceleration, never backwards, and validity from a step on."""
    time = torch.arange(steps + 1, dtype=torch.float64) * 0.1
    speeds = (speed + accel * time).clamp(min=0)
    way = torch.cat([torch.zeros(1, dtype=torch.float64), ((speeds[1:] + speeds[:-1]) / 2 * 0.1).cumsum(0)])
    states = [x + way * math.cos(heading), y + way * math.sin(heading), torch.full_like(time, heading), speeds]
    return torch.stack(states, -1), torch.arange(steps + 1) >= appears


def scene(*courses, kinds=None, adversaries=()):
    """One rollout; the first course is the ego's."""
    states = torch.stack([states for states, _ in courses], 1)[None].float()
    valid = torch.stack([valid for _, valid in courses], 1)[None]
    count = len(courses)
    simulated = torch.ones(1, count, dtype=torch.bool)
    simulated[:, 0] = False
    return Rollouts(
        states=states,
        valid=valid,
        size=torch.tensor(SIZE).expand(1, count, 2),
        agent_type=torch.tensor([kinds or [0] * count]),
        simulated=simulated,
        adversaries=torch.tensor([[index in adversaries for index in range(count)]]),
        logged=states,
        logged_valid=valid,
        lane_points=torch.tensor([[[-500.0, 0], [500.0, 0]]]),
        lane_index=torch.zeros(1, 2, dtype=torch.int64),
        lane_width=torch.tensor([[4.0]]),
        drivable_points=torch.zeros(1, 0, 2),
        drivable_index=torch.zeros(1, 0, dtype=torch.int64),
        seed=torch.zeros(1, dtype=torch.int64),
        eta=torch.zeros(1, dtype=torch.float64),
        scene_id=["scene"],
        location=[""],
        dataset=["d"],
        split=["s"],
        method=["e2"],
        ego_policy=["idm"],
        batch_size=[1],
    )


def row(*courses, **options):
    return score_rollouts(scene(*courses, **options))[0][0]


def test_running_into_a_slower_vehicle_is_a_front_contact_at_the_computed_time():
    result = row(course(0, 0, 0, 12), course(30.5, 0, 0, 5), adversaries=[1])
    expected = math.ceil((30.5 - 4.8) / 7 * 10) / 10
    assert (result["contact_type"], result["contact_time"]) == ("front", pytest.approx(expected))
    assert (result["cfr"], result["cfr_adv"], result["front"], result["rir"]) == (1, 1, 1, 0)
    assert result["relvel"] == pytest.approx(7, abs=1e-5) and result["partner"] == 1
    assert result["at_fault"] == 1, "the lead was on the ego's way all along"
    assert result["min_dtc"] == 0


def test_being_hit_from_behind_while_standing_is_a_rear_contact_and_not_the_ego_s_fault():
    result = row(course(0, 0, 0, 0), course(-30, 0.5, 0, 15))
    assert (result["contact_type"], result["rear"], result["rir"], result["at_fault"]) == ("rear", 1, 1, 0)
    assert result["relvel"] == pytest.approx(15, abs=1e-5) and result["cfr_adv"] == 0


def test_a_fast_head_on_contact_is_at_the_front_although_a_step_is_three_metres_deep():
    """At the grid step alone the ego's sides are 3 m inside the other, longer than its front: `side`."""
    result = row(course(0, 0, 0, 30), course(100.1, 0.3, math.pi, 30))
    assert result["contact_type"] == "front" and result["relvel"] == pytest.approx(60, abs=1e-4)
    assert (result["front_any"], result["side_any"], result["rear_any"]) == (1, 1, 0)


@pytest.mark.parametrize("start, heading", [(-25.0, math.pi / 2), (25.0, -math.pi / 2)])
def test_a_vehicle_from_the_side_hits_the_side(start, heading):
    result = row(course(0, 0, 0, 0), course(0.5, start, heading, 10))
    assert (result["contact_type"], result["at_fault"]) == ("side", 0)


def test_the_ego_is_at_fault_against_standing_vehicles_but_not_against_one_that_cuts_in():
    assert row(course(0, 0, 0, 10), course(40, 0.4, 0.2, 0))["at_fault"] == 1
    crossing = row(course(0, 0, 0, 10), course(43.0, -24.0, math.pi / 2, 6))
    assert (crossing["contact_type"], crossing["at_fault"]) == ("front", 0)


def test_a_contact_of_two_tenths_of_a_second_between_replans_is_found():
    """It holds at steps 31 and 32 alone: looking every fifth step would miss it."""
    passing = course(1.9, -108.5, math.pi / 2, 34)
    inside = (passing[0][:, 1].abs() < (SIZE[0] + SIZE[1]) / 2).nonzero()[:, 0].tolist()
    assert inside == [31, 32]
    result = row(course(0, 0, 0, 0), passing)
    assert (result["cfr"], result["contact_step"], result["contact_type"]) == (1, 31, "side")


def test_an_ego_that_overlaps_at_the_start_has_no_collision_metrics():
    result = row(course(0, 0, 0, 5), course(2, 0, 0, 5))
    for name in ("cfr", "cfr_adv", "front", "side", "rear", "rir", "at_fault", "relvel", "contact_time"):
        assert math.isnan(result[name]), name
    assert result["start_overlap_ego"] == 1 and result["contact_type"] == ""


def test_pedestrians_count_apart_and_do_not_end_the_rollout():
    result = row(course(0, 0, 0, 10), course(30, 0, 0, 0), course(60, 0, 0, 0), kinds=[0, 1, 0])
    assert (result["cfr_vru"], result["cfr"], result["partner"]) == (1, 1, 2)


def test_background_pairs_leave_out_those_that_overlap_at_the_start_and_what_comes_after_the_ego_s_contact():
    ego, far = course(0, 0, 0, 0), course(0, 100, 0, 0)
    meeting = course(30, 100, math.pi, 10)
    assert row(ego, far, meeting)["cfr_bg"] == 1
    assert row(ego, far, course(1, 100, 0, 0))["cfr_bg"] == 0
    early = course(-6, 0, 0, 10)  # hits the ego within 0.2 s, before the others meet
    result = row(ego, far, meeting, early)
    assert (result["cfr"], result["cfr_bg"]) == (1, 0)


def test_a_partner_that_was_not_there_the_step_before_is_judged_at_contact():
    result = row(course(0, 0, 0, 0), course(-2.0, 0, 0, 3, appears=20))
    assert (result["contact_step"], result["contact_type"]) == (20, "front")
    assert result["relvel"] == pytest.approx(3, abs=1e-5)


def test_a_vehicle_that_has_left_cannot_be_hit():
    gone = course(30, 0, 0, 0)
    gone[1][5:] = False
    assert row(course(0, 0, 0, 10), gone)["cfr"] == 0


def test_types_are_exclusive_and_partner_was_touched():
    for result in score_rollouts(random_rollouts(24, seed=11))[0]:
        if result["cfr"] == 1:
            assert result["front"] + result["side"] + result["rear"] == 1
            assert result[result["contact_type"]] == 1 and result["partner"] > 0
        elif result["cfr"] == 0:
            assert result["front"] + result["side"] + result["rear"] == 0 and math.isnan(result["rir"])


def touched(speeds, hit, logged=None, valid=None):
    """touched and moving_vehicles of one rollout of vehicles at speeds [N] throughout; the ego is no traffic."""
    speed = torch.tensor(speeds, dtype=torch.float64)
    count = len(speeds)
    track = torch.zeros(1, 5, count, 4, dtype=torch.float64)
    log = track.clone()
    track[..., 3], log[..., 3] = speed, speed if logged is None else torch.tensor(logged, dtype=torch.float64)
    there = torch.ones(1, 5, count, dtype=torch.bool)
    known = there if valid is None else there & torch.tensor(valid)
    batch = {"states": track, "valid": known, "logged": log, "logged_valid": known}
    batch["traffic"] = torch.arange(count)[None] > 0
    found = touched_columns(batch, torch.tensor([hit]))
    return found["touched"].item(), found["moving_vehicles"].item()


def test_it_is_a_share_of_those_that_move():
    assert touched([9, 5, 5, 5, 0], [False, True, True, False, True]) == (2 / 3, 3)
    assert touched([9, 5, 5], [True, False, False]) == (0, 2), "the ego is no traffic"


def test_whoever_moves_in_the_log_alone_counts_but_not_while_absent():
    assert touched([9, 0, 5], [False, True, False], logged=[9, 5, 5]) == (0.5, 2)
    assert touched([9, 5, 5], [False, True, False], valid=[True, False, True]) == (0, 1)


def test_nobody_moving_is_unknown():
    share, number = touched([9, 0, 0.4], [False, True, True])
    assert share != share and number == 0
