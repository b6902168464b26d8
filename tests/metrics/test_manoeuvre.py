"""Manoeuvres obey the simulator's limits and follow routes; what counts against them is
what DrivingEnv counts."""

import pytest
import torch

from e2rl.metrics.evasion_scene import AWAY, EvasionScene, violations
from e2rl.metrics.manoeuvre import (
    accelerations,
    execute,
    knot_count,
    knots_of,
    peak_acceleration,
    shifts,
)
from e2rl.scenes.route import SPACING, project
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from tests.synthetic import LANE_WIDTH, make_scenes

LIMITS = SimSettings(max_acceleration=5.0, max_braking=8.0, max_yaw_rate=1.6)
STEPS = 80
KNOTS = knot_count(STEPS)
START = torch.tensor([0.0, 0.0, 0.0, 8.0])


def arc(radius):
    """A route [P, 2] that begins in the origin towards +x and bends left with a radius
    [m]."""
    angle = SPACING * torch.arange(150) / radius
    return radius * torch.stack([angle.sin(), 1 - angle.cos()], -1)


def test_knots_are_interpolated_and_come_back():
    ramp = torch.arange(KNOTS, dtype=torch.float32)
    torch.testing.assert_close(
        accelerations(ramp, STEPS), (torch.arange(STEPS) + 0.5) / 5
    )
    torch.testing.assert_close(
        knots_of(torch.full((2, STEPS), 1.5)), torch.full((2, KNOTS), 1.5)
    )


def test_shifts_begin_at_rest_hold_what_is_held_and_have_their_own_rate():
    knots = torch.randn(3, KNOTS, generator=torch.Generator().manual_seed(0)).double()
    value, rate = shifts(knots, STEPS)
    assert value[:, 0].abs().max() < 1e-9
    assert rate[:, 0].abs().max() < 1e-9
    simpson = (rate[:, :-2] + 4 * rate[:, 1:-1] + rate[:, 2:]) / 6 * 0.2
    torch.testing.assert_close(value[:, 2:] - value[:, :-2], simpson, atol=0.01, rtol=0)
    value, rate = shifts(torch.full((KNOTS,), 2.0), STEPS)
    torch.testing.assert_close(value[20:], torch.full((61,), 2.0))
    torch.testing.assert_close(rate[20:], torch.zeros(61), atol=1e-5, rtol=0)


def test_a_bend_is_followed_at_the_shift_asked_for():
    start = torch.tensor([0.0, 0.0, 0.0, 8.0]).double()
    route = arc(25.0).double()
    ramp = (torch.arange(KNOTS).double() / 4).clamp(max=1)
    for wanted in (0.0, 2.0, -3.0):
        _, states = execute(
            start, route, accel=0 * ramp, shift=wanted * ramp, steps=STEPS, sim=LIMITS
        )
        offset = project(states[40:, :2], route)[1]
        assert (offset - wanted).abs().max() < 0.4, offset


def test_limits_hold_and_the_actions_give_the_states():
    generator = torch.Generator().manual_seed(1)
    accel, shift = 20 * torch.randn(2, 200, KNOTS, generator=generator)
    start = START.expand(200, 4)
    actions, states = execute(
        start, arc(15.0), accel=accel, shift=shift, steps=STEPS, sim=LIMITS
    )
    assert actions[..., 0].min() >= -8
    assert actions[..., 0].max() <= 5
    assert actions[..., 1].abs().max() <= 1.6
    torch.testing.assert_close(dynamics.rollout(start, actions), states)
    assert peak_acceleration(start, states).max() < dynamics.MAX_LATERAL + 1e-2, (
        "braking and turning share the grip"
    )
    assert (states[..., 3] >= 0).all()


SMALL = {"max_vehicles": 4, "max_agents": 6, "num_routes": 2, "num_points": 120}


def trajectories(scene, shift=0.0, speed=10.0, steps=40):
    """The ego [B, 1, T, 4] straight on at a speed, `shift` m beside its lane."""
    state = scene["start"][:, None, None, 0].repeat(1, 1, steps, 1)
    state[..., 0] += speed * 0.1 * torch.arange(1, steps + 1)
    state[..., 1] += shift
    state[..., 3] = speed
    return state


def evasion_scene(scene_set, moment=0):
    scene = scene_set.scenes
    return EvasionScene.after(
        torch.full((len(scene_set),), moment),
        scene,
        states=scene["logged"],
        valid=scene["logged_valid"],
    )


def test_contact_is_what_the_environment_calls_contact():
    scene_set = make_scenes(
        3, vehicles=[(0, 0, 10.0), (18, 0, 4.0)], num_vrus=0, steps=40, **SMALL
    )
    env = DrivingEnv(scene_set, SimSettings(end_on_contact=False), 3)
    td = env.reset()
    hit = []
    for _ in range(40):
        td["action"] = torch.zeros(3, 2)
        after = env.step(td)["next"]
        hit.append(after["metrics", "contact"][:, 0])
        td = after.exclude("reward")
    missed = violations(
        trajectories(scene_set.scenes),
        evasion_scene(scene_set),
        clearance=0.0,
        road_margin=0.0,
    )[:, 0]
    assert torch.equal(missed > 0, torch.stack(hit, 1))
    assert (missed > 0).any()


def test_pedestrians_count_and_the_absent_do_not():
    scene_set = make_scenes(1, vehicles=[(0, 0, 10.0)], num_vrus=1, steps=40, **SMALL)
    scene_set.scenes["logged"][:, :, 4, 1] = 0.0
    ego = trajectories(scene_set.scenes)
    assert (
        violations(ego, evasion_scene(scene_set), clearance=0.0, road_margin=0.0) > 0
    ).any()
    scene_set.scenes["logged_valid"][:, :, 4] = False
    task = evasion_scene(scene_set)
    assert (violations(ego, task, clearance=0.0, road_margin=0.0) == 0).all()
    assert (task.others < AWAY).all()


def test_clearance_widens_and_the_road_ends_beside():
    scene_set = make_scenes(
        1, vehicles=[(0, 0, 10.0), (5, 1, 10.0)], num_vrus=0, steps=40, **SMALL
    )
    gap = LANE_WIDTH - 2.0
    task = evasion_scene(scene_set)
    assert (
        violations(
            trajectories(scene_set.scenes), task, clearance=gap - 0.05, road_margin=0.0
        )
        == 0
    ).all()
    assert (
        violations(
            trajectories(scene_set.scenes), task, clearance=gap + 0.05, road_margin=0.0
        )
        > 0
    ).any()
    assert (
        violations(
            trajectories(scene_set.scenes, shift=-4.5),
            task,
            clearance=0.0,
            road_margin=0.0,
        )
        > 1
    ).all()
    edge = trajectories(
        scene_set.scenes, shift=-LANE_WIDTH / 2 - 0.7
    )  # 0.3 m inside the border
    assert (violations(edge, task, clearance=0.0, road_margin=0.1) == 0).all()
    assert (violations(edge, task, clearance=0.0, road_margin=0.5) > 0).all()


def test_nothing_counts_behind_the_map_s_end_or_after_the_episode():
    cars = [(0, 0, 10.0), (30, 0, 0.0)]
    for end, misses in ((400.0, True), (20.0, False)):
        scene_set = make_scenes(
            1, vehicles=cars, num_vrus=0, steps=40, road=(-60.0, end), **SMALL
        )
        assert (
            violations(
                trajectories(scene_set.scenes),
                evasion_scene(scene_set),
                clearance=0.0,
                road_margin=0.0,
            )
            > 0
        ).any() == misses
    scene_set = make_scenes(1, vehicles=cars, num_vrus=0, steps=40, **SMALL)
    late = evasion_scene(scene_set, moment=30)
    assert late.inside.sum() == 10
    assert (
        violations(
            trajectories(scene_set.scenes), late, clearance=0.0, road_margin=0.0
        )[..., 10:]
        == 0
    ).all()


@pytest.mark.parametrize(("speed", "slowest"), [(1.0, 2.0), (1.8, 2.0), (2.2, 2.2)])
def test_below_two_metres_a_second_a_shift_is_slower_than_its_knots(speed, slowest):
    """The tangent of the heading is the shift's rate over the speed; a vehicle at v
    below 2 m/s shifts (v / 2)^2 times as fast."""
    knots = 0.1 * torch.arange(KNOTS).double()
    start = torch.tensor([0.0, 0.0, 0.0, speed]).double()
    route = SPACING * torch.arange(150).double()
    _, states = execute(
        start,
        torch.stack([route, 0 * route], -1),
        accel=0 * knots,
        shift=knots,
        steps=STEPS,
        sim=LIMITS,
    )
    _, rate = shifts(knots, STEPS)
    expected = rate[40] * speed / slowest**2
    torch.testing.assert_close(states[39, 2].tan(), expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("offset", "inner"), [(15.0, 0.5), (22.5, 0.25), (25.0, 0.2)])
def test_inside_a_bend_a_path_is_at_least_a_fifth_as_long_as_its_route(offset, inner):
    """At d m inside a bend of 30 m a vehicle turns by v / (30 - d) a second, as on a
    circle of 6 m at least."""
    speed = 2.0
    ramp = (torch.arange(KNOTS).double() / 12).clamp(max=1)
    actions, _ = execute(
        torch.tensor([0.0, 0.0, 0.0, speed]).double(),
        arc(30.0).double(),
        accel=0 * ramp,
        shift=offset * ramp,
        steps=STEPS,
        sim=LIMITS,
    )
    assert actions[-1, 1].item() == pytest.approx(speed / (30 * inner), rel=0.01)
