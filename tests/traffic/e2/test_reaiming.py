"""Vehicles that leave replayed traffic: who, from when on, what stays as it was, and
that seeds decide."""

import math
from dataclasses import replace

import pytest
import torch
from torchrl.envs import TransformedEnv

from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.scenes.boxes import overlap
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.dynamics import SHARPEST, Arc, along_arc
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.e2.interception import InterceptionSettings
from e2rl.traffic.e2.reaiming import (
    LATEST,
    Ground,
    ReactSettings,
    Reaiming,
    best_aim,
    drawn,
    moments,
    surroundings,
)
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import FULL, PAIR, SINGLE
from e2rl.traffic.transform import AdversarialSynthesizer
from tests.traffic.e2.crossing import make_world
from tests.traffic.e2.traffic_scenes import scenes
from tests.traffic.test_transform import in_turn

ON = SimSettings(end_on_contact=False, end_off_road=False)
EVERYBODY = ReactSettings(fraction=1.0, others=0.0)
STEPS = 40


def stored(scene_set, eta=2.0):
    """Stored rows that replay the log, with vehicles 2 and 3 as adversaries."""
    scene = scene_set.scenes
    index = torch.arange(len(scene_set))
    adversaries = torch.zeros(scene["logged_valid"][:, 0].shape, dtype=torch.bool)
    adversaries[:, 2:4] = True
    traffic = {
        "scene_index": index,
        "states": scene["logged"],
        "valid": scene["logged_valid"],
    }
    return TrafficPool.stored(traffic | {"adversaries": adversaries}, eta)


def driven(pool, scene_set, settings):
    """Frames [B, T] of an ego in each row of a pool."""
    base = DrivingEnv(scene_set, ON, len(pool), agents=True)
    reaction = None if settings is None else Reaiming(settings)
    env = TransformedEnv(
        base, AdversarialSynthesizer(pool, in_turn(pool), reaction=reaction)
    )
    return env.rollout(STEPS, EgoPolicy(IDMEgo(), env), break_when_any_done=False)


def tracks(frames):
    return frames["next", "agents", "states"]


@pytest.fixture(scope="module")
def scene_set():
    return scenes(4, STEPS)


def test_traffic_in_which_nobody_reacts_is_today_s_bit_for_bit(scene_set):
    pool = (
        stored(scene_set)
        + stored(scene_set, 0.0)
        + TrafficPool.recorded(torch.arange(4))
    )
    today = driven(pool, scene_set, settings=None)
    nobody = driven(pool, scene_set, settings=ReactSettings(fraction=0.0))
    for key in today.keys(True, True):
        assert torch.equal(today[key], nobody[key]), key
    reacting = driven(pool, scene_set, settings=EVERYBODY)
    assert torch.equal(tracks(today)[4:], tracks(reacting)[4:]), (
        "nor in rows without an intensity"
    )


def test_the_row_s_adversaries_leave_the_replay_and_everybody_else_stays(scene_set):
    pool = stored(scene_set)
    frames = driven(pool, scene_set, settings=EVERYBODY)
    moved = (tracks(frames) != pool.parts[0].states[:, 1:]).any(-1)
    others = [1, *range(4, moved.shape[2])]
    assert moved[:, :, 2:4].any(2).any(1).all() and not moved[:, :, others].any()
    first = moved[:, :, 2:4].any(2).int().argmax(1)
    assert (first <= LATEST * STEPS + 5).all() and len(first.unique()) > 1, (
        "at random moments"
    )


def test_other_vehicles_that_move_near_the_ego_react(scene_set):
    pool = stored(scene_set)
    frames = driven(
        pool,
        scene_set,
        settings=ReactSettings(fraction=1.0, others=1.0, responsibility="none"),
    )
    moved = (tracks(frames) != pool.parts[0].states[:, 1:]).any(-1)
    assert (
        moved[:, :, [1, 4]].any(2).any(1).all() and not moved[:, :, [2, 3, 5]].any()
    ), "5 is parked"
    full = driven(pool, scene_set, settings=ReactSettings(fraction=1.0, others=1.0))
    leads = (tracks(full) != pool.parts[0].states[:, 1:]).any(-1)[..., 4]
    assert not leads.any(), "under full responsibility none that leads the ego's way"


def test_the_attack_s_intensity_template_and_duty_may_say_how_they_react():
    eta = torch.tensor([0.0, 0.5, 2.5, 2.5])
    template = torch.tensor([PAIR, SINGLE, SINGLE, FULL])
    owes = torch.tensor([True, True, False, True])
    given = (
        owes,
        torch.ones(4, 6, dtype=torch.bool),
        STEPS,
        torch.Generator().manual_seed(0),
    )
    part = drawn(
        ReactSettings(fraction=1.0, eta=None, reckless=None), eta, template, *given
    )
    assert torch.equal(part["reckless"], ~owes)
    assert torch.equal(part["eta"], eta) and part["count"][1:].tolist() == [1, 1, 2]
    assert ((part["start"] < STEPS) == (eta > 0)).all()
    part = drawn(ReactSettings(fraction=1.0, eta=(1.0, 1.0)), eta, template, *given)
    assert part["eta"].tolist() == [0.0, 1.0, 1.0, 1.0]


# --- the law: closed forms, its limits, the drivable area, and what it owes the ego and
# others

STILL = torch.zeros(1, 2)
LAWFUL = torch.tensor([False])


def law(responsibility):
    return Reaiming(replace(EVERYBODY, responsibility=responsibility)).aims


def ground_of(world):
    return Ground(
        torch.full_like(world.scene["field"], -5.0),
        world.scene["field_origin"],
        row=torch.tensor([0]),
    )


def seen_by(vehicles):
    """What vehicle 1 sees, and the ground, all of it drivable."""
    world = make_world(vehicles)
    return surroundings(world, torch.tensor([0]), agents=torch.tensor([1])), ground_of(
        world
    )


def aimed(vehicles, eta=2.0, responsibility="none", shift=STILL):
    seen, ground = seen_by(vehicles)
    return seen, law(responsibility)(seen, torch.tensor([eta]), shift, ground, LAWFUL)


@pytest.mark.parametrize(
    "distance, speed", [(30.0, 8.0), (12.0, 4.0), (45.0, 10.0), (20.0, 0.0)]
)
def test_straight_ahead_of_a_standing_ego_it_touches_it_at_the_chosen_moment(
    distance, speed
):
    """And is not there before, at the accelerations that are allowed."""
    seen, aim = aimed([(0, 0, 0, 0.0), (distance, 0, math.pi, speed)])
    assert aim.curvature.abs().item() < 1e-3 and -2.4 <= aim.accel.item() <= 3.0
    times = torch.arange(1, 501) / 100
    path, driven = along_arc(seen.states[:, 1], aim, times=times)
    met = overlap(
        path,
        seen.scene["size"][:, 1, None],
        second=seen.states[:, :1],
        second_size=seen.scene["size"][:, :1],
    )[0]
    arrival = times[driven[0] >= distance - 0.4 * 2 * 4.5 - 1e-3]
    assert met.any() and len(arrival), "it comes there"
    assert (arrival[0] / 0.5 - (arrival[0] / 0.5).round()).abs() < 0.021, (
        "at one of the ten moments"
    )


def test_aims_keep_the_limits_at_every_intensity():
    torch.manual_seed(0)
    count = 400
    states = torch.stack(
        [*(60 * torch.rand(3, count) - 30), 20 * torch.rand(count)], -1
    )
    ego = torch.stack([*(60 * torch.rand(3, count) - 30), 15 * torch.rand(count)], -1)
    target = along_arc(
        ego, Arc(torch.zeros(count), torch.zeros(count)), times=moments(ego)
    )[0]
    eta = 1 + 2 * torch.rand(count)
    length = torch.full((count,), 4.5)
    ground = Ground(
        torch.full((1, 200, 200), -5.0),
        torch.tensor([[-100.0, -100.0]]),
        row=torch.zeros(count).long(),
    )
    aim = best_aim(
        states,
        target,
        lengths=2 * length,
        eta=eta,
        ground=ground,
        limits=InterceptionSettings(),
    )
    some = ~aim.accel.isnan()
    assert 0.2 < some.float().mean() < 0.8, "not where the ego is behind"
    accel = aim.accel[some]
    curvature = aim.curvature[some].abs()
    eta = eta[some]
    v = states[some, 3]
    assert (accel <= 1.5 * eta + 1e-4).all() and (accel >= -1.2 * eta - 1e-4).all()
    assert (curvature <= SHARPEST + 1e-6).all() and (
        v**2 * curvature <= 2 * eta + 1e-3
    ).all()


def test_it_aims_where_the_ego_is_expected_by_its_motion():
    """To the left of a turning ego's way straight on; and the nearer the misjudged
    place, the more to that side."""
    seen, ground = seen_by([(0, 0, 0, 8.0), (40, 0, math.pi, 8.0)])
    straight = law("none")(seen, torch.tensor([2.0]), STILL, ground, LAWFUL)
    seen.turn_rate[:, 0] = 0.2
    turning = law("none")(seen, torch.tensor([2.0]), STILL, ground, LAWFUL)
    assert straight.curvature.abs() < 1e-3 and turning.curvature < -1e-2
    _, misjudged = aimed(
        [(0, 0, 0, 8.0), (40, 0, math.pi, 8.0)], shift=torch.tensor([[0.0, 2.0]])
    )
    assert -0.05 < misjudged.curvature < -1e-3


def test_without_a_drivable_aim_it_unwinds_its_curvature_and_brakes_gently():
    """Off the road on all sides but its own place; or with the ego behind."""
    seen, ground = seen_by([(0, 0, 0, 5.0), (30, 20, -1.6, 8.0)])
    seen.turn_rate[:, 1] = 0.8
    column, row = (seen.states[0, 1, :2] - ground.origin[0]).round().long()
    ground.field.fill_(5.0)[:, column - 1 : column + 2, row - 1 : row + 2] = -1.0
    aim = law("none")(seen, torch.tensor([2.0]), STILL, ground, LAWFUL)
    assert aim.curvature.item() == pytest.approx(
        0.05
    ) and aim.accel.item() == pytest.approx(-1.0)
    _, away = aimed([(0, 0, 0, 5.0), (10, 0, 0, 20.0)], eta=0.1)
    assert away.accel.item() <= 0


def test_only_paths_on_the_drivable_area_are_taken():
    seen, ground = seen_by([(0, 20, 0, 5.0), (-20, 0, 0, 8.0)])
    free = law("none")(seen, torch.tensor([2.0]), STILL, ground, LAWFUL)
    ground.field[:] = (
        torch.arange(ground.field.shape[-1]) + ground.origin[0, 1] - 3.0
    ).clamp(-5, 5)
    kerb = law("none")(seen, torch.tensor([2.0]), STILL, ground, LAWFUL)
    assert free.curvature > 0.01
    end = along_arc(seen.states[:, 1], kerb, times=torch.tensor([2.0]))[0]
    assert end[0, 0, 1] < 3.6


def followed_for(seconds, responsibility, vehicles):
    """Whether vehicle 1, re-aiming every 0.5 s, touches an ego that keeps its velocity."""
    world = make_world(vehicles)
    aims = law(responsibility)
    generator = torch.Generator().manual_seed(0)
    touched = False
    for _ in range(round(seconds / 0.5)):
        seen = surroundings(world, torch.tensor([0]), agents=torch.tensor([1]))
        aim = aims(
            seen,
            torch.tensor([3.0]),
            0.7 * torch.randn(1, 2, generator=generator),
            ground_of(world),
            LAWFUL,
        )
        states = world.states.clone()
        path, _ = along_arc(states[:, 1], aim, times=DT * torch.arange(1, 6))
        still = Arc(torch.zeros(1), torch.zeros(1))
        ego, _ = along_arc(states[:, 0], still, times=DT * torch.arange(1, 6))
        size = world.scene["size"]
        touched |= (
            overlap(path, size[:, 1, None], second=ego, second_size=size[:, :1])
            .any()
            .item()
        )
        world.turn_rate[:, 1] = dynamics.wrap(path[:, -1, 2] - states[:, 1, 2]) / 0.5
        world.accel[:, 1] = aim.accel
        states[:, 0], states[:, 1] = ego[:, -1], path[:, -1]
        world.states = states
    return touched


@pytest.mark.parametrize("speed", [10.0, 16.0])
def test_from_behind_it_hits_a_steady_ego_without_responsibility_and_never_with_it(
    speed,
):
    vehicles = [(0, 0, 0, 9.0), (-25, 0, 0, speed)]
    assert followed_for(8, "none", vehicles=vehicles)
    assert not followed_for(8, "full", vehicles=vehicles) and not followed_for(
        8, "rear", vehicles=vehicles
    )


def test_a_reckless_vehicle_owes_the_ego_nothing_whatever_the_law():
    (seen, ground), eta, reckless = (
        seen_by([(0, 0, 0, 9.0), (-12, 0, 0, 14.0)]),
        torch.tensor([3.0]),
        ~LAWFUL,
    )
    free, lawful = (
        law(name)(seen, eta, STILL, ground, LAWFUL) for name in ("none", "full")
    )
    assert law("full")(seen, eta, STILL, ground, reckless) == free
    assert (
        law("full")(seen, eta, STILL, ground, ~reckless) == lawful
        and lawful.accel < free.accel
    )


def test_ahead_it_gives_way_late_but_in_time_under_full_responsibility():
    crossing = [(0, 0, 0, 9.0), (30, -25, math.pi / 2, 8.0)]
    assert followed_for(6, "none", vehicles=crossing) and not followed_for(
        6, "full", vehicles=crossing
    )
    near, far = (
        aimed([(0, 0, 0, 9.0), (x, 0, math.pi, 8.0)], responsibility="full")[1].accel
        for x in (20.0, 60.0)
    )
    free = aimed([(0, 0, 0, 9.0), (60.0, 0, math.pi, 8.0)])[1].accel
    assert near < -2.4 and far == free, "it waits while little braking still suffices"


def test_it_brakes_for_the_vehicle_ahead_of_it():
    way = [(60, 0, 0, 9.0), (0, 0, 0, 12.0)]
    _, free = aimed(way)
    _, behind = aimed([*way, (12, 0, 0, 4.0)])
    _, beside = aimed([*way, (12, 4.0, 0, 4.0)])
    assert behind.accel < -3 and beside.accel == free.accel
