"""The verdict's columns: what counts, what is unknown, and the duty that a partner
broke in constructed collisions."""

import math

import pytest
import torch

from e2rl.metrics.collisions import Collisions
from e2rl.metrics.contact import FRONT
from e2rl.metrics.duties import DUTIES, duties
from e2rl.metrics.preventable import preventions
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.verdicts import clean
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_failure_features import course, drive, scene
from tests.metrics.test_preventable import collision, cut_in, track


def row_of(ego, partner, **extra):
    return score_rollouts(scene(ego, partner).replace(**extra))[0][0]


@pytest.fixture(scope="module")
def rows():
    return score_rollouts(
        random_rollouts(40, seed=3, vehicles=24, others=2, extent=25.0)
    )[0]


def test_a_collision_counts_if_the_ego_is_at_fault_or_a_competent_driver_prevents_it(
    rows,
):
    hits = [row for row in rows if row["cfr"] == 1]
    assert {row["counted"] for row in hits} == {0.0, 1.0}
    for row in hits:
        assert (
            row["counted"]
            == max(row["at_fault"], row["preventable"])
            == row["cfr_counted"]
        )
        assert row["cfr_preventable"] == row["preventable"]
        assert row["duty"] in DUTIES
        assert row["preventable_chain"] <= row["preventable"]


def test_without_a_collision_shares_are_zero_and_verdicts_unknown(rows):
    for row in rows:
        if row["cfr"] == 0:
            assert row["cfr_counted"] == row["cfr_preventable"] == 0
            assert row["duty"] == ""
            assert all(
                math.isnan(row[name])
                for name in ("counted", "at_fault", "preventable", "preventable_rss")
            )
        if math.isnan(row["cfr"]):  # the ego overlaps a vehicle at the start
            assert math.isnan(row["cfr_counted"])
            assert math.isnan(row["cfr_preventable"])


def test_a_slow_vehicle_far_ahead_in_the_lane_counts_and_a_rammer_does_not():
    ahead = row_of(course(0, 0, heading=0, speed=12), course(40, 0, heading=0, speed=3))
    behind = row_of(
        course(0, 0, heading=0, speed=8), course(-20, 0, heading=0, speed=14)
    )
    assert ahead["counted"] == ahead["preventable"] == ahead["at_fault"] == 1
    assert ahead["duty"] == "none"
    assert (
        behind["counted"] == behind["preventable_fsm"] == behind["preventable_rss"] == 0
    )
    assert behind["duty"] == "rear-end"


def test_a_red_light_is_a_duty_where_it_is_known():
    ego = course(0, 0, heading=0, speed=12)
    partner = course(40, 0, heading=0, speed=3)
    contact = int(row_of(ego, partner)["contact_step"])
    ran = torch.full((1, 2), -1)
    ran[0, 1] = contact - 5
    assert row_of(ego, partner, ran_light=ran)["duty"] == "light"
    assert row_of(ego, partner, ran_light=torch.full((1, 2), -1))["duty"] == "none"


NO_LANES = torch.zeros(1, 2, 2, dtype=torch.float64), torch.full((1, 2), -1)


def collisions_of(case, red=-1, lanes=NO_LANES, kind=FRONT):
    """The Collisions of an ego that hits the first of the others of a Collision."""
    return Collisions(
        hit=torch.tensor([True]),
        states=case.states[:, :, :2],
        valid=case.present[:, :, :2],
        size=case.size[:, :2],
        stop=case.stop,
        before=case.stop - 1,
        kind=torch.tensor([kind]),
        red=torch.tensor([[-1, red]]),
        lane_points=lanes[0],
        lane_index=lanes[1],
    )


def duty(case, **options):
    struck = preventions(case)["human"].struck
    index, _ = duties(collisions_of(case, **options), struck)
    return DUTIES[index.item()]


def crossing(speed, from_left):
    """A straight crossing of the ego at 10 m/s, whose front meets the other's side."""
    sign = 1 if from_left else -1
    return collision(
        track(10.0), track(speed, -sign * math.pi / 2, start=(40.0, sign * speed * 3.6))
    )


@pytest.mark.parametrize("gap, expected", [(3.0, "entry"), (25.0, "none")])
def test_a_cut_in_owes_what_a_competent_driver_needs(gap, expected):
    assert duty(collision(track(14.0), cut_in(gap, 14.0, other_speed=6.0))) == expected


def test_a_leader_that_brakes_in_its_own_lane_breaks_no_duty():
    slowing = track(torch.linspace(12, 0, 81).clamp(min=0), start=(12.0, 0.0))
    assert duty(collision(track(12.0), slowing)) == "none"


@pytest.mark.parametrize(
    "from_left, expected", [(True, "right of way"), (False, "none")]
)
def test_without_another_rule_who_comes_from_the_left_gives_way(from_left, expected):
    assert duty(crossing(8.0, from_left)) == expected


def oncoming(side, heading):
    """A collision with who comes towards the ego on the other lane and comes over to
    its own at the end."""
    partner = track(8.0, math.pi, start=(64.0, 0.0))
    share = ((torch.arange(81) - 20) / 8.0).clamp(0, 1)
    partner[0, :, 1] = side * 3.5 * (1 - share)
    partner[0, :, 2] = heading
    return collision(track(10.0), partner)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("heading", [math.pi - 0.03, 0.03 - math.pi])
def test_who_comes_towards_the_ego_gives_way_to_it_whatever_the_sign_of_the_angle(
    side, heading
):
    assert duty(oncoming(side, heading)) == "right of way"


def test_who_comes_over_to_a_driver_that_stands_by_then_breaks_its_right_of_way():
    """The gap was enough to lose the closing speed; the driver did, and is struck
    standing."""
    slow = track(torch.cat([torch.full((20,), 4.0), torch.linspace(4, 2, 61)]))
    partner = track(5.0, math.pi, start=(45.0, 0.0))
    partner[0, :, 1] = 3.5 * (1 - ((torch.arange(81) - 2) / 10.0).clamp(0, 1))
    case = collision(slow, partner)
    assert preventions(case)["human"].struck.item()
    assert duty(case) == "right of way"


def test_an_entry_is_forgotten_once_the_gap_was_safe():
    """It comes over 3 m ahead, drives off at 20 m/s for two seconds, and only then
    brakes to a stop."""
    speed = torch.cat(
        [
            torch.full((10,), 6.0),
            torch.full((20,), 25.0),
            torch.linspace(25, 0, 20),
            torch.zeros(31),
        ]
    )
    partner = cut_in(3.0, 14.0, other_speed=6.0)
    away = track(speed)
    partner[..., 0] = partner[..., :1, 0] + away[..., 0]
    partner[..., 3] = away[..., 3]
    assert duty(collision(track(14.0), cut_in(3.0, 14.0, other_speed=6.0))) == "entry"
    assert duty(collision(track(14.0), partner)) == "none"


def test_who_is_struck_as_a_competent_driver_would_be_that_has_stood_is_not_at_fault():
    """The ego pulls away half a second before somebody comes head-on; the driver has
    not started by then."""
    speed = torch.zeros(81)
    speed[26:] = 0.3 * torch.arange(1, 56)
    head_on = course(4.5 + 30 * 1.0, 0, heading=math.pi, speed=10.0)
    result = row_of((track(speed)[0], head_on[1]), head_on)
    assert result["cfr"] == 1
    assert result["contact_type"] == "front"
    assert result["at_fault"] == result["counted"] == 0


def test_against_every_lane_that_it_is_on_is_the_wrong_way():
    case = collision(track(8.0), track(8.0, math.pi, start=(60.0, 0.0)))
    x = torch.arange(-20, 80, 2, dtype=torch.float64)
    line = torch.stack([x, torch.zeros_like(x)], -1)[None]
    with_ego = line, torch.zeros(1, len(x), dtype=torch.long)
    assert duty(case, lanes=with_ego) == "wrong way"
    assert duty(case, lanes=(line.flip(1), with_ego[1])) != "wrong way"


@pytest.mark.parametrize(
    ("steps", "expected"), [(50, "light"), (51, "none"), (0, "light"), (-1, "none")]
)
def test_a_red_light_counts_for_five_seconds(steps, expected):
    case = collision(
        track(10.0), track(8.0, math.pi / 2, start=(70.0, -8.0 * 6.6))
    )  # from the right
    assert duty(case, red=case.stop.item() - steps) == expected


@pytest.mark.parametrize(
    ("off_until", "fault"), [(9, 1.0), (10, 0.0), (20, 0.0), (26, 0.0)]
)
def test_whoever_enters_the_ego_s_path_in_the_last_two_seconds_cuts_in_where_nobody_prevents_it(
    off_until, fault
):
    """The ego's front meets at step 30 a partner that is beside its path up to the step
    `off_until`."""
    states, valid = course(34.3, 0, heading=0, speed=0)
    states[:, 3], states[: off_until + 1, 1] = 5.0, 10.0
    result = row_of(course(0, 0, heading=0, speed=10), (states, valid))
    assert (result["contact_step"], result["contact_type"], result["at_fault"]) == (
        30,
        "front",
        fault,
    )


@pytest.mark.parametrize(
    ("ego", "partner", "fault"), [(0.09, 5.0, 0.0), (0.11, 5.0, 0.0), (10.0, 0.09, 1.0)]
)
def test_who_stands_is_not_at_fault_and_who_hits_the_standing_is(ego, partner, fault):
    """Speeds in the states alone: the ego's front is hit by a partner ahead that backs
    into it, or the other way."""
    states, valid = course(10, 0, heading=0, speed=0)
    states[:, 0] -= 0.2 * torch.arange(81)
    states[:, 3] = partner
    still = course(0, 0, heading=0, speed=0)
    still[0][:, 3] = ego
    assert row_of(still, (states, valid))["at_fault"] == fault


@pytest.mark.parametrize(("moves_until", "fault"), [(8, 1.0), (9, 0.0), (28, 0.0)])
def test_a_partner_that_swerves_in_and_stops_is_not_the_ego_s_fault(moves_until, fault):
    """It cuts in 0.4 s before the contact at step 30, and stands since the step after
    `moves_until`: 2 s, or less."""
    states, valid = course(34.3, 0, heading=0, speed=0)
    states[:27, 1], states[: moves_until + 1, 3] = 10.0, 5.0
    result = row_of(course(0, 0, heading=0, speed=10), (states, valid))
    assert (result["contact_step"], result["at_fault"], result["counted"]) == (
        30,
        fault,
        fault,
    )


def test_of_a_leader_that_has_just_stopped_only_what_a_driver_prevents_counts():
    """It has stood for a second when the ego runs into it, far enough ahead to brake
    for it or not."""
    for speed, preventable in ((10, 1), (13, 0)):
        stopping = drive(40, 0, 0, 4, accel=lambda t: -3.0 if t > 2.2 else 0.0)
        result = row_of(
            course(10 * 4.67 - speed * 4.67, 0, heading=0, speed=speed), stopping
        )
        assert (result["at_fault"], result["preventable"], result["counted"]) == (
            0,
            preventable,
            preventable,
        )


def test_what_stands_since_the_start_has_stood():
    assert (
        row_of(course(0, 0, heading=0, speed=10), course(8, 1.5, heading=0, speed=0))[
            "at_fault"
        ]
        == 1
    )


@pytest.mark.parametrize(("speed", "preventable"), [(0.6, 1.0), (0.4, 0.0)])
def test_an_ego_that_creeps_prevents_nothing_by_braking(speed, preventable):
    result = row_of(
        course(0, 0, heading=0, speed=speed), course(5.5, 0, heading=0, speed=0)
    )
    assert result["preventable"] == preventable
    assert result["counted"] == result["at_fault"] == 1


@pytest.mark.parametrize(
    ("lane", "stands_from", "fault"),
    [((-40, 40), 0, 1.0), ((40, -40), 0, 0.0), (None, 0, 0.0), ((-40, 40), 20, 0.0)],
)
def test_an_ego_that_stands_across_a_lane_is_in_the_way_of_who_comes_along_it(
    lane, stands_from, fault
):
    """It faces north; the partner comes from the west at step 35 or so, along the lane,
    against it, or without one."""
    ego = course(0, 0, heading=math.pi / 2, speed=0)
    ego[0][:stands_from, 3] = 1.0
    rollouts = scene(ego, course(-30, 0, heading=0, speed=7.6))
    x = torch.linspace(*(lane or (400, 480)), 41, dtype=torch.float64)
    line = torch.stack([x, torch.zeros_like(x)], -1)[None]
    extra = {
        "lane_points": line.to(rollouts.lane_points),
        "lane_index": torch.zeros(1, 41).to(rollouts.lane_index),
    }
    result = score_rollouts(rollouts.replace(**extra))[0][0]
    assert result["cfr"] == 1
    assert result["at_fault"] == fault


def test_a_failure_is_clean_if_it_is_preventable_and_nobody_else_did_wrong():
    row = row_of(course(0, 0, heading=0, speed=12), course(40, 0, heading=0, speed=3))
    assert row["cfr_clean"] == row["preventable"] == 1
    assert row["replayed"] == 0
    none = {"duty": 0, "replayed": 0, "cfr_bg": 0, "aor_any": 0, "ego_off_road": 0}
    cases = [none, *({**none, name: 1} for name in none)]
    columns = {name: torch.tensor([case[name] for case in cases]) for name in none}
    assert clean(columns | {"cfr_preventable": torch.ones(6)}).tolist() == [
        1,
        0,
        0,
        0,
        0,
        0,
    ]
    assert clean(columns | {"cfr_preventable": torch.zeros(6)}).tolist() == [0] * 6


def test_who_strikes_the_ego_is_only_replayed():
    struck = row_of(
        course(0, 0, heading=0, speed=12), course(5, 4, heading=-0.1, speed=12)
    )
    assert struck["contact_type"] == "side"
    assert struck["preventable"] == struck["replayed"] == 1


def test_the_driver_of_the_verdict_goes_with_the_rollout():
    """Its states begin as the ego's; it stays clear where the verdict says that the
    collision is preventable."""
    rollouts = torch.cat(
        [
            scene(course(0, 0, heading=0, speed=12), course(at, 0, heading=0, speed=3))
            for at in (40.0, 400.0)
        ]
    )
    rows = score_rollouts(rollouts)[0]
    assert [row["preventable"] == 1 for row in rows] == [True, False]
    assert rollouts.driver[1].isnan().all()
    torch.testing.assert_close(rollouts.driver[0, 0, :2], rollouts.states[0, 0, 0, :2])
    gap = rollouts.states[0, :, 1, 0] - rollouts.driver[0, :, 0]
    assert gap.min() > 4.8
    assert (rollouts.driver[0, :, 3].diff() < 0).any()


@pytest.mark.parametrize("from_left", [True, False])
@pytest.mark.parametrize("both", [False, True])
def test_who_runs_a_red_light_into_crossing_traffic_is_at_fault_and_owed_no_way(
    from_left, both
):
    """The partner crosses at green; at red, too, the light is its own duty, and the
    rules of contacts decide."""
    sign = 1 if from_left else -1
    ego = course(0, 0, heading=0, speed=10)
    partner = course(40, sign * 30, heading=-sign * math.pi / 2, speed=8)
    contact = int(row_of(ego, partner)["contact_step"])
    ran = torch.tensor([[contact - 5, contact - 5 if both else -1]])
    row = row_of(ego, partner, ran_light=ran)
    assert row["duty"] == ("light" if both else "none")
    if not both:
        assert row["at_fault"] == row["counted"] == 1


def test_who_runs_a_red_light_and_is_run_into_from_behind_is_not_at_fault():
    ego = course(0, 0, heading=0, speed=8)
    partner = course(-20, 0, heading=0, speed=14)
    contact = int(row_of(ego, partner)["contact_step"])
    row = row_of(ego, partner, ran_light=torch.tensor([[contact - 5, -1]]))
    assert row["duty"] == "rear-end"
    assert row["at_fault"] == 0


def two_way():
    """Lanes of a road: one along +x at y = 0, one along -x at y = 3.5."""
    x = torch.arange(-60.0, 120.0, 2.0, dtype=torch.float64)
    place = torch.stack([x, torch.zeros_like(x)], -1)
    back = torch.stack([x.flip(0), torch.full_like(x, 3.5)], -1)
    index = torch.tensor([0, 1]).repeat_interleave(len(x))
    return {
        "lane_points": torch.cat([place, back])[None],
        "lane_index": index[None],
        "lane_width": torch.full((1, 2), 3.5),
    }


@pytest.mark.parametrize("wrong", [True, False])
def test_who_drives_on_the_wrong_side_towards_one_that_keeps_to_its_own_is_at_fault(
    wrong,
):
    """Head-on on the lane along -x, or on that along +x."""
    y = 3.5 if wrong else 0.0
    row = row_of(
        course(0, y, heading=0, speed=10),
        course(60, y, heading=math.pi, speed=10),
        **two_way(),
    )
    assert row["at_fault"] == row["counted"] == (1 if wrong else 0)
    assert row["duty"] == ("none" if wrong else "wrong way")


def swerve_and_brake(gap):
    """It comes over `gap` m ahead at the ego's 14 m/s, and brakes as hard as it can
    half a second later."""
    partner = cut_in(gap, 14.0, other_speed=14.0)
    braking = track(
        torch.cat(
            [torch.full((14,), 14.0), (14.0 - 0.8 * torch.arange(67)).clamp(min=0)]
        )
    )
    partner[..., 0] = partner[..., :1, 0] + braking[..., 0]
    partner[..., 3] = braking[..., 3]
    return partner[0], torch.ones(81, dtype=torch.bool)


@pytest.mark.parametrize(("gap", "counted"), [(4.0, 0), (10.0, 1)])
def test_who_swerves_in_and_brakes_counts_once_two_seconds_are_over(gap, counted):
    row = row_of(course(0, 0, heading=0, speed=14), swerve_and_brake(gap))
    assert row["contact_type"] == "front"
    assert row["counted"] == counted


@pytest.mark.parametrize("gap", [5.0, 6.5])
def test_who_reverses_and_halts_after_the_contact_is_judged_as_the_same_motion_forwards(
    gap,
):
    ego = course(0, 0, heading=0, speed=4, accel=-1.0)
    partner = course(4.5 + gap, 0, heading=0, speed=0)
    backwards = ego[0].clone()
    backwards[:, 2], backwards[:, 3] = math.pi, -ego[0][:, 3]
    forwards_row = row_of(ego, partner)
    row = row_of((backwards, ego[1]), partner)
    assert forwards_row["cfr"] == 1
    for name in (
        "at_fault",
        "preventable",
        "preventable_fsm",
        "preventable_rss",
        "counted",
        "duty",
    ):
        assert row[name] == forwards_row[name], name


def test_who_appears_within_the_ego_and_is_gone_again_changes_nothing():
    ego = course(0, 0, heading=0, speed=12)
    leader = course(30.5, 0, heading=0, speed=5)
    states, valid = course(0, 0, heading=0, speed=12, appears=4)
    valid[9:] = False
    alone = score_rollouts(scene(ego, leader))[0][0]
    row = score_rollouts(scene(ego, leader, (states, valid)))[0][0]
    for name in (
        "cfr",
        "contact_step",
        "at_fault",
        "preventable",
        "counted",
        "cfr_clean",
        "min_dtc",
        "avoidable",
    ):
        assert row[name] == alone[name] or math.isnan(alone[name]), name
