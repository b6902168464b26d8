import math

import pytest
import torch

from e2rl.prior.lane_relative import lateral_horizon
from e2rl.scenes.recording import DT
from e2rl.traffic.e2 import anchoring
from e2rl.traffic.e2.anchoring import AnchorSettings, propose
from e2rl.traffic.e2.interception import InterceptionSettings
from e2rl.traffic.motion import constant_speed_states
from tests.traffic.e2.crossing import (
    add_route,
    decoded,
    make_world,
    mask,
    skeleton_of,
    wish_of,
)

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
TIMES = DT * torch.arange(1, 51)
LANES = InterceptionSettings(reach=0.0)


def proposed(
    world, skeleton, plan, settings=None, interception=LANES, eta=2.0, **options
):
    settings = settings or AnchorSettings()
    wish = wish_of(len(plan), eta)
    return propose(
        world,
        skeleton,
        ego_plan=plan,
        settings=settings,
        interception=interception,
        wish=wish,
        **options,
    )


def anchored(world, *vehicles, near=2, **settings):
    support = mask(world, *vehicles)
    skeleton = skeleton_of(world, support, near=near)
    plan = constant_speed_states(world.scene, world, times=TIMES)[:, 0]
    return proposed(
        world, skeleton, plan=plan, settings=AnchorSettings(**settings)
    ), skeleton


@pytest.mark.parametrize(
    "ahead, way, speed",
    [
        (40.0, 30.0, 10.0),
        (40.0, 45.0, 10.0),
        (30.0, 20.0, 4.0),
        (20.0, 25.0, 12.0),
        (45.0, 16.0, 0.5),
    ],
)
def test_both_arrive_at_the_crossing_at_once(ahead, way, speed):
    world = make_world([EGO, (ahead, -way, UP, speed)])
    anchor, _ = anchored(world, 1)
    assert anchor.feasible[0].tolist() == [False, True] + [False] * 6
    gone = decoded(anchor.knots[0, 1], speed)[1]
    arrival = torch.searchsorted(gone, torch.tensor(way)).item() * DT
    assert arrival == pytest.approx(ahead / 10, abs=0.25)
    assert anchor.cost[0, 1] < 0.25 + 0.2 * anchor.knots[0, 1].abs().max()
    assert not anchor.off_lane.any()


@pytest.mark.parametrize(("late", "finite"), [(4.0, True), (10.0, True), (10.5, False)])
def test_a_crossing_that_is_missed_costs_the_time_gap(late, finite):
    """Without acceleration both keep 10 m/s: `late` m behind the crossing it misses by
    late / 10 s, 1 s at most."""
    world = make_world([EGO, (30.0, -30.0 - late, UP, 10.0)])
    still, _ = anchored(world, 1, min_accel=-0.05, max_accel=0.05)
    assert still.cost[0, 1].item() == (
        pytest.approx(late / 10, abs=0.2) if finite else math.inf
    )
    assert still.feasible[0, 1] == finite


def test_a_leader_brakes_and_a_follower_speeds_up():
    world = make_world([EGO, (25.0, 0.0, 0.0, 10.0), (-20.0, 0.0, 0.0, 10.0)])
    anchor, _ = anchored(world, 1, 2)
    assert anchor.feasible[0, 1:3].all()
    assert anchor.knots[0, 1].mean() < -0.3
    assert anchor.knots[0, 2].mean() > 0.3


def test_the_candidate_that_meets_the_target_is_chosen():
    world = make_world([EGO, (40.0, -30.0, UP, 8.0)])
    world.scene["route_points"][:, 1, 2] = world.scene["route_points"][:, 1, 0]
    world.scene["route_valid"][:, 1, 2] = True
    add_route(
        world, 1, candidate=0, heading=0.0
    )  # the one it follows leads away from the ego's
    assert anchored(world, 1)[0].route[0, 1] == 2


def test_a_route_that_a_vehicle_would_swing_off_or_cannot_shift_to_is_not_taken(
    monkeypatch,
):
    world = make_world([EGO, (40.0, -30.0, 0.0, 8.0)])
    add_route(world, 1, candidate=2, heading=UP)
    assert not anchored(world, 1)[0].feasible.any()
    monkeypatch.setattr(anchoring, "MAX_SWING", 100.0)
    assert anchored(world, 1)[0].route[0, 1] == 2
    beside = make_world([EGO, (30.0, -6.0, 0.0, 8.0)])
    beside.scene["route_points"][:, 1, 2] = beside.scene["route_points"][
        :, 1, 0
    ] + torch.tensor([0.0, 6.0])
    beside.scene["route_valid"][:, 1, 2] = True
    assert not anchored(beside, 1)[0].feasible.any()
    monkeypatch.setattr(anchoring, "MAX_SHIFT", 7.0)
    assert anchored(beside, 1)[0].route[0, 1] == 2


def test_a_kept_route_is_the_only_one_looked_at():
    world = make_world([EGO, (40.0, -30.0, 0.0, 8.0)])
    add_route(world, 1, candidate=2, heading=UP)
    support = mask(world, 1)
    skeleton = skeleton_of(world, support)
    plan = constant_speed_states(world.scene, world, times=TIMES)[:, 0]
    assert not proposed(world, skeleton, plan=plan, keep_route=True).feasible.any()
    world.route[:, 1] = 2
    rest = proposed(world, skeleton, plan=plan, keep_route=True)
    assert rest.feasible[0, 1]
    assert torch.equal(rest.route, world.route)


def test_who_cannot_meet_the_target_has_no_anchor_and_keeps_its_route():
    world = make_world([EGO, (40.0, 30.0, UP, 8.0), (10.0, -90.0, UP, 5.0)])
    anchor, skeleton = anchored(world, 1, 2)
    assert skeleton.coalition[0, 1:3].all()
    assert not anchor.feasible.any()
    assert not anchor.knots.any()
    assert torch.equal(anchor.route, world.route)
    assert anchor.cost.isinf().all()


def test_a_chain_s_first_link_meets_its_target_not_the_ego():
    world = make_world([EGO, (30.0, -20.0, UP, 8.0), (30.0, -38.0, UP, 8.0)])
    anchor, skeleton = anchored(world, 1, 2, near=1)
    assert skeleton.target[0, 1:3].tolist() == [0, 1]
    assert anchor.feasible[0, 1:3].all()
    gap = (
        (18 + decoded(anchor.knots[0, 1], 8.0)[1] - decoded(anchor.knots[0, 2], 8.0)[1])
        .abs()
        .min()
    )
    assert gap < 4.5  # the boxes would touch


def test_accelerations_are_bounded_and_bends_slow_down(monkeypatch):
    world = make_world([EGO, (60.0, -30.0, UP, 12.0)])
    arc = 2.0 * torch.arange(150) - 20
    radius = 15.0
    bend = (arc - 15).clamp(
        0, radius * math.pi / 2
    )  # straight up, then left on to the ego's lane, against it
    rest = (arc - 15 - radius * math.pi / 2).clamp(min=0)
    x = 60 - radius * (1 - (bend / radius).cos()) - rest
    y = -15 + radius * (bend / radius).sin() + (arc - 15).clamp(max=0)
    world.scene["route_points"][:, 1, 0] = torch.stack([x, y], -1)
    monkeypatch.setattr(anchoring, "MAX_OFFSET", 10.0)
    anchor, _ = anchored(world, 1)
    knots = anchor.knots[0, 1]
    assert knots.min() >= -5.0
    assert knots.max() <= 4.0
    assert anchor.feasible[0, 1]
    speed, way = decoded(knots, 12.0)
    inside = (way > 16) & (way < 34)
    assert inside.any()
    assert (speed[inside] < 1.1 * math.sqrt(4.0 * radius)).all()


def free_candidate(speed):
    """One vehicle at the start of a long straight candidate without bends."""
    single = torch.ones(1, 1, 1)
    return anchoring._Candidates(
        single.long(),
        single,
        usable=single.bool(),
        end=200 * single,
        s=0 * single,
        d=0 * single,
        bend_bound=torch.full((1, 1, 1, anchoring.BEND_VERTICES), 1e4),
        speed=torch.full((1, 1), speed),
        accel=torch.zeros(1, 1),
        size=torch.tensor([[[4.0, 2.0]]]),
    )


@pytest.mark.parametrize(
    ("beside", "crossing", "slack"),
    [(1.0, 0.2, 0.0), (-1.5, 0.1, 0.0), (0.0, 0.3, 3.0)],
)
def test_the_time_gap_is_the_missing_distance_over_speed_and_what_the_target_still_has_to_cross(
    beside, crossing, slack
):
    """At 10 m/s to a target that stays 30.5 m ahead: the nearest steps are half a metre
    off it. Acceleration and offset from the route have prices of their own."""
    candidates = free_candidate(speed=10.0)
    single = torch.ones(1, 1, 1)
    steps = torch.ones(1, 1, 1, 50)
    limits = torch.tensor((-3.0, 2.0))
    target = anchoring._Target(
        30.5 * steps,
        beside * steps,
        slack=slack * steps,
        crossing_time=crossing * steps,
        corridor=torch.full((1, 1), 2.0),
    )
    cost, gap, _ = anchoring.scored(candidates, torch.zeros(1, 1, 1, 1), target, limits)
    expected = max(0.5 - slack, 0.0) / 10 + abs(beside) * crossing
    assert gap.item() == pytest.approx(expected, abs=1e-4)
    assert cost.item() == pytest.approx(expected, abs=1e-4)
    shifted = candidates._replace(d=-0.4 * single)
    cost, gap, _ = anchoring.scored(
        shifted, torch.full((1, 1, 1, 1), -1.5), target, limits
    )
    assert (cost - gap).item() == pytest.approx(0.2 * 1.5 + 0.05 * 0.4, abs=1e-5)


def test_a_knot_is_the_mean_acceleration_over_0_4_s():
    """From 2.7 m/s at -3 m/s^2 it stands after 0.9 s: 0.3 m/s are lost between 0.8 and
    1.2 s."""
    knots = anchoring._knots(
        free_candidate(speed=2.7),
        torch.full((1, 1, 1, 1), -3.0),
        limits=torch.tensor((-3.0, 2.0)),
    )
    expected = [-3.0, -0.3 / 0.4, *[0.0] * 8]
    assert knots.flatten().tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("before", "squared_speed"), [(-2.0, 100.0), (18.0, 208.0)])
def test_a_bend_takes_4_m_s2_and_its_approach_brakes_by_3(before, squared_speed):
    """40 m straight on, then a circle of R = 25 m, whose curvature a polyline of 2 m
    has from 42 m on: 4 R, and 2 * 3 m/s^2 for each metre before that."""
    arc = 2.0 * torch.arange(150)
    angle = (arc - 40).clamp(min=0) / 25
    x = arc.clamp(max=40) + 25 * angle.sin()
    route = torch.stack([x, 25 * (1 - angle.cos())], -1)
    bound = anchoring._bend_bound(route, torch.tensor(42.0 - before))
    assert bound[0].item() == pytest.approx(squared_speed, rel=1e-3)


def usable(offset=0.0, turn=0.0):
    """Whether a vehicle at 8 m/s may take another route than its own, that begins at
    `offset` m to its left and turns off."""
    world = make_world([EGO, (40.0, -30.0, 0.0, 8.0)])
    add_route(world, 1, candidate=2, heading=turn)
    world.scene["route_points"][:, 1, 2, :, 1] += offset
    index = torch.tensor([[1]])
    candidates = anchoring._candidates(
        world, index, keep_route=False, halt_at_red=False
    )
    return candidates.usable[0, 0, 2].item()


@pytest.mark.parametrize(("offset", "expected"), [(4.4, True), (-4.6, False)])
def test_a_vehicle_may_change_to_a_route_4_5_m_beside_it(offset, expected):
    assert usable(offset=offset) is expected


@pytest.mark.parametrize(("swing", "expected"), [(0.95, True), (1.05, False)])
def test_a_vehicle_may_swing_out_by_a_metre_where_it_turns_in(swing, expected):
    """A fifth of the slope times the lateral horizon."""
    horizon = lateral_horizon(torch.tensor(8.0)).item()
    assert usable(turn=math.atan(swing / (0.2 * horizon))) is expected


def test_by_default_a_lane_is_driven_at_minus_3_to_2_m_s2(monkeypatch):
    tried = []
    scored = anchoring.scored

    def spy(candidates, accel, *arguments):
        tried.append(accel)
        return scored(candidates, accel, *arguments)

    monkeypatch.setattr(anchoring, "scored", spy)
    anchored(make_world([EGO, (40.0, -30.0, UP, 8.0)]), 1)
    assert [float(accel.min()) for accel in tried[:1]] == [-3.0]
    assert [float(accel.max()) for accel in tried[:1]] == [2.0]
