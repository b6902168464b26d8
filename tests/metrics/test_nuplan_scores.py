"""nuPlan's score: terms of courses for which they are computed by hand, and bounds that
hold for any rollout."""

import math

import pytest
import torch

from e2rl.metrics.contact import first_contact
from e2rl.metrics.nuplan_scores import (
    MULTIPLIERS,
    WEIGHTS,
    comfort,
    nuplan_columns,
)
from e2rl.metrics.score import as_doubles
from e2rl.scenes.recording import CYCLIST, OTHER, VEHICLE
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_contact import course, scene

TERMS = (*MULTIPLIERS, *WEIGHTS)
AWAY = course(0, 400, heading=0, speed=0)  # an agent that nobody meets


def scores(*courses, lanes=None, limit=None, logged=None, length=None, **options):
    """The terms of one rollout; lanes: [(points, width)], by default one along x of 4
    m; length: of the ego."""
    rollouts = scene(*courses, **options)
    if length is not None:
        size = rollouts.size.clone()
        size[:, 0, 0] = length
        rollouts = rollouts.replace(size=size)
    if lanes is not None:
        points = [torch.tensor(line, dtype=torch.float32) for line, _ in lanes]
        index = torch.cat(
            [torch.full((len(line),), number) for number, line in enumerate(points)]
        )
        widths = torch.tensor([[width for _, width in lanes]])
        rollouts = rollouts.replace(
            lane_points=torch.cat(points)[None],
            lane_index=index[None],
            lane_width=widths,
        )
    if logged is not None:
        rollouts = rollouts.replace(
            logged=torch.stack([logged[0]] * len(courses), 1)[None].float()
        )
    if limit is not None:
        rollouts = rollouts.replace(
            speed_limit=torch.full(rollouts.states.shape[:2], float(limit))
        )
    return terms(rollouts)


def terms(rollouts):
    batch = as_doubles(rollouts)
    result = nuplan_columns(batch | first_contact(batch))
    return {
        name: value.tolist()[0] if len(value) == 1 else value
        for name, value in result.items()
    }


def track(x, y, heading, speed):
    """A course by arrays."""
    states = torch.stack(
        [
            torch.as_tensor(value, dtype=torch.float64)
            for value in (x, y, heading, speed)
        ],
        -1,
    )
    return states, torch.ones(len(states), dtype=torch.bool)


def test_alone_on_the_road_all_terms_are_one():
    result = scores(course(0, 0, heading=0, speed=10), AWAY, limit=12)
    assert all(result[name] == pytest.approx(1) for name in (*TERMS, "nuplan_score"))


COLLISIONS = {  # the ego, the other, its kind, lanes; the score of collisions
    "the front bumper": (
        course(0, 0, heading=0, speed=12),
        course(30, 0, heading=0, speed=5),
        VEHICLE,
        0,
    ),
    "a cyclist": (
        course(0, 0, heading=0, speed=12),
        course(30, 0, heading=0, speed=5),
        CYCLIST,
        0,
    ),
    "one object": (
        course(0, 0, heading=0, speed=12),
        course(30, 0, heading=0, speed=0),
        OTHER,
        0.5,
    ),
    "hit from behind": (
        course(0, 0, heading=0, speed=5),
        course(-20, 0, heading=0, speed=10),
        VEHICLE,
        1,
    ),
    "standing": (
        course(0, 0, heading=0, speed=0),
        course(30, 0, heading=math.pi, speed=10),
        VEHICLE,
        1,
    ),
    "beside, within its lane": (
        course(0, 0, heading=0, speed=10),
        course(8, 9.2, heading=-math.pi / 2, speed=8),
        VEHICLE,
        1,
    ),
    "a standing one beside": (
        course(0, 0, heading=0, speed=10),
        course(20, 1.9, heading=0, speed=0),
        VEHICLE,
        0,
    ),
}


@pytest.mark.parametrize("name", COLLISIONS)
def test_whose_fault_a_collision_is(name):
    ego, other, kind, expected = COLLISIONS[name]
    result = scores(ego, other, kinds=[VEHICLE, kind], limit=20)
    assert result["no_ego_at_fault_collisions"] == expected
    assert result["nuplan_score"] <= expected


@pytest.mark.parametrize(("creep", "expected"), [(0.02, 0), (0.049, 0), (0.06, 1)])
def test_a_track_of_at_most_0_05_m_per_s_stands(creep, expected):
    """It touches the side of the ego, which passes in its lane: at fault if it stands,
    else beside within one lane."""
    other = course(18, 3.4 + creep * 1.65, heading=-math.pi / 2, speed=creep)
    result = scores(course(0, 0, heading=0, speed=10), other, limit=20)
    assert result["no_ego_at_fault_collisions"] == expected


def test_an_object_stands_whatever_its_speed():
    """The same side is touched at 8 m/s: a vehicle did that by itself, an object costs
    half the score."""
    ego = course(0, 0, heading=0, speed=10)
    other = course(8, 9.2, heading=-math.pi / 2, speed=8)
    assert (
        scores(ego, other, kinds=[VEHICLE, VEHICLE], limit=20)[
            "no_ego_at_fault_collisions"
        ]
        == 1
    )
    assert (
        scores(ego, other, kinds=[VEHICLE, OTHER], limit=20)[
            "no_ego_at_fault_collisions"
        ]
        == 0.5
    )


def test_two_objects_leave_nothing():
    """max(0, 1 - 2 / (1 + 1))."""
    objects = [course(30, 0, heading=0, speed=0), course(45, 0, heading=0, speed=0)]
    result = scores(
        course(0, 0, heading=0, speed=12),
        *objects,
        kinds=[VEHICLE, OTHER, OTHER],
        limit=20,
    )
    assert result["no_ego_at_fault_collisions"] == 0


def test_beside_it_is_the_ego_s_fault_where_it_is_in_two_lanes():
    """It drives on the border of two lanes; in one that is twice as wide it is not at
    fault."""
    ego = course(0, 2, heading=0, speed=10)
    other = course(0.5, 9, heading=-0.35, speed=10.2)
    two = [([[-500, 0], [500, 0]], 4), ([[-500, 4], [500, 4]], 4)]
    assert scores(ego, other, lanes=two)["no_ego_at_fault_collisions"] == 0
    assert (
        scores(ego, other, lanes=[([[-500, 2], [500, 2]], 8)])[
            "no_ego_at_fault_collisions"
        ]
        == 1
    )


def test_lanes_that_follow_each_other_are_one():
    """The same with the road cut into pieces of 7 m, at each of which the ego is in two
    lanes at a time."""
    ego = course(0, 2, heading=0, speed=10)
    other = course(0.5, 9, heading=-0.35, speed=10.2)
    pieces = [([[x, 2], [x + 7, 2]], 8) for x in range(-21, 200, 7)]
    assert scores(ego, other, lanes=pieces)["no_ego_at_fault_collisions"] == 1
    gaps = [([[x, 2], [x + 6.3, 2]], 8) for x in range(-21, 200, 7)]
    assert scores(ego, other, lanes=gaps)["no_ego_at_fault_collisions"] == 0


def test_a_short_lane_between_two_others_connects_them():
    """Front corners in the lane after it, rear corners in the lane before it: one lane
    all the while."""
    ego = course(0, 2, heading=0, speed=10)
    other = course(0.5, 9, heading=-0.35, speed=10.2)
    pieces = [([[x, 2], [x + 3, 2]], 8) for x in range(-21, 200, 3)]
    assert scores(ego, other, lanes=pieces)["no_ego_at_fault_collisions"] == 1


def test_lanes_that_follow_each_other_are_not_one_against_their_direction():
    """Pieces drawn the other way: where the ego is in two, the one ahead does not
    follow the one behind."""
    ego = course(0, 2, heading=0, speed=10)
    other = course(0.5, 9, heading=-0.35, speed=10.2)
    pieces = [([[x + 3, 2], [x, 2]], 8) for x in range(-21, 200, 3)]
    assert scores(ego, other, lanes=pieces)["no_ego_at_fault_collisions"] == 0


@pytest.mark.parametrize(
    ("y", "expected"), [(1.0, 1), (1.25, 1), (1.35, 0), (-1.35, 0)]
)
def test_a_corner_may_be_0_3_m_outside(y, expected):
    """The lane reaches to 2 m; the ego is 2 m wide."""
    assert (
        scores(course(0, y, heading=0, speed=10), AWAY)["drivable_area_compliance"]
        == expected
    )


@pytest.mark.parametrize(
    ("speed", "expected"), [(1.7, 1), (1.9, 0.5), (5.3, 0.5), (5.6, 0)]
)
def test_metres_against_the_lane_within_a_second(speed, expected):
    """The devkit sums the last 11 steps, so that 1.1 s of driving count."""
    result = scores(course(100, 0, heading=math.pi, speed=speed), AWAY)
    assert result["driving_direction_compliance"] == expected
    assert (
        scores(course(100, 0, heading=0, speed=speed), AWAY)[
            "driving_direction_compliance"
        ]
        == 1
    )


@pytest.mark.parametrize(("gap", "expected"), [(9.6, 1), (9.4, 1), (8.9, 0)])
def test_time_to_collision(gap, expected):
    """At a closing speed of 10 m/s the last projection that counts is 0.9 s ahead,
    where 9 m are gone. The vehicle ahead drives off before the ego is there."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    ahead = track(
        4.8 + gap + 10 * (time > 0.05) * time,
        0 * time,
        heading=0 * time,
        speed=10.0 * (time > 0.05),
    )
    assert (
        scores(course(0, 0, heading=0, speed=10), ahead)[
            "time_to_collision_within_bound"
        ]
        == expected
    )


@pytest.mark.parametrize(("degrees", "expected"), [(0, 0), (21, 0), (29, 0), (31, 1)])
def test_time_to_collision_looks_30_degrees_to_each_side_of_ahead(degrees, expected):
    """One that is 8 m from the ego's rear axle drives across for a step at the velocity
    that would meet the ego's front 0.4 s later; the ego is in one lane."""
    angle = math.radians(degrees)
    axle = -1.461 / 5.176 * 4.8
    x = axle + 8 * math.cos(angle)
    y = 8 * math.sin(angle)
    time = torch.arange(81, dtype=torch.float64) * 0.1
    heading = math.atan2(-y, 2.0 - x)
    speed = math.hypot(y, 2.0 - x) / 0.4
    other = track(
        x + 0 * time,
        y + 0 * time,
        heading=heading + 0 * time,
        speed=torch.where(time < 0.05, speed, 0.0),
    )
    standing = course(0, 0, heading=0, speed=0.01)
    assert scores(standing, other)["time_to_collision_within_bound"] == expected


def test_time_to_collision_projects_who_reverses_forwards():
    """The devkit moves each by the magnitude of its velocity along its heading."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    away = torch.where(time < 0.05, -9.0, 0.0)
    other = track(10 + 0 * time, 0 * time, heading=math.pi + 0 * time, speed=away)
    assert (
        scores(course(0, 0, heading=0, speed=0.01), other)[
            "time_to_collision_within_bound"
        ]
        == 0
    )


def test_time_to_collision_takes_objects_as_standing():
    time = torch.arange(81, dtype=torch.float64) * 0.1
    near = track(
        10 + 0 * time,
        0 * time,
        heading=math.pi + 0 * time,
        speed=torch.where(time < 0.05, 9.0, 0.0),
    )
    ego = course(0, 0, heading=0, speed=0.01)
    assert (
        scores(ego, near, kinds=[VEHICLE, VEHICLE])["time_to_collision_within_bound"]
        == 0
    )
    assert (
        scores(ego, near, kinds=[VEHICLE, OTHER])["time_to_collision_within_bound"] == 1
    )


def test_time_to_collision_looks_beside_in_two_lanes_alone():
    """One 6 m to the left, level with the ego's front and closing at 6.5 m/s, turns
    away before it is there."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    near = track(
        3 + 10 * time,
        8 + 0 * time,
        heading=torch.where(time < 0.15, -0.6, 0.0),
        speed=torch.full_like(time, 12.0),
    )
    two = [([[-500, 0], [500, 0]], 4), ([[-500, 4], [500, 4]], 4)]
    assert (
        scores(course(0, 2, heading=0, speed=10), near, lanes=two)[
            "time_to_collision_within_bound"
        ]
        == 0
    )
    first = [([[-500, 2], [500, 2]], 8)]
    assert (
        scores(course(0, 2, heading=0, speed=10), near, lanes=first)[
            "time_to_collision_within_bound"
        ]
        == 1
    )


@pytest.mark.parametrize(
    ("speed", "progress", "moving"),
    [(10, 1, 1), (12, 1, 1), (5, 0.5, 1), (1.9, 0.19, 0)],
)
def test_progress_is_the_fraction_of_the_recorded_distance(speed, progress, moving):
    result = scores(
        course(0, 0, heading=0, speed=speed),
        AWAY,
        logged=course(0, 0, heading=0, speed=10),
    )
    assert result["ego_progress_along_expert_route"] == pytest.approx(
        progress, abs=1e-6
    )
    assert result["ego_is_making_progress"] == moving


@pytest.mark.parametrize(
    ("recorded", "driven", "progress", "making"),
    [
        (0.9, 0.0, 1, 1),
        (1.9, 0.0, 1, 1),
        (4.0, 0.0, 0.5, 1),
        (4.0, 3.0, 0.75, 1),
        (9.0, 0.0, 2 / 9, 1),
        (11.0, 0.0, 2 / 11, 0),
    ],
)
def test_distances_below_2_m_count_as_2_m(recorded, driven, progress, making):
    """min(1, max(driven, 2) / max(recorded, 2)); a fifth of it is progress."""
    result = scores(
        course(0, 0, heading=0, speed=driven / 8),
        AWAY,
        logged=course(0, 0, heading=0, speed=recorded / 8),
    )
    assert result["ego_progress_along_expert_route"] == pytest.approx(
        progress, abs=1e-5
    )
    assert result["ego_is_making_progress"] == making


@pytest.mark.parametrize(("back", "expected"), [(1.9, 2 / 4), (2.1, 0)])
def test_more_than_2_m_backwards_is_no_progress(back, expected):
    """Of 4 m that were recorded."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    ego = track(
        -back * time / 8, 0 * time, heading=0 * time, speed=-back / 8 + 0 * time
    )
    result = scores(ego, AWAY, logged=course(0, 0, heading=0, speed=0.5))
    assert result["ego_progress_along_expert_route"] == pytest.approx(
        expected, abs=1e-5
    )


def test_where_the_recorded_ego_stands_progress_is_whole():
    result = scores(
        course(0, 0, heading=0, speed=5), AWAY, logged=course(0, 0, heading=0, speed=0)
    )
    assert result["ego_progress_along_expert_route"] == 1


@pytest.mark.parametrize(
    ("limit", "expected"), [(10, 1), (9, 1 - 81 / 80 / 2.23), (7, 0), (0, 1)]
)
def test_speeding(limit, expected):
    """The integral over time of the speed beyond the limit, by 2.23 m/s times the
    duration; 81 steps in 8 s."""
    assert scores(course(0, 0, heading=0, speed=10), AWAY, limit=limit)[
        "speed_limit_compliance"
    ] == pytest.approx(expected)


def test_speeding_is_unknown_without_limits():
    result = scores(course(0, 0, heading=0, speed=10), AWAY)
    assert math.isnan(result["speed_limit_compliance"])
    assert math.isnan(result["nuplan_score"])


@pytest.mark.parametrize(
    ("accel", "turn", "expected"),
    [
        (2.3, 0, 1),
        (2.5, 0, 0),
        (-3.9, 0, 1),
        (-4.2, 0, 0),
        (0, 0.55, 1),
        (0, -0.9, 1),
        (0, 0.97, 0),
        (0, -0.97, 0),
    ],
)
def test_comfort_of_constant_motion(accel, turn, expected):
    """Constant acceleration from 35 m/s, and constant turns at 9.5 m/s, whose lateral
    acceleration of 5.2 m/s^2 at 0.55 rad/s is above the devkit's bound of 4.89: its
    simulated ego has none, so it never counts."""
    speed = 35.0 if accel < 0 else 9.5
    states, valid = course(0, 0, heading=0, speed=speed, accel=accel)
    time = torch.arange(len(states), dtype=torch.float64) * 0.1
    if turn:
        radius = speed / turn
        states, valid = track(
            radius * (turn * time).sin(),
            radius * (1 - (turn * time).cos()),
            heading=turn * time,
            speed=states[:, 3],
        )
    assert scores((states, valid), AWAY)["ego_is_comfortable"] == expected


@pytest.mark.parametrize(("length", "expected"), [(10.0, 1), (11.0, 0)])
def test_the_centre_s_acceleration_grows_with_its_distance_to_the_rear_axle(
    length, expected
):
    """d w^2 at 0.9 rad/s, d = 1.461 / 5.176 of the length: 2.29 and 2.52 m/s^2, bound
    2.40."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    radius = 5.0 / 0.9
    ego = track(
        radius * (0.9 * time).sin(),
        radius * (1 - (0.9 * time).cos()),
        heading=0.9 * time,
        speed=5.0 + 0 * time,
    )
    assert scores(ego, AWAY, length=length)["ego_is_comfortable"] == expected


@pytest.mark.parametrize(("length", "expected"), [(1.0, 1), (4.8, 0)])
def test_swaying_jerks_the_centre(length, expected):
    """Heading 0.25 sin(2.5 t): 0.63 rad/s and 1.56 rad/s^2 are within bounds; the
    centre's d d^2w/dt^2, 3.9 m/s^3 times d in m, is not for a car."""
    time = torch.arange(81, dtype=torch.float64) * 0.1
    ego = track(
        5 * time, 0 * time, heading=0.25 * (2.5 * time).sin(), speed=5.0 + 0 * time
    )
    assert scores(ego, AWAY, length=length)["ego_is_comfortable"] == expected


def test_a_jerk_is_uncomfortable_where_its_acceleration_is_not():
    time = torch.arange(81, dtype=torch.float64) * 0.1
    accel = 2.0 * torch.sin(
        2 * math.pi * time / 2.0
    )  # m/s^2, with a jerk of up to 6.3 m/s^3
    speed = 10 + torch.cat(
        [torch.zeros(1, dtype=torch.float64), accel[:-1].cumsum(0) * 0.1]
    )
    states = track(
        torch.cat([torch.zeros(1), speed[:-1].cumsum(0) * 0.1]),
        0 * time,
        heading=0 * time,
        speed=speed,
    )
    slow = track(
        states[0][:, 0], 0 * time, heading=0 * time, speed=10 + (speed - 10) / 2
    )
    assert scores(states, AWAY)["ego_is_comfortable"] == 0
    assert scores(slow, AWAY)["ego_is_comfortable"] == 1


def test_the_score_is_the_product_of_multipliers_and_the_weighted_mean():
    """Half the recorded way, and 1 m/s too fast throughout: (5 + 5 / 2 + 4 * s + 2) /
    16."""
    result = scores(
        course(0, 0, heading=0, speed=5),
        AWAY,
        limit=4,
        logged=course(0, 0, heading=0, speed=10),
    )
    assert result["nuplan_score"] == pytest.approx(
        (5 + 2.5 + 4 * (1 - 81 / 80 / 2.23) + 2) / 16, abs=1e-6
    )


def test_terms_are_in_0_to_1_and_rows_do_not_depend_on_the_batch():
    rollouts = random_rollouts(12, seed=4).replace(
        speed_limit=torch.full((12, 81), 9.0)
    )
    result = terms(rollouts)
    for name, value in result.items():
        certain = value[~value.isnan()]
        assert len(certain)
        assert bool(((certain >= 0) & (certain <= 1)).all()), name
    for index in range(12):
        alone = terms(rollouts[index : index + 1])
        assert {name: alone[name] for name in alone} == pytest.approx(
            {name: value[index].item() for name, value in result.items()}, nan_ok=True
        )


def test_a_map_without_lanes_has_scores():
    rollouts = scene(course(0, 0, heading=0, speed=10), AWAY)
    rollouts = rollouts.replace(
        lane_points=torch.zeros(1, 0, 2),
        lane_index=torch.zeros(1, 0, dtype=torch.int64),
        lane_width=torch.zeros(1, 0),
    )
    assert set(TERMS) <= set(terms(rollouts))


@pytest.mark.parametrize(("degrees", "expected"), [(148, 0), (152, 1)])
def test_who_comes_from_more_than_150_degrees_is_behind(degrees, expected):
    """Measured at the rear axle of an ego in two lanes, whose rear corner is hit."""
    axle = -1.461 / 5.176 * 4.8
    time = torch.arange(81, dtype=torch.float64) * 0.1
    x = axle + 1.5 / math.tan(math.radians(degrees)) + 10 * time
    y = torch.where(time < 0.05, 40.0, 2.0 + 1.5)
    two = [([[-500, 0], [500, 0]], 4), ([[-500, 4], [500, 4]], 4)]
    result = scores(
        course(0, 2, heading=0, speed=10),
        track(x, y, heading=0 * time, speed=10.0 + 0 * time),
        lanes=two,
    )
    assert result["no_ego_at_fault_collisions"] == expected


@pytest.mark.parametrize(("gap", "expected"), [(0.45, 1), (0.55, 0)])
def test_a_lane_follows_another_within_half_a_metre(gap, expected):
    """The road is cut into pieces of 7 m less a gap; one lane all the while, or two."""
    ego = course(0, 2, heading=0, speed=10)
    other = course(0.5, 9, heading=-0.35, speed=10.2)
    pieces = [([[x, 2], [x + 7 - gap, 2]], 8) for x in range(-21, 200, 7)]
    result = scores(ego, other, lanes=pieces)
    assert result["no_ego_at_fault_collisions"] == expected


@pytest.mark.parametrize(("speed", "expected"), [(0.0045, 1), (0.0055, 0)])
def test_time_to_collision_has_an_ego_faster_than_5_mm_per_s(speed, expected):
    time = torch.arange(81, dtype=torch.float64) * 0.1
    near = track(
        10 + 0 * time,
        0 * time,
        heading=math.pi + 0 * time,
        speed=torch.where(time < 0.05, 9.0, 0.0),
    )
    result = scores(course(0, 0, heading=0, speed=speed), near)
    assert result["time_to_collision_within_bound"] == expected


def comfort_of(accel, yaw_rate=None, length=0.0):
    """Whether accelerations m/s^2 and yaw rates rad/s of steps [T] are comfortable, of
    a vehicle of a length."""
    ego = torch.zeros(1, len(accel) + 1, 4, dtype=torch.float64)
    if yaw_rate is not None:
        ego[0, 1:, 2] = 0.1 * yaw_rate.cumsum(0)
    ego[0, 1:, 3] = 0.1 * accel.cumsum(0)
    ego[..., 3] += 20.0
    return comfort(ego, torch.tensor([length], dtype=torch.float64)).item()


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("rate", "expected"), [(1.9, 1), (1.96, 0)])
def test_a_yaw_rate_changes_by_up_to_1_93_rad_s2(rate, expected, sign):
    """From -0.75 to 0.75 rad/s or back; the centre is the rear axle."""
    time = 0.1 * torch.arange(8, dtype=torch.float64)
    yaw_rate = sign * rate * (time - 0.35)
    assert comfort_of(0 * time, yaw_rate) == expected


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("jerk", "expected"), [(4.0, 1), (4.3, 0)])
def test_an_acceleration_along_the_vehicle_changes_by_up_to_4_13_m_s3(
    jerk, expected, sign
):
    """Straight on, from braking to accelerating or back, for as long as the filter's
    window of 1.5 s."""
    time = 0.1 * torch.arange(45, dtype=torch.float64)
    accel = (jerk * (time - 1.5) - 3.9).clamp(-3.9, 2.2)
    if sign < 0:
        accel = accel.flip(0)
    assert comfort_of(accel) == expected


@pytest.mark.parametrize(("jerk", "expected"), [(8.2, 1), (8.8, 0)])
def test_an_acceleration_grows_by_up_to_8_37_m_s3(jerk, expected):
    """At the rear axle of a vehicle whose turn takes back, 5 m ahead at its centre,
    what the axle gains."""
    time = 0.1 * torch.arange(9, dtype=torch.float64)
    accel = jerk * time
    yaw_rate = 0.4 - 0.1 * accel.cumsum(0) / 5
    assert comfort_of(accel, yaw_rate, length=5 * 5.176 / 1.461) == expected


@pytest.mark.parametrize(("jerk", "expected"), [(8.2, 1), (9.2, 0)])
def test_a_braking_eases_by_up_to_8_37_m_s3(jerk, expected):
    """The same vehicle, whose braking of 3.9 m/s^2 ends within half a second; the
    filter overshoots where it ends."""
    time = 0.1 * torch.arange(7, dtype=torch.float64)
    accel = (jerk * time - 3.9).clamp(max=0)
    yaw_rate = -0.1 * (accel + 3.9).cumsum(0) / 5
    assert comfort_of(accel, yaw_rate, length=5 * 5.176 / 1.461) == expected
