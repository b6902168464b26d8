"""Bounds: feasible plans stay as they are; whoever runs into somebody brakes just
enough, and nobody else does."""

import math

import pytest
import torch

from e2rl.prior import lane_relative
from e2rl.prior.bounds import (
    NO_CAP,
    BoundSettings,
    Duty,
    Meeting,
    Obstacles,
    acceleration_caps,
    apply_cap,
    bounded,
    meeting_braking,
)
from e2rl.prior.lane_relative import SIZE, locate
from e2rl.scenes.recording import DT
from tests.prior.small import arc

CAR = (4.0, 2.0)
# The values of docs/method.md.
GAP = 1.2
LATERAL_MARGIN = 0.1
MIN_BRAKING = 0.5
ONSET = 2.0
STRIDE = 3


def traffic(
    cars,
    turn=0.0,
    exempt=(),
    yields=(),
    patience=0.0,
):
    """Vehicles (x, y, heading, speed) on routes of curvature `turn`: decode(rows, cap)
    at even speed, state, others.

    exempt, yields: vehicles of such a duty; patience [m/s^2]: see Duty.
    """
    agents = torch.tensor([cars], dtype=torch.float32)
    routes = torch.stack(
        [
            arc(
                x,
                y,
                heading=heading,
                curvature=turn,
            )
            for x, y, heading, _ in cars
        ]
    )[None]
    zero = torch.zeros(1, len(cars))
    state = locate(
        agents,
        zero,
        yaw_rate=zero + turn * agents[..., 3],
        points=routes,
        hint=zero + 20.0,
    )
    size = torch.tensor(CAR).expand(1, len(cars), 2)
    duty = Duty(
        *(torch.zeros(1, len(cars), dtype=torch.bool) for _ in range(2)),
        zero + patience,
    )
    duty.exempt[0, list(exempt)] = True
    duty.yields[0, list(yields)] = True

    def decode(rows=None, cap=None):
        x = torch.zeros(1, len(cars), SIZE)
        if rows is None:
            return lane_relative.decode(x, state, routes)
        x[(*rows, torch.zeros_like(rows[0]))] = cap.clamp(max=0.0)
        return lane_relative.decode(x, state, points=routes).map(
            lambda value: value[rows]
        )

    return (
        decode,
        state,
        Obstacles(
            agents,
            size,
            present=torch.ones(1, len(cars), dtype=torch.bool),
            duty=duty,
        ),
    )


def caps(decode, state, obstacles, **settings):
    return acceleration_caps(
        BoundSettings(**settings),
        decode(),
        state=state,
        obstacles=obstacles,
    )[0]


def contact_time(seconds):
    """The first compared time at or after `seconds`."""
    return STRIDE * DT * math.ceil(seconds / (STRIDE * DT))


def test_plans_that_meet_nobody_are_free():
    decode, state, obstacles = traffic(
        [(0, 0, 0, 10), (30, 0, 0, 10), (0, 3.5, 0, 12), (40, -3.5, math.pi, 9)]
    )
    assert (caps(decode, state, obstacles=obstacles) == NO_CAP).all()
    motion = bounded(
        BoundSettings(),
        decode(),
        capped=decode,
        state=state,
        obstacles=obstacles,
    )
    assert torch.equal(motion.states(), decode().states())


@pytest.mark.parametrize("speed", [0.0, 4.0])
def test_a_follower_brakes_to_its_leader_s_speed_in_the_room_there_is(speed):
    decode, state, obstacles = traffic([(0, 0, 0, 10), (15, 0, 0, speed)])
    cap = caps(decode, state, obstacles=obstacles)
    time = contact_time((15 - CAR[0]) / (10 - speed))
    room = 10 * time - GAP - speed * time
    assert cap.tolist() == pytest.approx(
        [-((10 - speed) ** 2) / (2 * room), NO_CAP], rel=1e-3
    )


def test_braking_is_never_harder_than_the_floor_nor_softer_than_gentle():
    hard = [(0, 0, 0, 15), (8, 0, 0, 0)]
    soft = [(0, 0, 0, 1.0), (6.5, 0, 0, 0)]
    assert caps(*traffic(hard), floor=-5.0)[0] == -5.0
    assert caps(*traffic(soft))[0] == -MIN_BRAKING


def test_of_two_that_cross_the_later_one_brakes():
    decode, state, obstacles = traffic([(-20, 0, 0, 10), (0, -23, math.pi / 2, 10)])
    cap = caps(decode, state, obstacles=obstacles)
    assert cap[0] == NO_CAP
    assert cap[1] < -1


def test_only_an_exempt_vehicle_may_meet_the_ego():
    cars = (12, 0, 0, 0), (0, 0, 0, 10), (-12, 0, 0, 13)
    shy = caps(*traffic(cars))
    bold = caps(*traffic(cars, exempt=[1]))
    assert shy[1] < 0
    assert bold[1] == NO_CAP
    assert bold[2] == shy[2] < 0


def test_who_yields_brakes_for_the_ego_even_where_the_ego_would_have_to():
    crossing = (
        (0, -23, math.pi / 2, 10),
        (-20, 0, 0, 10),
    )  # the ego is later, so it would brake
    assert caps(*traffic(crossing))[1] == NO_CAP
    assert caps(*traffic(crossing, yields=[1]))[1] < -1


def test_a_patient_vehicle_brakes_later_and_harder_and_still_in_time():
    ego = (20.0, 0, 0, 0)
    eager, patient = (
        caps(*traffic([ego, (0.0, 0, 0, 8)], patience=value))[1] for value in (0.0, 6.0)
    )
    assert -6 < eager < 0
    assert patient == NO_CAP
    closer = caps(*traffic([ego, (5.0, 0, 0, 8)], patience=4.0))[1]
    room = 20 - 5 - CAR[0] - GAP
    assert -(8**2) / (2 * (room - 2)) < closer < eager


def test_who_drifts_into_the_ego_s_side_falls_behind_it_in_time():
    ego = (0, 0, 0, 10)
    angle = 0.1
    drifting = (
        2.0,
        -3.0,
        angle,
        10 / math.cos(angle),
    )  # keeps level with the ego and comes nearer at 1 m/s
    time = contact_time(
        (3.0 - CAR[1] - LATERAL_MARGIN - CAR[0] / 2 * math.sin(angle))
        / (10 * math.tan(angle))
    )
    cap = caps(*traffic([ego, drifting], yields=[1]), floor=-50.0)[1]
    assert cap == pytest.approx(-2 * (CAR[0] + GAP + 2.0) / time**2, rel=0.05)
    assert caps(*traffic([ego, drifting], exempt=[1]))[1] == NO_CAP


def test_patience_is_for_the_ego_alone():
    cars = (100, 50, 0, 0), (20.0, 0, 0, 0), (0.0, 0, 0, 8)
    assert caps(*traffic(cars, patience=6.0))[2] == caps(*traffic(cars))[2] < 0


def test_absent_vehicles_are_in_nobody_s_way():
    decode, state, obstacles = traffic([(0, 0, 0, 10), (15, 0, 0, 0)])
    obstacles.present[0, 1] = False
    assert (caps(decode, state, obstacles=obstacles) == NO_CAP).all()


def test_a_pedestrian_without_a_plan_keeps_its_velocity():
    decode, state, obstacles = traffic([(0, 0, 0, 10)])
    walker = torch.tensor([[[20.0, -3.0, math.pi / 2, 1.5]]])
    obstacles = Obstacles(
        torch.cat([obstacles.agents, walker], 1),
        torch.cat([obstacles.size, torch.ones(1, 1, 2)], 1),
        present=torch.ones(1, 2, dtype=torch.bool),
    )
    assert caps(decode, state, obstacles=obstacles)[0] < -1
    obstacles.agents[0, 1, 3] = 0.0
    assert caps(decode, state, obstacles=obstacles)[0] == NO_CAP


def test_a_curve_is_met_at_the_lateral_acceleration_allowed():
    decode, state, obstacles = traffic([(0, 0, 0, 12)], turn=1 / 20.0)
    cap = caps(
        decode,
        state,
        obstacles=obstacles,
        lateral=4.0,
    )[0]
    assert (
        cap == pytest.approx(-(12**2 - 4.0 * 20) / (2 * 12 * STRIDE * DT), rel=0.1)
        or cap == -7.0
    )
    assert (
        caps(
            decode,
            state,
            obstacles=obstacles,
            lateral=8.0,
        )[0]
        == NO_CAP
    )
    assert (
        caps(
            decode,
            state,
            obstacles=obstacles,
            lateral=4.0,
            curve=False,
        )[0]
        == NO_CAP
    )


def test_whoever_follows_a_braking_vehicle_brakes_too():
    decode, state, obstacles = traffic([(20, 0, 0, 0), (0, 0, 0, 12), (-5.0, 0, 0, 12)])
    assert (
        caps(
            decode,
            state,
            obstacles=obstacles,
            look=1.6,
        )[2]
        == NO_CAP
    ), "its plan meets nobody's as they stand"
    motion = bounded(
        BoundSettings(look=1.6),
        decode(),
        capped=decode,
        state=state,
        obstacles=obstacles,
    )
    assert (motion.v <= decode().v + 1e-5).all()
    assert motion.v[0, 2, 10] < 12 - 0.2


def test_a_cap_lowers_the_next_knot_and_at_most_by_its_onset_the_present_acceleration():
    _, state, _ = traffic([(0, 0, 0, 10), (0, 8, 0, 10), (0, 16, 0, 10)])
    state.a = torch.tensor([[1.0, -1.5, -6.0]])
    x0 = torch.tensor([[[0.5] * SIZE, [-3.0] * SIZE, [0.0] * SIZE]])
    capped, after = apply_cap(torch.tensor([[-4.0, -2.0, -5.0]]), x0, state=state)
    assert after.a.tolist() == [[1.0 - ONSET, -2.0, -6.0]]
    assert capped[0, :, 0].tolist() == [-4.0, -3.0, -5.0]
    assert torch.equal(capped[..., 1:], x0[..., 1:])


def braking_of(
    speed,
    room,
    *,
    other_speed=0.0,
    angle=0.0,
    ahead=10.0,
    steps=10,
    length=4.0,
    yields=False,
    patience=0.0,
):
    """Braking of a vehicle that meets the ego, `ahead` m before it then, after driving
    GAP + room m in so many steps."""
    number = lambda value: torch.full((1, 1, 1), float(value))  # noqa: E731
    meeting = Meeting(
        vehicle=torch.tensor([0.0, 0.0, 0.0, speed]).view(1, 1, 1, 4),
        other=torch.tensor([ahead, 0.0, angle, other_speed]).view(1, 1, 1, 4),
        driven=number(GAP + room),
        steps=number(steps),
        happens=number(1) > 0,
    )
    duty = Duty(
        exempt=torch.zeros(1, 1, dtype=torch.bool),
        yields=torch.full((1, 1), yields),
        patience=torch.full((1, 1), patience),
    )
    return meeting_braking(
        meeting,
        torch.tensor([[speed]]),
        length=torch.tensor([[length]]),
        duty=duty,
    ).item()


def test_braking_is_that_of_constant_deceleration_in_the_room():
    assert braking_of(6.0, 9.0) == pytest.approx(6**2 / (2 * 9))


def test_no_more_is_asked_for_than_in_a_third_of_a_metre():
    assert braking_of(1.5, 0.05) == pytest.approx(1.5**2 / (2 * 0.3))


@pytest.mark.parametrize(("patience", "waits"), [(0.98, False), (1.02, True)])
def test_who_waits_looks_half_a_second_ahead(patience, waits):
    """At 4 m/s with 10 m of room: 8 m are left then, in which 1 m/s^2 suffices."""
    assert (braking_of(4.0, 10.0, patience=patience) == -NO_CAP) == waits


@pytest.mark.parametrize(("cosine", "behind"), [(0.72, True), (0.68, False)])
def test_who_comes_alongside_falls_behind_and_who_crosses_does_not(cosine, behind):
    """4 + 1.2 - 0.5 m back within a second."""
    braking = braking_of(
        2.0,
        50.0,
        angle=math.acos(cosine),
        ahead=0.5,
        yields=True,
    )
    assert braking == pytest.approx(2 * 4.7 if behind else MIN_BRAKING, rel=1e-3)


def test_whoever_is_free_has_a_cap_beyond_what_a_car_can_do():
    decode, state, obstacles = traffic([(0, 0, 0, 10)])
    assert caps(decode, state, obstacles=obstacles).tolist() == [20.0]


@pytest.mark.parametrize(("aside", "free"), [(2.09, False), (2.11, True)])
def test_a_tenth_of_a_metre_is_kept_to_either_side(aside, free):
    """Of two cars of 2 m, one beside the other's way."""
    cap = caps(*traffic([(0, 0, 0, 10), (20, aside, 0, 0)]))[0]
    assert (cap == NO_CAP) == free
