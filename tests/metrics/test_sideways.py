"""Whose fault a collision is where somebody moves across its lane, and what a vehicle
that reverses is taken for."""

import math

import pytest
import torch

from e2rl.metrics.contact import FRONT, SIDE
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.sideways import lanes_along, moved_into, moved_within
from tests.metrics.pairs import LENGTH, WIDTH, lane, pair, straight
from tests.metrics.test_contact import course, scene
from tests.metrics.test_failure_features import drive

EAST = 0.0
NORTH = math.pi / 2
WEST = math.pi
SOUTH = -math.pi / 2
LANES = (-3.5, 0.0, 3.5)  # y of lanes to the east
VERDICT = ("cfr", "at_fault", "duty", "approach")


def with_lanes(rollouts, *lines):
    """The rollouts with lanes through lines [n, 2], a point every metre."""
    points = torch.cat(lines)[None].float().expand(len(rollouts), -1, -1)
    index = torch.cat([torch.full((len(line),), k) for k, line in enumerate(lines)])[
        None
    ].expand(len(rollouts), -1)
    width = torch.full((len(rollouts), len(lines)), 3.5)
    return rollouts.replace(lane_points=points, lane_index=index, lane_width=width)


def straight_lanes(*heights):
    x = torch.arange(-100.0, 300.0)
    return [torch.stack([x, torch.full_like(x, y)], -1) for y in heights]


def verdict(ego, partner, lines=None):
    rollouts = with_lanes(
        scene(ego, partner), *(straight_lanes(*LANES) if lines is None else lines)
    )
    return score_rollouts(rollouts)[0][0]


def moving_over(
    x, y, speed, across, begin=2.0, lasts=10.0, heading=EAST, steps=80, reverses=False
):
    """A course [T+1, 4] that moves `across` m/s to its left from `begin` s on for
    `lasts` s, its nose along its motion; reverses: its nose looks backwards."""
    time = 0.1 * torch.arange(steps + 1, dtype=torch.float64)
    aside = across * (time - begin).clamp(0, lasts)
    along = speed * time
    slanted = (time >= begin) & (time <= begin + lasts)
    slant = torch.where(slanted, math.atan2(across, speed), 0.0)
    cos = math.cos(heading)
    sin = math.sin(heading)
    pace = torch.hypot(torch.full_like(time, speed), across * slanted)
    states = [
        x + along * cos - aside * sin,
        y + along * sin + aside * cos,
        heading + slant,
        pace,
    ]
    if reverses:
        states[2], states[3] = states[2] + math.pi, -pace
    return torch.stack(states, -1), torch.ones(steps + 1, dtype=torch.bool)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("ahead", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("across", [0.3, 1.0, 2.0])
def test_an_ego_that_changes_lanes_into_a_car_that_keeps_its_lane_is_at_fault(
    side, ahead, across
):
    result = verdict(
        moving_over(0, 0, speed=12, across=side * across),
        course(ahead, side * 3.5, heading=EAST, speed=12),
    )
    assert (result["cfr"], result["at_fault"], result["counted"], result["duty"]) == (
        1,
        1,
        1,
        "none",
    )
    assert result["approach"] == (
        "beside on the left" if side > 0 else "beside on the right"
    )


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("ahead", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("across", [0.3, 1.0, 2.0])
def test_a_car_that_changes_lanes_into_the_ego_is(side, ahead, across):
    result = verdict(
        course(0, 0, heading=EAST, speed=12),
        moving_over(ahead, side * 3.5, speed=12, across=-side * across),
    )
    assert (result["cfr"], result["at_fault"], result["duty"]) == (1, 0, "entry")


@pytest.mark.parametrize(
    ("own", "others", "fault"),
    [(1.0, 1.0, 1), (1.0, 0.4, 1), (0.4, 1.0, 0), (0.6, 1.0, 1)],
)
def test_where_both_move_into_a_lane_both_are_but_for_a_drift_beside_a_lane_change(
    own, others, fault
):
    """From the outer lanes into the middle one; a drift is less than half as fast."""
    ego = moving_over(0, -3.5, speed=12, across=own, lasts=5.0)
    partner = moving_over(0, 3.5, speed=12, across=-others, lasts=5.0)
    result = verdict(ego, partner)
    assert (result["cfr"], result["at_fault"]) == (1, fault)
    assert (result["duty"] == "entry") == (others > 0.5)


def test_who_drifts_within_its_lane_into_a_car_at_the_lane_s_edge_is_at_fault():
    """Lane width 3.5 m, cars 2.0 m: the partner keeps 0.7 m off its lane's middle, the
    ego drifts 0.9 m at 0.25 m/s."""
    drifts = moving_over(0, 0, speed=12, across=0.25, lasts=3.6)
    assert verdict(drifts, course(0, 2.8, heading=EAST, speed=12))["at_fault"] == 1
    keeps = course(0, 0.7, heading=EAST, speed=12)
    result = verdict(keeps, moving_over(0, 3.5, speed=12, across=-0.25, lasts=3.6))
    assert (result["cfr"], result["at_fault"]) == (1, 0)


def bend(radius, steps=80, speed=10.0, drift=0.0, begin=2.0):
    """A course [T+1, 4] to the left on a circle about (0, 0) from its lowest point,
    drifting outwards."""
    time = 0.1 * torch.arange(steps + 1, dtype=torch.float64)
    radii = radius + drift * (time - begin).clamp(min=0)
    angle = (speed / radii * 0.1).cumsum(0) - speed / radius * 0.1 - math.pi / 2
    slant = torch.where(time >= begin, math.atan2(drift, speed), 0.0)
    states = [
        radii * angle.cos(),
        radii * angle.sin(),
        angle + math.pi / 2 - slant,
        torch.full_like(time, speed),
    ]
    return torch.stack(states, -1), torch.ones(steps + 1, dtype=torch.bool)


def rings(*radii):
    return [
        r * torch.stack([angle.cos(), angle.sin()], -1)
        for r in radii
        for angle in [torch.arange(-math.pi, math.pi, 1.0 / r)]
    ]


@pytest.mark.parametrize(("own", "others", "fault"), [(1.0, 0.0, 1), (0.0, -1.0, 0)])
def test_in_a_bend_who_leaves_its_lane_is_at_fault_although_both_turn(
    own, others, fault
):
    """The ego is carried outwards; or its neighbour, as fast in angle, comes inwards."""
    ego = bend(40.0, speed=10.0, drift=own)
    partner = bend(43.5, speed=10.9, drift=others)
    result = verdict(ego, partner, lines=rings(40.0, 43.5))
    assert (result["cfr"], result["at_fault"]) == (1, fault)


@pytest.mark.parametrize("reverses", [False, True])
def test_who_comes_out_of_a_driveway_cuts_in_whichever_way_its_nose_looks(reverses):
    partner = course(30, -1.6 - 2.0 * 3.6, heading=NORTH, speed=2.0)
    if reverses:
        partner[0][:, 2], partner[0][:, 3] = SOUTH, -2.0
    result = verdict(
        course(0, 0, heading=EAST, speed=8), partner, lines=straight_lanes(0.0, 3.5)
    )
    expected = {
        "cfr": 1,
        "at_fault": 0,
        "counted": 0,
        "partner_speed": 2.0,
        "relvel": math.hypot(8, 2),
    }
    assert {name: result[name] for name in expected} == pytest.approx(expected)
    assert (result["partner_manoeuvre"], result["duty"]) == ("keeps speed", "none")
    assert result["approach"] == "crossing from the right"


def test_a_car_that_reverses_towards_the_ego_in_its_lane_is_judged_as_one_that_comes_towards_it():
    """At 2 m/s, from 60 m on: the competent driver brakes, and is struck where it
    stands."""
    backs = course(60, 0, heading=WEST, speed=2.0)
    comes = course(60, 0, heading=WEST, speed=2.0)
    backs[0][:, 2], backs[0][:, 3] = EAST, -2.0
    names = (
        "cfr",
        "at_fault",
        "preventable",
        "preventable_rss",
        "duty",
        "approach",
        "relvel",
        "partner_speed",
        "margin",
    )
    rows = [
        verdict(course(0, 0, heading=EAST, speed=10), partner)
        for partner in (backs, comes)
    ]
    assert {name: rows[0][name] for name in names} == pytest.approx(
        {name: rows[1][name] for name in names}
    )
    assert (rows[0]["at_fault"], rows[0]["duty"], rows[0]["approach"]) == (
        0,
        "wrong way",
        "oncoming",
    )


def test_an_ego_that_runs_into_a_car_that_reverses_away_from_it_is_judged_by_its_motion():
    """The car backs away from the ego, at 3 m/s, slower than the ego comes: a leader as
    any other."""
    away = course(30, 0, heading=EAST, speed=3.0)
    leads = course(30, 0, heading=EAST, speed=3.0)
    away[0][:, 2], away[0][:, 3] = WEST, -3.0
    rows = [
        verdict(course(0, 0, heading=EAST, speed=10), partner)
        for partner in (away, leads)
    ]
    for row in rows:
        assert (row["at_fault"], row["preventable"], row["duty"], row["approach"]) == (
            1,
            1,
            "none",
            "ahead",
        )


def test_an_ego_that_reverses_leads_with_its_rear():
    """Into a car behind it that is slower; one that comes from the other side hits its
    trailing front."""
    backs = course(0, 0, heading=WEST, speed=2.0)
    backs[0][:, 2], backs[0][:, 3] = EAST, -2.0
    westwards = [line.flip(0) for line in straight_lanes(0.0)]
    result = verdict(backs, course(-12, 0, heading=WEST, speed=0.5), lines=westwards)
    assert (result["contact_type"], result["at_fault"], result["duty"]) == (
        "rear",
        1,
        "none",
    )
    assert result["ego_speed"] == pytest.approx(2.0)
    result = verdict(backs, course(15, 0, heading=WEST, speed=6.0), lines=westwards)
    assert (result["contact_type"], result["at_fault"], result["duty"]) == (
        "front",
        0,
        "rear-end",
    )


def test_an_ego_that_turns_round_into_the_next_lane_is_at_fault_and_a_car_that_does_before_it_is_not():
    """Half a second after it has crossed the line; an ego that could see it turn for
    longer has to stop."""
    turns = drive(20, 0, EAST, 5, turn=lambda t: 0.8 if t > 2.2 else 0.0)
    result = verdict(
        turns, course(0, 3.5, heading=EAST, speed=9), lines=straight_lanes(0.0, 3.5)
    )
    assert (result["cfr"], result["at_fault"], result["duty"]) == (1, 1, "none")
    result = verdict(
        course(0, 3.5, heading=EAST, speed=9), turns, lines=straight_lanes(0.0, 3.5)
    )
    assert (result["cfr"], result["at_fault"]) == (1, 0)


@pytest.mark.parametrize(("turns", "counted"), [(True, 0), (False, 1)])
def test_a_standing_car_that_turns_on_the_spot_makes_no_failure_that_counts(
    turns, counted
):
    """2.3 m beside the ego's way; or aslant from the start, where it has to be passed
    with more room."""
    states, valid = course(40, 2.3, heading=EAST, speed=0)
    slant = torch.linspace(0, 0.8, 81, dtype=torch.float64)
    states[:, 2] = slant if turns else 0.5
    result = verdict(course(0, 0, heading=EAST, speed=9), (states, valid))
    assert (result["cfr"], result["at_fault"], result["counted"]) == (
        1,
        counted,
        counted,
    )


def test_a_cyclist_s_or_nobody_s_contact_is_no_movement_into_anybody():
    result = verdict(
        course(0, 0, heading=EAST, speed=9), course(0, 30, heading=EAST, speed=9)
    )
    assert result["cfr"] == 0
    assert math.isnan(result["at_fault"])
    assert result["duty"] == ""


@pytest.mark.parametrize("placing", range(5))
@pytest.mark.parametrize("speed", [0.6, 1.0, 2.0])
def test_a_standing_car_whose_heading_jitters_is_run_into_all_the_same(speed, placing):
    """The front of the ego meets its rear straight on; its recorded heading changed by
    two degrees."""
    states, valid = course(4.5 + speed * (2.0 + 0.02 * placing), 0, heading=0, speed=0)
    states[5:, 2] = math.radians(2)
    row = verdict(course(0, 0, heading=0, speed=speed), (states, valid))
    assert row["cfr"] == 1
    assert row["counted"] == 1


@pytest.mark.parametrize("radius", [3.3, 3.5, 3.7])
def test_a_u_turn_into_the_lane_of_who_comes_is_at_fault_until_its_nose_has_been_there_for_a_second(
    radius,
):
    """The ego turns from y = 0 into the lane at y = 7, along which somebody comes from
    behind it."""
    speed = 5.0
    begins = 2.0
    time = 0.1 * torch.arange(81, dtype=torch.float64)
    angle = ((time - begins) * speed / radius).clamp(0, math.pi)
    turned = angle * radius
    straight = (speed * time).clamp(max=speed * begins)
    back = (speed * (time - begins) - turned).clamp(min=0)
    x = straight + radius * angle.sin() - back
    ego = torch.stack(
        [x, radius * (1 - angle.cos()), angle, torch.full_like(time, speed)], -1
    )
    contact = int((begins + radius * math.radians(165) / speed) / 0.1)
    meets = ego[contact, 0].item() + 2.4
    partner = course(meets + 14 * 0.1 * contact, 7.0, heading=math.pi, speed=14.0)
    row = verdict(
        (ego, torch.ones(81, dtype=torch.bool)), partner, lines=straight_lanes(0.0)
    )
    assert row["cfr"] == 1
    assert row["at_fault"] == 1
    assert row["duty"] == "none"


def beside_each_other(ego_offset, partner_offset, steps=10):
    """`moved_within` of two vehicles side by side on lanes along +x, which move towards
    each other by these offsets and overlap by 1 mm at the end."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    gap = ego_offset + partner_offset - 1e-3
    zero = torch.zeros_like(share)
    ego = torch.stack([zero, ego_offset * share, zero, zero + 1], -1)
    y = WIDTH + gap - partner_offset * share
    partner = torch.stack([zero, y, zero, zero + 1], -1)
    states = torch.stack([ego, partner], 1)[None]
    size = torch.tensor([LENGTH, WIDTH], dtype=torch.float64).expand(1, 2, 2)
    return moved_within(states, size, lanes=torch.zeros_like(states[..., 0])).tolist()


@pytest.mark.parametrize(("offset", "moved"), [(0.19, False), (0.21, True)])
def test_a_fifth_of_a_metre_is_a_movement(offset, moved):
    assert beside_each_other(offset, 0.0) == [[moved, False]]


@pytest.mark.parametrize(("share", "moved"), [(0.48, False), (0.52, True)])
def test_who_moves_half_as_far_as_the_other_moved_too(share, moved):
    assert beside_each_other(share * 1.0, 1.0) == [[moved, True]]


@pytest.mark.parametrize(
    ("kind", "first", "moved"),
    [
        (FRONT, 10, True),
        (FRONT, 12, False),
        (SIDE, 20, True),
        (SIDE, 22, False),
    ],
)
def test_a_movement_is_of_the_last_second_or_of_two_at_the_ego_s_side(
    kind, first, moved
):
    """The ego moves over `first` steps before the contact and is beside the other's
    strip no longer after that step."""
    stop = 60
    ego = straight(0, 0, heading=EAST, speed=10)
    ego[stop - first + 1 :, 1] = 0.5
    partner = straight(0, WIDTH + 0.4, heading=EAST, speed=10)
    lines = lane(*((float(x), 0.0) for x in range(-10, 110, 2)))
    result = moved_into(pair(ego, partner, stop, kind=kind, lanes=lines))
    assert result.tolist() == [[moved, False]]


@pytest.mark.parametrize(("steps", "moved"), [(39, True), (41, False)])
def test_a_lane_is_remembered_for_four_seconds(steps, moved):
    """The ego leaves its lane and drives on at an angle to it, where no lane is: it
    moves across the lane, and after it is forgotten not across its own direction."""
    stop = 60
    heading = math.radians(20)
    ego = straight(0, 0, heading=heading, speed=5, at=stop)
    partner = straight(1.0, WIDTH + 0.3, heading=EAST, speed=0)
    last = ego[stop - steps, 0].item()
    lines = lane(*((last - 3.8 - d, ego[stop - steps, 1].item()) for d in (4, 2, 0)))
    result = moved_into(pair(ego, partner, stop, kind=SIDE, lanes=lines))
    assert result[0, 0].item() is moved


def lane_of(angle=0.0, offset=0.0, lanes=None):
    """Heading of the lane of a vehicle at the origin that drives at an angle to a lane
    along +x, `offset` m beside it; None without one."""
    ego = straight(0, offset, heading=angle, speed=0)
    lines = lanes or lane(*((float(x), 0.0) for x in range(-10, 12, 1)))
    moments = pair(ego, ego, 5, lanes=lines).states[:, :1]
    heading, certain = lanes_along(pair(ego, ego, 5, lanes=lines), moments)
    return heading[0, 0, 0].item() if certain[0, 0, 0] else None


@pytest.mark.parametrize(("offset", "expected"), [(3.95, 0.0), (4.05, None)])
def test_a_lane_is_a_vehicle_s_within_4_m(offset, expected):
    assert lane_of(offset=offset) == expected


@pytest.mark.parametrize(("degrees", "expected"), [(44, 0.0), (46, None)])
def test_a_lane_is_a_vehicle_s_within_45_degrees(degrees, expected):
    assert lane_of(angle=math.radians(degrees)) == expected


@pytest.mark.parametrize(("beside", "expected"), [(1.5, 0.0), (1.7, 0.4)])
def test_a_radian_weighs_as_much_as_4_m(beside, expected):
    """A lane through the vehicle at 0.4 rad, which is as good as one 1.6 m beside."""
    slanted = [(s * math.cos(0.4), s * math.sin(0.4)) for s in range(-4, 5)]
    parallel = [(float(x), beside) for x in range(-4, 5)]
    points = torch.tensor([slanted + parallel], dtype=torch.float64)
    index = torch.tensor([[0] * 9 + [1] * 9])
    assert lane_of(lanes=(points, index)) == pytest.approx(expected)
