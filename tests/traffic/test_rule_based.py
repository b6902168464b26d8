"""Traffic without samples: log replay and constant velocity exactly, IDM by its closed
forms and the prior's bounds."""

import math

import pytest
import torch

from e2rl.prior.bounds import BoundSettings
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT, LIGHT_RED, LIGHT_YELLOW
from e2rl.sim.world import World
from e2rl.traffic.rule_based import IDM, ConstantVelocity, LogReplay
from tests.prior.small import curved_scenes, small_prior
from tests.synthetic import make_scenes
from tests.traffic.e2.traffic_scenes import ROWS, begin, drive, scenes


def recorded(steps=40):
    """Scenes whose vehicles waver, vanish, come back, end early or arrive late."""
    scene_set = scenes(3, steps=steps)
    logged = scene_set.scenes["logged"]
    valid = scene_set.scenes["logged_valid"]
    generator = torch.Generator().manual_seed(0)
    logged[:, 1:, 1:6] += 0.3 * torch.randn(3, steps, 5, 4, generator=generator)
    valid[:, 7:13, 1], valid[:, 22:, 2], valid[:, :11, 6] = False, False, False
    valid[:, 11:, 6] = True  # arrives during the scene
    return scene_set


def test_rollouts_are_the_log_bit_for_bit_with_its_gaps():
    scene_set = recorded()
    rollouts = drive(scene_set, LogReplay(), 0.0)
    logged = scene_set.scenes["logged"][:, :, 1:]
    valid = scene_set.scenes["logged_valid"][:, :, 1:]
    assert torch.equal(rollouts.valid[:, :, 1:], valid)
    assert torch.equal(rollouts.states[:, :, 1:][valid], logged[valid])
    assert not rollouts.adversaries.any()
    assert (rollouts.transport_others == 0).all()


def test_after_the_recording_s_end_nobody_is_there():
    scene = curved_scenes(steps=30)
    world = World.at_start(scene)
    world.step = torch.tensor([12])
    _, plan = LogReplay().replan(None, world, world.states[:, :1])
    here = scene["logged_valid"][:, 13:31, :ROWS].transpose(1, 2)
    assert torch.equal(plan.present[..., :18], here)
    assert not plan.present[..., 18:].any()
    assert torch.equal(
        plan.states[..., :18, :], scene["logged"][:, 13:31, :ROWS].transpose(1, 2)
    )


def test_everybody_goes_straight_on_for_the_whole_rollout_and_nobody_leaves():
    scene_set = scenes(2, steps=40)
    scene_set.scenes["start"][:, 1:5, 2] = torch.tensor([0.3, -2.0, 3.0, 1.0])
    scene_set.scenes["logged"][:, 0] = scene_set.scenes["start"]
    scene_set.scenes["logged_valid"][:, 5:, 2] = (
        False  # what is recorded later is not known
    )
    rollouts = drive(scene_set, ConstantVelocity(), 0.0)
    start = scene_set.scenes["start"][:, None, 1:6]
    velocity = start[..., 3:] * torch.stack(
        [start[..., 2].cos(), start[..., 2].sin()], -1
    )
    track = rollouts.states[:, :, 1:6]
    expected = start[..., :2] + velocity * DT * torch.arange(41)[:, None, None]
    torch.testing.assert_close(track[..., :2], expected, rtol=0, atol=1e-4)
    assert torch.equal(track[..., 2:], start[..., 2:].expand_as(track[..., 2:]))
    assert rollouts.valid[:, :, 1:6].all()
    assert (rollouts.states[:, :, 5, 3] == 0).all()


def test_who_reverses_goes_on_at_constant_velocity_and_halts_under_idm():
    """3 m/s backwards: 12 m in 4 s, or 1.5 m at 3 m/s^2; every step as long as its
    speed makes it."""
    scene_set = scenes(2, steps=40)
    scene_set.scenes["start"][:, 1, 3] = -3.0
    scene_set.scenes["logged"][:, 0] = scene_set.scenes["start"]
    back = drive(scene_set, ConstantVelocity(), 0.0).states[:, :, 1]
    assert (back[:, -1, :2] - back[:, 0, :2]).norm(dim=-1).tolist() == pytest.approx(
        [12.0, 12.0], abs=1e-3
    )
    halts = drive(scene_set, idm(), 0.0).states[:, :, 1]
    way = halts[..., :2].diff(dim=1)
    along = way[..., 0] * halts[:, :1, 2].cos() + way[..., 1] * halts[:, :1, 2].sin()
    torch.testing.assert_close(
        along, (halts[:, 1:, 3] + halts[:, :-1, 3]) / 2 * DT, rtol=0, atol=2e-3
    )
    assert along.sum(1).tolist() == pytest.approx([-1.5, -1.5], abs=0.02)
    assert (halts[:, 11:, 3] == 0).all()


NO_BOUNDS = BoundSettings(meeting=False, curve=False)
HEADWAY = 1.5
STANDSTILL_GAP = 2.0
LIMIT = 15.0
LENGTH = 4.5
AWAY = (-150, 1, 10.0)  # an ego that nobody meets


def idm(bounds=NO_BOUNDS):
    return IDM(small_prior(bounds=bounds))


def plan_of(world, bounds=NO_BOUNDS):
    """Planned states [V, HORIZON, 4] of the one scene's vehicles."""
    on = idm(bounds)
    return on.replan(
        begin(on, world.scene), world, world.states[:, :1].expand(-1, HORIZON, -1)
    )[1].states[0]


def acceleration_in(plan):
    """Acceleration of vehicle 1 once the plan's first half second, over which it is
    taken up, has passed."""
    return ((plan[1, 15, 3] - plan[1, 10, 3]) / (5 * DT)).item()


def scenes_of(vehicles, **options):
    """Scenes with these vehicles and nobody else."""
    sizes = {
        "num_vrus": 0,
        "max_vehicles": ROWS,
        "max_agents": ROWS + 2,
        "road": (-200.0, 400.0),
    }
    return make_scenes(**({"num_scenes": 1, "vehicles": vehicles} | sizes | options))


def acceleration(vehicles, limit=LIMIT):
    return acceleration_in(
        plan_of(World.at_start(scenes_of(vehicles, limit=limit).scenes))
    )


@pytest.mark.parametrize("speed", [3.0, 14.0, LIMIT, 22.0])
def test_on_a_free_road_it_accelerates_towards_the_limit_and_above_it_brakes_comfortably(
    speed,
):
    expected = (
        1 - (speed / LIMIT) ** 4 if speed <= LIMIT else -2 * (1 - (LIMIT / speed) ** 2)
    )
    assert acceleration([AWAY, (0, 0, speed)]) == pytest.approx(expected, abs=1e-4)


def test_where_no_limit_is_known_it_wants_its_start_speed_or_the_set_one():
    assert acceleration([AWAY, (0, 0, 13.0)], limit=0.0) == pytest.approx(0, abs=1e-5)
    assert acceleration([AWAY, (0, 0, 5.0)], limit=0.0) == pytest.approx(
        1 - 0.5**4, abs=1e-4
    )


def test_closing_in_has_the_model_s_acceleration():
    v = 10.0
    lead = 7.0
    gap = 30.0
    wanted = 2 + 1.5 * v + v * (v - lead) / (2 * math.sqrt(2))
    expected = 1 - (v / LIMIT) ** 4 - (wanted / gap) ** 2
    assert acceleration([AWAY, (0, 0, v), (gap + LENGTH, 0, lead)]) == pytest.approx(
        expected, abs=1e-3
    )


def test_nobody_beside_or_behind_is_followed_but_the_ego_is():
    free = acceleration([AWAY, (0, 0, 10)])
    assert acceleration([AWAY, (0, 0, 10), (9, 1, 4), (-9, 0, 12)]) == pytest.approx(
        free
    )
    assert acceleration([(14, 0, 6), (0, 0, 10)]) < free - 1


def test_vehicles_drive_on_the_middle_of_their_lane_and_never_backwards():
    scene_set = scenes_of(
        [AWAY, (0, 0, 9), (18, 0, 2), (5, 1, 12)], num_scenes=2, steps=60
    )
    for key in ("start", "logged"):
        scene_set.scenes[key][..., 1, 1] += 0.4
    track = drive(scene_set, idm(BoundSettings()), 0.0).states[:, :, 1:4]
    assert (track[..., 3] >= 0).all()
    assert (track.diff(dim=1)[..., 0] >= -1e-4).all()
    aside = track[..., 1] - torch.tensor([0, 0, 3.5])
    assert aside[..., 1:].abs().max() < 1e-4
    assert aside[:, -1, 0].max() < 0.15
    assert aside[..., 0].min() > -0.01


def test_it_stops_at_the_line_of_a_red_or_yellow_light_and_waits():
    line = 60.0
    vehicles = [
        AWAY,
        (20, 0, 9),
        (5, 0, 9),
        (line - 0.5, 1, 9),
    ]  # two in line, one that can no longer stop
    scene_set = scenes_of(
        vehicles, num_scenes=2, steps=120, red_light_x=line, limit=LIMIT
    )
    scene_set.scenes["light_state"][0] = LIGHT_RED
    scene_set.scenes["light_state"][1] = LIGHT_YELLOW
    red, yellow = drive(scene_set, idm(BoundSettings()), 0.0).states
    waits_at(line, red)
    waits_at(line, yellow)


def waits_at(line, track):
    """Two of the three vehicles of a track [T+1, A, 4] halt before the line."""
    front = track[:, 1:4, 0] + LENGTH / 2
    assert (front[:, 0] < line).all()
    assert front[-1, 0] > line - 3
    assert track[-1, 1, 3] < 0.3
    assert front[-1, 1] < front[-1, 0] - LENGTH
    assert track[-1, 2, 3] < 0.5
    assert front[-1, 2] > line + 50, "who is at the line at speed goes on"


def test_a_green_light_is_no_obstacle():
    result = {}
    for red in (True, False):
        scene = scenes_of([AWAY, (0, 0, 10)], red_light_x=25.0, limit=LIMIT).scenes
        scene["light_state"][:] = LIGHT_RED if red else LIGHT_RED + 2
        result[red] = acceleration_in(plan_of(World.at_start(scene)))
    assert result[True] < -1
    assert result[False] == pytest.approx(1 - (10 / LIMIT) ** 4, abs=1e-4)


def test_who_stands_at_the_start_stands_for_good():
    scene_set = scenes_of([AWAY, (0, 0, 0.4), (30, 0, 0.0), (0, 1, 8.0)], steps=60)
    states = drive(scene_set, idm(BoundSettings()), 0.0).states[0]
    assert torch.equal(
        states[1:, 1:3, :2], scene_set.scenes["start"][0, 1:3, :2].expand(60, 2, 2)
    )
    assert (states[1:, 1:3, 3] == 0).all()
    assert states[-1, 3, 0] > 40


def test_a_vehicle_is_gone_once_its_route_leaves_the_map():
    scene_set = scenes_of(
        [AWAY, (50, 0, 10), (0, 1, 10)], steps=60, road=(-200.0, 80.0)
    )
    rollouts = drive(scene_set, idm(BoundSettings()), 0.0)
    x = rollouts.states[0, :, 1:3, 0]
    place = rollouts.valid[0, :, 1:3]
    assert place[:, 1].all()
    assert not place[-1, 0]
    assert (x[:, 0][place[:, 0]] <= 80.5).all()
    assert (place[1:, 0] <= place[:-1, 0]).all(), "nobody comes back"


@pytest.mark.parametrize("floor", [-7.0, -4.0])
def test_it_never_brakes_harder_than_the_bounds_do(floor):
    scene_set = scenes_of([AWAY, (0, 0, 12), (9, 0, 2)], steps=40)
    speed = drive(scene_set, idm(BoundSettings(floor=floor)), 0.0).states[0, :, 1, 3]
    assert (speed.diff() / DT).min().item() == pytest.approx(floor, abs=1e-2)
