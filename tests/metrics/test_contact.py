"""Contacts of two boxes on known courses: when, with whom, where on the ego, how hard,
whose fault."""

import math

import pytest
import torch

from e2rl.metrics.score import score_rollouts
from e2rl.metrics.traffic_contact import touched_columns
from tests.metrics.random_rollouts import random_rollouts

SIZE = (4.8, 2.0)


def course(x, y, heading, speed, steps=80, appears=0, accel=0.0):
    """States [T+1, 4] on a straight line at a constant acceleration, never backwards,
    and validity from a step on."""
    time = torch.arange(steps + 1, dtype=torch.float64) * 0.1
    speeds = (speed + accel * time).clamp(min=0)
    way = torch.cat(
        [
            torch.zeros(1, dtype=torch.float64),
            ((speeds[1:] + speeds[:-1]) / 2 * 0.1).cumsum(0),
        ]
    )
    states = [
        x + way * math.cos(heading),
        y + way * math.sin(heading),
        torch.full_like(time, heading),
        speeds,
    ]
    return torch.stack(states, -1), torch.arange(steps + 1) >= appears


def scene(*courses, kinds=None, adversaries=()):
    """One rollout; the first course is the ego's."""
    states = torch.stack([states for states, _ in courses], 1)[None].float()
    valid = torch.stack([valid for _, valid in courses], 1)[None]
    count = len(courses)
    simulated = torch.ones(1, count, dtype=torch.bool)
    simulated[:, 0] = False
    return random_rollouts(
        1, vehicles=count, others=0, steps=len(states[0]) - 1
    ).replace(
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
    )


def row(*courses, **options):
    return score_rollouts(scene(*courses, **options))[0][0]


HEAD_ON = course(
    100.1, 0.3, heading=math.pi, speed=30
)  # 3 m deep at the step of the contact, where the ego's sides are longer inside
CASES = {
    "a slower one ahead": (
        [course(0, 0, heading=0, speed=12), course(30.5, 0, heading=0, speed=5)],
        {
            "contact_type": "front",
            "contact_time": 3.7,
            "cfr": 1,
            "front": 1,
            "rir": 0,
            "relvel": 7,
        }
        | {"partner": 1, "at_fault": 1, "min_dtc": 0, "cfr_adv": 0},
    ),
    "from behind": (
        [course(0, 0, heading=0, speed=0), course(-30, 0.5, heading=0, speed=15)],
        {"contact_type": "rear", "rear": 1, "rir": 1, "at_fault": 0, "relvel": 15},
    ),
    "head on": (
        [course(0, 0, heading=0, speed=30), HEAD_ON],
        {
            "contact_type": "front",
            "relvel": 60,
            "front_any": 1,
            "side_any": 1,
            "rear_any": 0,
        },
    ),
    "from the right": (
        [
            course(0, 0, heading=0, speed=0),
            course(0.5, -25, heading=math.pi / 2, speed=10),
        ],
        {"contact_type": "side", "at_fault": 0},
    ),
    "from the left": (
        [
            course(0, 0, heading=0, speed=0),
            course(0.5, 25, heading=-math.pi / 2, speed=10),
        ],
        {"contact_type": "side", "at_fault": 0},
    ),
    "a standing one": (
        [course(0, 0, heading=0, speed=10), course(40, 0.4, heading=0.2, speed=0)],
        {"at_fault": 1},
    ),
    "one that cuts in": (
        [
            course(0, 0, heading=0, speed=10),
            course(43.0, -24.0, heading=math.pi / 2, speed=6),
        ],
        {"contact_type": "front", "at_fault": 0},
    ),
    "one that appears within the ego, and drives out of it": (
        [
            course(0, 0, heading=0, speed=0),
            course(-2.0, 0, heading=0, speed=3, appears=20),
        ],
        {"cfr": 0, "contact_type": ""},
    ),
    "one that appears before the ego": (
        [
            course(0, 0, heading=0, speed=10),
            course(30, 0, heading=0, speed=0, appears=20),
        ],
        {"cfr": 1, "contact_type": "front"},
    ),
    "one that crosses between two replans: steps 31 and 32 alone": (
        [
            course(0, 0, heading=0, speed=0),
            course(1.9, -108.5, heading=math.pi / 2, speed=34),
        ],
        {"cfr": 1, "contact_step": 31, "contact_type": "side"},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_contacts_on_known_courses(case):
    courses, expected = CASES[case]
    result = row(*courses)
    assert {name: result[name] for name in expected} == pytest.approx(
        expected, abs=1e-4
    )


def test_a_contact_is_with_an_adversary_or_not_and_who_has_left_is_not_hit():
    gone = course(30, 0, heading=0, speed=0)
    gone[1][5:] = False
    result = row(
        course(0, 0, heading=0, speed=12),
        course(30.5, 0, heading=0, speed=5),
        adversaries=[1],
    )
    assert result["cfr_adv"] == 1
    assert row(course(0, 0, heading=0, speed=10), gone)["cfr"] == 0


def test_an_ego_that_overlaps_at_the_start_has_no_collision_metrics():
    result = row(course(0, 0, heading=0, speed=5), course(2, 0, heading=0, speed=5))
    for name in (
        "cfr",
        "cfr_adv",
        "front",
        "side",
        "rear",
        "rir",
        "at_fault",
        "relvel",
        "contact_time",
    ):
        assert math.isnan(result[name]), name
    assert result["start_overlap_ego"] == 1
    assert result["contact_type"] == ""


def test_pedestrians_count_apart_and_do_not_end_the_rollout():
    result = row(
        course(0, 0, heading=0, speed=10),
        course(30, 0, heading=0, speed=0),
        course(60, 0, heading=0, speed=0),
        kinds=[0, 1, 0],
    )
    assert (result["cfr_vru"], result["cfr"], result["partner"]) == (1, 1, 2)


def hidden(states, steps: range):
    """A course that is absent at some steps."""
    valid = states[1].clone()
    valid[list(steps)] = False
    return states[0], valid


@pytest.mark.parametrize(("absent", "hit"), [(range(23, 26), 1), (range(20, 40), 0)])
def test_who_comes_back_within_the_ego_touches_it_only_if_it_was_hidden_for_a_moment(
    absent, hit
):
    """The boxes meet from step 25 on, at 10 m/s."""
    assert (
        row(
            course(0, 0, heading=0, speed=10),
            hidden(course(30, 0, heading=0, speed=0), absent),
        )["cfr"]
        == hit
    )


@pytest.mark.parametrize("kind", [1, 2, 3])
def test_a_pedestrian_that_appears_within_the_ego_touches_it_after_they_were_apart_once(
    kind,
):
    walker = course(0, -0.5, heading=math.pi / 2, speed=1, appears=10)
    result = row(course(0, 0, heading=0, speed=0), walker, kinds=[0, kind])
    assert result["cfr_vru"] == result["cfr_object"] == 0
    states, valid = walker
    states = torch.cat([states[:41], states[:40].flip(0)])  # and comes back
    result = row(course(0, 0, heading=0, speed=0), (states, valid), kinds=[0, kind])
    assert result["cfr_vru"] + result["cfr_object"] == 1


@pytest.mark.parametrize(("kind", "vru", "thing"), [(1, 1, 0), (2, 1, 0), (3, 0, 1)])
def test_an_object_is_no_pedestrian_or_cyclist(kind, vru, thing):
    result = row(
        course(0, 0, heading=0, speed=10),
        course(30, 0, heading=0, speed=0),
        kinds=[0, kind],
    )
    assert (result["cfr_vru"], result["cfr_object"], result["cfr"]) == (vru, thing, 0)


def test_background_pairs_leave_out_those_that_overlap_at_the_start_and_what_comes_after_the_ego_s_contact():
    ego = course(0, 0, heading=0, speed=0)
    far = course(0, 100, heading=0, speed=0)
    meeting = course(30, 100, heading=math.pi, speed=10)
    assert row(ego, far, meeting)["cfr_bg"] == 1
    assert row(ego, far, course(1, 100, heading=0, speed=0))["cfr_bg"] == 0
    early = course(
        -6, 0, heading=0, speed=10
    )  # hits the ego within 0.2 s, before the others meet
    result = row(ego, far, meeting, early)
    assert (result["cfr"], result["cfr_bg"]) == (1, 0)


@pytest.mark.parametrize(
    ("speeds", "logged", "there", "hit", "expected"),
    [
        ([9, 5, 5, 5, 0], None, None, [1, 2, 4], (2 / 3, 3)),
        ([9, 5, 5], None, None, [0], (0, 2)),  # the ego is no traffic
        (
            [9, 0, 5],
            [9, 5, 5],
            None,
            [1],
            (0.5, 2),
        ),  # who moves in the log alone counts
        ([9, 5, 5], None, [True, False, True], [1], (0, 1)),  # but not while absent
        ([9, 0, 0.4], None, None, [1, 2], (math.nan, 0)),
    ],
)
def test_touched_is_a_fraction_of_the_traffic_that_moves(
    speeds, logged, there, hit, expected
):
    speed = torch.tensor(speeds).double()
    log = torch.tensor(logged or speeds).double()
    count = len(speeds)
    track = torch.zeros(1, 5, count, 4, dtype=torch.float64)
    certain = torch.tensor(there or [True] * count).expand(1, 5, count)
    batch = {
        "states": track + 0,
        "logged": track + 0,
        "valid": certain,
        "logged_valid": certain,
    }
    batch["states"][..., 3], batch["logged"][..., 3] = speed, log
    batch["traffic"] = torch.arange(count)[None] > 0
    result = touched_columns(
        batch, torch.isin(torch.arange(count), torch.tensor(hit))[None]
    )
    assert (
        result["touched"].item(),
        result["moving_vehicles"].item(),
    ) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("ahead", [97.5 + 0.8 * index for index in range(10)])
def test_who_meet_between_two_steps_collide_at_the_step_after(ahead):
    """Two of 1.5 and 1.0 m head-on at 78 m/s, of whom no step shows an overlap in one
    of three cases."""
    result = score_rollouts(
        scene(
            course(0, 0, heading=0, speed=38),
            course(ahead, 0.2, heading=math.pi, speed=40),
        ).replace(size=torch.tensor([[[1.5, 1.0], [1.0, 0.8]]]))
    )
    row = result[0][0]
    expected = math.ceil((ahead - 1.25) / 7.8 - 1e-6)
    assert (row["cfr"], row["contact_step"], row["contact_type"], row["partner"]) == (
        1,
        expected,
        "front",
        1,
    )
    assert (row["front"], row["min_dtc"]) == (1, 0)
    passes = bool((ahead - 7.8 * expected) < -1.25)
    assert row["front_any"] == 1 or not passes, (
        "who is deep in the other may have its front beyond it"
    )
    assert row["relvel"] == pytest.approx(78, abs=1e-3)


def test_who_passes_by_does_not_collide_and_a_cyclist_that_is_passed_through_is_hit():
    short = torch.tensor([[[1.5, 1.0], [1.0, 0.8]]])
    beside = scene(
        course(0, 0, heading=0, speed=38), course(100, 0.95, heading=math.pi, speed=40)
    ).replace(size=short)
    assert score_rollouts(beside)[0][0]["cfr"] == 0
    cyclist = scene(
        course(0, 0, heading=0, speed=38),
        course(101.5, 0.2, heading=math.pi, speed=40),
        kinds=[0, 2],
    ).replace(size=short)
    assert score_rollouts(cyclist)[0][0]["cfr_vru"] == 1
