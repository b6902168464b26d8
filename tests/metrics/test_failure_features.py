"""What happens in a collision: known cases get their words."""

import math

import pytest
import torch

from e2rl.metrics.collisions import Collisions
from e2rl.metrics.contact import first_contact
from e2rl.metrics.failure_features import (
    LATE,
    MANOEUVRES,
    WINDOW,
    manoeuvre,
)
from e2rl.metrics.score import as_doubles, score_rollouts
from e2rl.sim.dynamics import rollout
from tests.metrics.test_contact import course, row, scene

EAST = 0.0
NORTH = math.pi / 2
WEST = math.pi
SOUTH = -math.pi / 2
WORDS = ("approach", "ego_manoeuvre", "partner_manoeuvre")


def drive(x, y, heading, speed, turn=lambda t: 0.0, accel=lambda t: 0.0, steps=80):
    """A course [T+1, 4] of the simulator's unicycle under yaw rates [rad/s] and
    accelerations [m/s^2] of time."""
    actions = torch.tensor(
        [[accel(0.1 * step), turn(0.1 * step)] for step in range(steps)],
        dtype=torch.float64,
    )
    start = torch.tensor([x, y, heading, speed], dtype=torch.float64)
    states = torch.cat([start[None], rollout(start[None], actions[None])[0]])
    return states, torch.ones(steps + 1, dtype=torch.bool)


def words(*courses):
    result = row(*courses)
    return tuple(result[name] for name in WORDS)


def swerve(sign, begin, seconds=1.0, rate=0.2):
    """Yaw rates of a lane change: out, then back."""
    return lambda t: (
        sign
        * rate
        * (
            (begin <= t < begin + seconds)
            - (begin + seconds <= t < begin + 2 * seconds)
        )
    )


EGO = course(0, 0, heading=EAST, speed=12)
STRAIGHT = ("keeps speed", "keeps speed")
CASES = [
    (EGO, course(30.5, 0, heading=EAST, speed=5), ("ahead", *STRAIGHT)),
    (
        EGO,
        drive(20, 0, EAST, 12, accel=lambda t: -5.0 if t > 0.5 else 0.0),
        ("ahead", "keeps speed", "brakes"),
    ),
    *(
        (
            EGO,
            course(40, 0, heading=heading, speed=0),
            ("ahead", "keeps speed", "stands"),
        )
        for heading in (EAST, NORTH, WEST, 2.0)
    ),
    (
        course(0, 0, heading=EAST, speed=10),
        course(43.0, -24, heading=NORTH, speed=6),
        ("crossing from the right", *STRAIGHT),
    ),
    (
        course(0, 0, heading=EAST, speed=10),
        course(43.0, 24, heading=SOUTH, speed=6),
        ("crossing from the left", *STRAIGHT),
    ),
    (  # a left turn across oncoming traffic, of the ego and of its partner
        drive(-10, 0, EAST, 6, turn=lambda t: 0.4 if 2 < t < 5 else 0.0),
        course(47, 5, heading=WEST, speed=9),
        ("oncoming", "turns left", "keeps speed"),
    ),
    (
        course(0, 0, heading=EAST, speed=8),
        drive(26, 3.5, WEST, 6, turn=lambda t: 0.5 if t > 0.5 else 0.0),
        ("oncoming", "keeps speed", "turns left"),
    ),
    (
        drive(0, 0, EAST, 10, accel=lambda t: -4.0 if t > 1 else 0.0),
        course(-14, 0, heading=EAST, speed=10),
        ("from behind", "brakes", "keeps speed"),
    ),
    (
        course(0, 0, heading=EAST, speed=0),
        course(-30, 0.5, heading=EAST, speed=15),
        ("from behind", "stands", "keeps speed"),
    ),
]


@pytest.mark.parametrize(("ego", "partner", "expected"), CASES)
def test_known_cases_have_their_words(ego, partner, expected):
    assert words(ego, partner) == expected


@pytest.mark.parametrize(
    ("side", "sign", "other"), [("left", 1, "right"), ("right", -1, "left")]
)
def test_who_comes_over_cuts_in_from_its_side_or_is_beside(side, sign, other):
    cuts_in = drive(18, 3.5 * sign, EAST, 9, turn=swerve(-sign, 1.5))
    assert words(course(0, 0, heading=EAST, speed=13), cuts_in) == (
        f"cut-in from the {side}",
        "keeps speed",
        f"veers {other}",
    )
    beside = drive(0, 3.5 * sign, EAST, 12, turn=swerve(-sign, 2.0))
    assert words(EGO, beside) == (
        f"beside on the {side}",
        "keeps speed",
        f"veers {other}",
    )


def test_a_leader_in_a_sharp_bend_is_ahead_and_the_follower_is_behind():
    """Both turn right by a quarter; two seconds before the contact they differ by more
    than 45 degrees."""

    def bend(speed, begin):
        return drive(
            0,
            0,
            EAST,
            speed,
            turn=lambda t: (
                -speed / 10 if begin <= t * speed < begin + 5 * math.pi else 0.0
            ),
        )

    slow = bend(5.0, 20)
    fast = bend(9.0, 20)
    slow = (slow[0][38:], slow[1][38:])  # 19 m on its way when the fast one starts
    fast = (fast[0][: len(slow[0])], fast[1][: len(slow[0])])
    assert words(fast, slow)[0] == "ahead"
    assert words(slow, fast)[0] == "from behind"


def test_along_a_bend_of_the_lane_nobody_veers():
    """A curve of radius 150 m: 20 m of it bend by less than a turn, and lie 1.3 m
    beside the first heading."""
    angle = torch.linspace(-0.5, 1.5, 200, dtype=torch.float64)
    lane = torch.stack([150 * angle.sin(), 150 * (1 - angle.cos())], -1)
    on_lane = drive(0, 0, EAST, 10, turn=lambda t: 10 / 150)
    ahead = drive(
        150 * math.sin(0.2), 150 * (1 - math.cos(0.2)), 0.2, 4, turn=lambda t: 4 / 150
    )
    inputs = scene(on_lane, ahead).replace(
        lane_points=lane[None], lane_index=torch.zeros(1, 200, dtype=torch.int64)
    )
    result = score_rollouts(inputs)[0][0]
    assert [result[name] for name in WORDS] == ["ahead", "keeps speed", "keeps speed"]
    straight = score_rollouts(scene(on_lane, ahead))[0][0]
    assert straight["ego_manoeuvre"] == "veers left", (
        "relative to a straight lane it does"
    )


def test_contacts_soon_after_the_start_use_what_is_known():
    batch = as_doubles(
        scene(
            course(0, 0, heading=EAST, speed=10),
            course(9, 0, heading=EAST, speed=0, appears=2),
        )
    )
    batch |= first_contact(batch)
    collisions = Collisions.of(batch)
    window, certain = collisions.window(collisions.before, WINDOW)
    assert window.shape == (1, WINDOW + 1, 2, 4)
    assert certain.tolist() == [int(batch["before"]) - 2]
    assert window[0, 0, 0, 0] == pytest.approx(2.0)
    late = course(5.5, 0, heading=EAST, speed=5, appears=2)  # a step before the contact
    assert words(course(0, 0, heading=EAST, speed=8), late)[1:] == (
        "keeps speed",
        "keeps speed",
    )
    assert words(
        course(0, 0, heading=EAST, speed=8),
        course(5.5, 0, heading=EAST, speed=5, appears=5),
    )[1:] == ("", "")  # at its birth: none


def test_speeds_just_above_and_below_the_thresholds():
    still = torch.zeros(1, WINDOW + 1, 1, 4, dtype=torch.float64)
    steps = torch.arange(WINDOW + 1, dtype=torch.float64)
    for gain, word in (
        (1.2, "accelerates"),
        (0.8, "keeps speed"),
        (-0.8, "keeps speed"),
        (-1.2, "brakes"),
    ):
        window = still.clone()
        window[0, :, 0, 3] = 10 + gain * 0.1 * (steps - WINDOW + LATE).clamp(min=0)
        result = manoeuvre(window, torch.tensor([WINDOW]), lanes=window[..., 2])
        assert MANOEUVRES[result.item()] == word


def word_of(speed):
    """The manoeuvre of a vehicle with these speeds [21], straight on along its lane."""
    window = torch.zeros(1, 21, 2, 4, dtype=torch.float64)
    window[0, :, :, 3] = speed[:, None]
    index = manoeuvre(window, torch.tensor([20]), lanes=window[..., 2])
    return MANOEUVRES[index[0, 0].item()]


@pytest.mark.parametrize(("speed", "word"), [(0.49, "stands"), (0.51, "keeps speed")])
def test_a_vehicle_stands_below_half_a_metre_a_second(speed, word):
    assert word_of(torch.full((21,), speed)) == word


@pytest.mark.parametrize(("first", "word"), [(8, "keeps speed"), (12, "brakes")])
def test_the_acceleration_is_that_of_the_last_second(first, word):
    """10 steps are left of the 21: who brakes within two steps before or in it."""
    speed = torch.full((21,), 10.0)
    speed[first:] = 9.5
    speed[first + 1 :] = 8.0
    assert word_of(speed) == word


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("sideways", "veers"), [(0.45, False), (0.55, True)])
def test_who_moves_half_a_metre_a_second_across_its_lane_veers(sideways, veers, sign):
    window = torch.zeros(1, 21, 2, 4, dtype=torch.float64)
    window[..., 3] = 10.0
    lanes = torch.full((1, 21, 2), -sign * math.asin(sideways / 10)).double()
    index = manoeuvre(window, torch.tensor([20]), lanes=lanes)
    side = "left" if sign > 0 else "right"
    expected = f"veers {side}" if veers else "keeps speed"
    assert MANOEUVRES[index[0, 0].item()] == expected


@pytest.mark.parametrize(
    ("speed", "word"), [(15.0, "keeps speed"), (18.0, "veers left")]
)
def test_a_bend_s_direction_is_looked_up_every_0_4_s(speed, word):
    """The vehicle turns by 0.2 rad/s and is 0.15 s ahead of the last look, in the mean:
    it seems to move across its lane by 0.15 s times its lateral acceleration of 3.0 or
    3.6 m/s^2."""
    radius = speed / 0.2
    angle = torch.linspace(-0.2, 2.0, 2000, dtype=torch.float64)
    lane = radius * torch.stack([angle.sin(), 1 - angle.cos()], -1)
    start = 4.0 * (speed - 4.0) / radius
    ahead = drive(
        radius * math.sin(start),
        radius * (1 - math.cos(start)),
        start,
        4.0,
        turn=lambda _: 4.0 / radius,
    )
    rollouts = scene(drive(0, 0, EAST, speed, turn=lambda _: 0.2), ahead).replace(
        lane_points=lane[None].float(),
        lane_index=torch.zeros(1, len(lane), dtype=torch.int64),
    )
    assert score_rollouts(rollouts)[0][0]["ego_manoeuvre"] == word
