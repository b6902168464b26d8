import math
from dataclasses import replace

import pytest
import torch

from e2rl.scenes.boxes import overlap
from e2rl.scenes.drivable_area import CELL
from e2rl.scenes.recording import DT, LIGHT_GREEN, LIGHT_RED
from e2rl.scenes.route import SPACING, interpolate
from e2rl.traffic.e2 import interception
from e2rl.traffic.e2.interception import InterceptionSettings, cubic, intercept
from e2rl.traffic.motion import constant_speed_states
from tests.traffic.e2.crossing import decoded, make_world, wish_of

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
BESIDE = (-4.0, 3.5, 0.0, 11.0)  # in the next lane, a little behind
TIMES = DT * torch.arange(1, 51)
FREE = replace(InterceptionSettings(), push=2.0, brake=2.0, lateral=2.0)


def met(
    vehicles,
    eta=2.0,
    settings=FREE,
    world=None,
    halt_at_red=False,
    moment=-1.0,
    wrong_way=0.0,
):
    """Vehicle 1's interception of the ego among the others, all of which keep their
    speed."""
    world = world or make_world(vehicles)
    scene = world.scene
    expected = constant_speed_states(world.scene, world, times=TIMES)
    index, target = (torch.full((len(scene), 1), vehicle) for vehicle in (1, 0))
    result = intercept(
        world,
        index,
        target=target,
        expected=expected,
        wish=wish_of(len(scene), eta, moment=moment, wrong_way=wrong_way),
        settings=settings,
        halt_at_red=halt_at_red,
    )
    return result, expected, scene["size"][:, :8]


def driven(found, speed):
    """States [50, 4] of the vehicle on its way, by the prior's decoder of speeds."""
    v, way = decoded(found.knots[0, 0], speed, accel=found.knots[0, 0, 0])
    xy, heading, _ = interpolate(found.path[0, 0], way)
    return torch.cat([xy, heading[:, None], v[:, None]], -1)


@pytest.mark.parametrize(
    "vehicle",
    [
        BESIDE,
        (25.0, -20.0, UP, 9.0),
        (60.0, 3.5, math.pi, 8.0),
        (-15.0, 0.0, 0.0, 11.0),
    ],
)
def test_the_boxes_touch_if_everybody_drives_as_expected(vehicle):
    result, expected, size = met([EGO, vehicle])
    assert result.cost.isfinite().all()
    track = driven(result, vehicle[3])
    assert overlap(
        track,
        size[0, 1].expand(50, 2),
        second=expected[0, 0],
        second_size=size[0, 0].expand(50, 2),
    ).any()


def test_a_way_begins_at_the_vehicle_in_its_direction_with_a_vertex_every_two_metres():
    result, _, _ = met([EGO, BESIDE])
    points = result.path[0, 0]
    assert torch.allclose(points[0], torch.tensor(BESIDE[:2]), atol=1e-4)
    step = points.diff(dim=0)
    assert (step.norm(dim=-1) - SPACING).abs().max() < 0.02
    assert torch.atan2(step[0, 1], step[0, 0]).abs() < 0.1


@pytest.mark.parametrize("angle", [0.2, 0.8, 1.9])
def test_the_cubic_between_two_poses_of_a_circle_is_its_arc(angle):
    radius = 12.0
    end = torch.tensor([radius * math.sin(angle), radius * (1 - math.cos(angle))])
    points, _ = cubic(
        torch.zeros(2),
        torch.tensor(0.0),
        end=end,
        end_heading=torch.tensor(angle),
        u=torch.linspace(0, 1, 21),
    )
    gap = (points - torch.tensor([0.0, radius])).norm(dim=-1) - radius
    assert gap.abs().max() < 3e-3 * radius


@pytest.mark.parametrize(
    ("x", "heading", "ego"), [(-12.0, 0.0, 10.0), (60.0, math.pi, -10.0)]
)
def test_straight_on_it_costs_what_its_acceleration_and_time_weigh(x, heading, ego):
    """Behind the ego, or head-on: one constant acceleration until the boxes touch; the
    cheapest of ten moments."""
    result, _, size = met([EGO, (x, 0.0, heading, 10.0)])
    touch = 0.4 * (size[0, 0, 0] + size[0, 1, 0]).item() * (heading == 0.0)
    costs = []
    for step in range(1, 11):
        time = 0.5 * step
        way = abs(x - 10.0 * time) - touch
        accel = 2 * (way - 10.0 * time) / time**2
        within = -2 * FREE.brake <= accel <= 2 * FREE.push and 10.0 + accel * time >= 0
        costs.append(
            (
                0.2 * abs(accel) + 0.1 * time - FREE.preference if within else math.inf,
                accel,
                step,
            )
        )
    cost, accel, step = min(costs)
    assert result.cost.item() == pytest.approx(cost, abs=1e-3)
    assert result.knots[0, 0, :step].tolist() == pytest.approx([accel] * step, abs=1e-3)
    assert not result.knots[0, 0, step:].any()


@pytest.mark.parametrize("eta", [0.5, 1.0, 3.0])
def test_what_is_proposed_keeps_the_limits(eta):
    settings = InterceptionSettings()
    world = make_world([EGO, BESIDE], copies=30)
    generator = torch.Generator().manual_seed(0)
    world.states[:, 1, 0] += 30 * torch.rand(30, generator=generator) - 10
    world.states[:, 1, 3] += 6 * torch.rand(30, generator=generator) - 3
    result, _, _ = met([EGO, BESIDE], eta, settings=settings, world=world)
    some = result.cost[:, 0].isfinite()
    assert some.any()
    knots = result.knots[some, 0]
    assert (knots <= settings.push * eta + 1e-5).all()
    assert (knots >= -settings.brake * eta - 1e-5).all()
    v = world.states[some, 1, 3]
    _, _, curvature = interpolate(
        result.path[some, 0], torch.arange(2.0, 20.0, 2.0).expand(int(some.sum()), -1)
    )
    slow = v[:, None] ** 2 - 2 * settings.brake * eta * torch.arange(2.0, 20.0, 2.0)
    assert (
        (slow.clamp(min=0) * curvature.abs()).amax(-1) < 1.3 * settings.lateral * eta
    ).all()


def test_no_way_leads_off_the_road_or_through_another_vehicle():
    world = make_world([EGO, BESIDE])
    cells = world.scene["field"].shape[-1]
    y = world.scene["field_origin"][0, 1] + CELL * torch.arange(cells)
    world.scene["field"][:] = -5.0
    assert met([EGO, BESIDE], world=world)[0].cost.isfinite()
    world.scene["field"][:, :, (y > 0.8) & (y < 2.6)] = 2.0  # a kerb between the lanes
    assert met([EGO, BESIDE], world=world)[0].cost.isinf()
    between = (16.0, 0.0, 0.0, 10.0)
    assert met([EGO, (30.0, 0.0, math.pi, 8.0)])[0].cost.isfinite()
    assert met([EGO, (30.0, 0.0, math.pi, 8.0), between])[0].cost.isinf()


def test_a_turned_and_moved_scene_has_the_turned_and_moved_way():
    first = met([EGO, BESIDE])[0]
    turn = 0.7
    shift = torch.tensor([30.0, -12.0])
    spin = torch.tensor(
        [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    )
    moved = [
        (*(spin @ torch.tensor(v[:2]) + shift).tolist(), v[2] + turn, v[3])
        for v in (EGO, BESIDE)
    ]
    other = met(moved)[0]
    torch.testing.assert_close(
        other.path[0, 0], first.path[0, 0] @ spin.T + shift, atol=2e-3, rtol=1e-4
    )
    torch.testing.assert_close(other.cost, first.cost, atol=1e-3, rtol=1e-4)


def oncoming_world():
    """A vehicle that comes towards the ego, whose lane runs with the ego."""
    return make_world([EGO, (60.0, 3.5, math.pi, 8.0)])


def test_a_path_that_ends_against_every_lane_costs_what_is_set_and_is_not_made_at_infinity():
    free = met(None, world=oncoming_world())[0].cost
    dear = met(None, settings=replace(FREE, wrong_way=1.5), world=oncoming_world())[
        0
    ].cost
    assert dear.item() == pytest.approx(free.item() + 1.5, abs=1e-5)
    assert met(
        None, settings=replace(FREE, wrong_way=math.inf), world=oncoming_world()
    )[0].cost.isinf()


@pytest.mark.parametrize("line, finite", [(40.0, False), (200.0, True)])
def test_nobody_is_sent_past_its_own_red_light(line, finite):
    world = make_world([EGO, BESIDE])
    world.scene["light_state"] = torch.full(
        (1, world.scene["logged"].shape[1], 1), LIGHT_RED
    )
    world.scene["route_light"][:, 1, 0, 0], world.scene["route_light_s"][:, 1, 0, 0] = (
        0,
        line,
    )
    assert bool(met(None, world=world, halt_at_red=True)[0].cost.isfinite()) == finite
    assert met(None, world=world)[0].cost.isfinite().all()
    world.scene["light_state"][:] = LIGHT_GREEN
    assert met(None, world=world, halt_at_red=True)[0].cost.isfinite().all()


def test_what_an_interception_weighs_in_seconds():
    """0.2 s for 1 m/s^2, 0.1 s for each second, and 1 s for each second beside the
    moment that is wished for; a straight path has no lateral acceleration."""
    count = interception.SAMPLES
    points = torch.zeros(1, 1, 1, count, 2)
    points[..., 0] = torch.linspace(0, 30, count)
    zero = torch.zeros(1, 1, 1)
    paths = interception._Paths(
        points=points,
        tangents=torch.tensor([1.0, 0.0]).expand(1, 1, 1, count, 2),
        length=points[..., 0],
        bearing=zero,
        turn=zero,
        end_heading=zero,
    )
    drive = interception._Drive(zero + 10.0, zero - 2.0, time=zero + 3.0)
    anytime = interception._cost(paths, drive, wish=wish_of(1))
    assert float(anytime) == pytest.approx(0.2 * 2 + 0.1 * 3)
    later = interception._cost(paths, drive, wish=wish_of(1, moment=4.5))
    assert float(later - anytime) == pytest.approx(1.5)


def arc_path(radius=20.0):
    """A path of 1 rad on a circle."""
    count = interception.SAMPLES
    angle = torch.linspace(0, 1.0, count)
    points = radius * torch.stack([angle.sin(), 1 - angle.cos()], -1)
    zero = torch.zeros(1, 1, 1)
    return interception._Paths(
        points=points.expand(1, 1, 1, count, 2),
        tangents=torch.stack([angle.cos(), angle.sin()], -1).expand(1, 1, 1, count, 2),
        length=(radius * angle).expand(1, 1, 1, count),
        bearing=zero,
        turn=zero + 1.0,
        end_heading=zero + 1.0,
    )


def within_limits(path, limits=FREE, speed=5.0, accel=0.0):
    """Whether it keeps the limits of intensity 1."""
    zero = torch.zeros(1, 1, 1)
    drive = interception._Drive(zero + speed, zero + accel, time=zero + 3.0)
    return bool(interception._within_limits(path, drive, zero + 1.0, limits))


@pytest.mark.parametrize(("turn", "possible"), [(1.35, True), (-1.45, False)])
def test_a_path_turns_by_1_4_rad_at_most(turn, possible):
    path = arc_path()._replace(turn=torch.full((1, 1, 1), turn))
    assert within_limits(path) == possible


@pytest.mark.parametrize(("bearing", "possible"), [(-1.0, True), (1.1, False)])
def test_a_target_lies_within_60_degrees_of_the_heading(bearing, possible):
    path = arc_path()._replace(bearing=torch.full((1, 1, 1), bearing))
    assert within_limits(path) == possible


@pytest.mark.parametrize(
    ("accel", "possible"), [(1.45, True), (1.55, False), (-1.15, True), (-1.25, False)]
)
def test_by_default_it_pushes_by_1_5_and_brakes_by_1_2_m_s2_per_intensity(
    accel, possible
):
    limits = replace(InterceptionSettings(), lateral=5.0)
    assert within_limits(arc_path(), limits=limits, accel=accel) == possible


@pytest.mark.parametrize(("radius", "possible"), [(12.0, True), (8.0, False)])
def test_lateral_acceleration_on_an_arc_is_its_speed_squared_over_the_radius(
    radius, possible
):
    """At 7 m/s an arc of 12 m takes 4.1 m/s^2, one of 8 m 6.1: 5 are allowed."""
    limits = replace(FREE, lateral=5.0)
    assert within_limits(arc_path(radius), limits=limits, speed=7.0) == possible


def test_lateral_acceleration_weighs_0_2_s_each_m_s2():
    """At 5 m/s on an arc of 20 m, for 3 s."""
    zero = torch.zeros(1, 1, 1)
    drive = interception._Drive(zero + 5.0, zero, time=zero + 3.0)
    cost = interception._cost(arc_path(20.0), drive, wish=wish_of(1))
    assert float(cost) == pytest.approx(0.2 * 5.0**2 / 20 + 0.1 * 3, rel=1e-4)


def test_what_only_the_competent_driver_survives_is_2_s_cheaper(monkeypatch):
    costs = []
    for worth in (0.0, 1.0):
        monkeypatch.setattr(
            interception,
            "_worth",
            lambda *_, possible, worth=worth, **__: worth * possible.float(),
        )
        costs.append(met([EGO, BESIDE])[0].cost.item())
    assert costs[0] - costs[1] == pytest.approx(2.0, abs=1e-5)


def test_by_default_an_interception_is_preferred_to_a_lane_by_2_s():
    plain = met([EGO, BESIDE], settings=replace(FREE, preference=0.0))[0].cost
    default = met([EGO, BESIDE], settings=FREE)[0].cost
    assert (plain - default).item() == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize(("radius", "possible"), [(12.8, True), (12.2, False)])
def test_by_default_it_takes_2_m_s2_to_the_side_per_intensity(radius, possible):
    """25 m^2/s^2 over the radius."""
    path = arc_path(radius)
    assert within_limits(path, limits=InterceptionSettings(), speed=5.0) == possible


@pytest.mark.parametrize(("off", "possible"), [(0.45, True), (0.55, False)])
def test_a_path_may_leave_the_road_by_half_a_metre(off, possible):
    """Over a kerb between two lanes."""
    world = make_world([EGO, BESIDE])
    cells = world.scene["field"].shape[-1]
    y = world.scene["field_origin"][0, 1] + CELL * torch.arange(cells)
    world.scene["field"][:, :, (y > 0.8) & (y < 2.6)] = off
    result = met([EGO, BESIDE], world=world)[0]
    assert result.cost.isfinite().item() is possible
