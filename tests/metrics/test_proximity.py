"""Closest approach, gaps, acceleration, progress and standing vehicles against closed
forms."""

import math

import pytest
import torch

from e2rl.metrics.proximity import (
    ego_path,
    mean_acceleration,
    mean_worst_cost,
    moved,
    progress,
    route_completion,
    standing_columns,
)
from e2rl.metrics.score import score_rollouts
from tests.loops import loop, track
from tests.metrics.test_contact import course, row, scene


def test_cost_is_the_mean_over_steps_of_the_worst_adversary():
    cost = torch.tensor([[[0.0, 0.2, 0.9], [0.0, 0.4, 0.1], [0, 1, 1]]])
    counted = torch.tensor(
        [[[False, True, False], [False, True, True], [False, False, False]]]
    )
    assert mean_worst_cost(cost, counted).item() == pytest.approx(0.3)
    assert mean_worst_cost(cost, counted & False).isnan().all(), (
        "no adversary: unknown, not 0"
    )


def test_gap_is_the_smallest_box_distance():
    assert row(course(0, 0, heading=0, speed=5), course(0, 5, heading=0, speed=5))[
        "min_dtc"
    ] == pytest.approx(3.0, abs=1e-5)
    assert math.isnan(row(course(0, 0, heading=0, speed=5))["min_dtc"]), (
        "nobody else: unknown"
    )


def test_constant_braking_has_its_own_mean_acceleration_and_way():
    result = row(course(0, 0, heading=0.3, speed=20, accel=-2))
    assert result["macc"] == pytest.approx(2, abs=1e-3)
    assert result["progress"] == pytest.approx(20 * 8 - 64, abs=1e-3)


def test_short_paths_have_no_acceleration():
    path = torch.zeros(2, 81, 4, dtype=torch.float64)
    path[..., 3] = torch.arange(81)
    values = mean_acceleration(path, torch.tensor([6, 7]))
    assert values[0].isnan()
    assert values[1] == pytest.approx(10)


def test_gaps_of_the_ego_s_track_are_closed_before_measuring():
    states, valid = course(0, 0, heading=0, speed=10)
    valid[3:6] = False
    path, count = ego_path(
        states[None, :, None], valid[None, :, None], stop=torch.tensor([80])
    )
    assert count.item() == 78
    assert progress(path, count).item() == pytest.approx(80)


def completion(ego, recorded, *others):
    """Route completion of an ego on one course whose recording is on another."""
    rollout = scene(ego, *others)
    logged = rollout.logged.clone()
    valid = rollout.logged_valid.clone()
    logged[0, :, 0], valid[0, :, 0] = recorded[0].float(), recorded[1]
    return score_rollouts(rollout.replace(logged=logged, logged_valid=valid))[0][0][
        "route_completion"
    ]


def test_the_share_of_the_recorded_way_is_what_lies_behind_the_ego():
    """On it and beside it alike; more than the recording has drives no more than all of
    it."""
    recorded = course(0, 0, heading=0.3, speed=10)
    assert completion(recorded, recorded) == pytest.approx(1)
    assert completion(course(0, 0, heading=0.3, speed=4), recorded) == pytest.approx(
        0.4, abs=1e-4
    )
    assert completion(
        course(-math.sin(0.3), math.cos(0.3), heading=0.3, speed=4), recorded
    ) == pytest.approx(0.4, abs=1e-4)
    assert completion(course(0, 0, heading=0.3, speed=20), recorded) == 1
    assert completion(course(0, 0, heading=0.3 + math.pi, speed=5), recorded) == 0


def test_a_bent_way_counts_by_its_length_and_a_standing_ego_has_none():
    angle = torch.linspace(0, math.pi, 81, dtype=torch.float64)
    bent = torch.stack(
        [20 * angle.sin(), 20 - 20 * angle.cos(), angle, torch.full_like(angle, 8)], -1
    )
    everywhere = torch.ones(1, 81, 1, dtype=torch.bool)
    for steps in (20, 40, 80):
        result = route_completion(
            bent[None],
            torch.tensor([steps + 1]),
            logged=bent[None, :, None],
            logged_valid=everywhere,
        )
        assert result.item() == pytest.approx(steps / 80, abs=1e-6)
    gone = everywhere & (torch.arange(81) <= 40)[:, None]
    result = route_completion(
        bent[None], torch.tensor([21]), logged=bent[None, :, None], logged_valid=gone
    )
    assert result.item() == pytest.approx(0.5, abs=1e-6), "of the way that is recorded"
    assert math.isnan(
        completion(course(0, 0, heading=0, speed=5), course(0, 0, heading=0, speed=0.1))
    )


@pytest.mark.parametrize("steps", [5, 24, 26, 60, 81])
def test_the_share_of_a_way_that_crosses_itself_is_what_was_driven(steps):
    """The crossing is passed at the steps 15 and 82; near it, the nearest piece is of
    the other passage."""
    recorded = track(loop(), 20.0, speed=25.0, steps=90)[None].double()
    ego = recorded + torch.tensor([0.3, -0.3, 0, 0])
    everywhere = torch.ones(1, 91, 1, dtype=torch.bool)
    result = route_completion(
        ego,
        torch.tensor([steps + 1]),
        logged=recorded[:, :, None],
        logged_valid=everywhere,
    )
    assert result.item() == pytest.approx(steps / 90, abs=0.01)


PARKED_STAYS, PARKED_MOVES, STANDS, STARTS, STARTS_IN_LOG, DRIVES, LATE = range(1, 8)
ROWS = 8


def rollouts():
    """One rollout of eight vehicles, named above; whoever moves goes 5 m in x."""
    states = torch.zeros(1, 11, ROWS, 4, dtype=torch.float64)
    states[..., 0] = 20.0 * torch.arange(ROWS)
    logged = states.clone()
    way = torch.linspace(0, 5, 11)
    for who in (PARKED_MOVES, STARTS, DRIVES, LATE):
        states[0, :, who, 0] += way
    for who in (STARTS_IN_LOG, DRIVES):
        logged[0, :, who, 0] += way
    states[0, :, DRIVES, 3] = logged[0, :, DRIVES, 3] = 5.0
    valid, logged_valid = (torch.ones(1, 11, ROWS, dtype=torch.bool) for _ in range(2))
    logged_valid[0, 8:, LATE] = False  # not recorded throughout
    parked = torch.zeros(1, ROWS, dtype=torch.bool)
    parked[0, [PARKED_STAYS, PARKED_MOVES]] = True
    return {
        "states": states,
        "valid": valid,
        "logged": logged,
        "logged_valid": logged_valid,
        "parked": parked,
    }


def traffic():
    return torch.arange(ROWS)[None] > 0


def values(batch, who=None):
    result = standing_columns(batch | {"traffic": traffic() if who is None else who})
    return {name: value[0].item() for name, value in result.items()}


def test_everybody_is_counted_once_and_where_it_belongs():
    batch = rollouts()
    who = traffic()
    assert values(batch) == {
        "parked_moved": 0.5,
        "parked_vehicles": 2,
        "starters": 1,
        "starters_log": 1,
    }
    as_logged = values(batch | {"states": batch["logged"]})
    assert as_logged["parked_moved"] == 0
    assert as_logged["starters"] == as_logged["starters_log"] == 1
    who[0, [PARKED_MOVES, STARTS]] = False
    assert values(batch, who) == {
        "parked_moved": 0,
        "parked_vehicles": 1,
        "starters": 0,
        "starters_log": 1,
    }


def test_moved_means_farther_than_the_limit_at_a_step_where_it_is_there():
    states = torch.zeros(1, 3, 4, 4)
    valid = torch.ones(1, 3, 4, dtype=torch.bool)
    states[0, 1, 0, :2] = 2.01 * torch.tensor([0.6, -0.8])  # and back
    states[0, 2, 1, 0] = 2.0
    states[0, 2, 2, 0], valid[0, 2, 2] = 9.0, False
    assert moved(states, valid)[0].tolist() == [True, False, False, False]


@pytest.mark.parametrize(("recorded", "known"), [(0.95, False), (1.05, True)])
def test_of_a_recorded_path_below_a_metre_no_fraction_is_known(recorded, known):
    path = course(0, 0, heading=0, speed=recorded / 8)
    assert (not math.isnan(completion(path, path))) is known


@pytest.mark.parametrize(("speed", "starters"), [(0.45, 1), (0.55, 0)])
def test_a_vehicle_stands_at_the_start_below_half_a_metre_a_second(speed, starters):
    batch = rollouts()
    batch["states"] = batch["states"].clone()
    batch["states"][0, 0, STARTS, 3] = speed
    assert values(batch)["starters"] == starters
