"""IDM: closed forms of car-following, red lights, standing cars, and the prior's own bounds."""

import math

import pytest
import torch

from e2rl.prior.bounds import NO_CAP, BoundSettings, Obstacles, acceleration_caps
from e2rl.prior.lane_relative import HORIZON
from e2rl.scene.recording import DT, LIGHT_RED, LIGHT_YELLOW
from e2rl.traffic.idm import IDM, IDMSettings
from tests.prior.small import curved_scenes
from tests.synthesizer.crossing import make_world
from tests.synthesizer.test_synthesizer import world_of
from tests.synthesizer.traffic_scenes import ROWS, drive
from tests.synthetic import make_scenes

NO_BOUNDS = BoundSettings(meeting=False, curve=False)
OWN = IDMSettings()
LIMIT, LENGTH = 15.0, 4.5
AWAY = (-150, 1, 10.0)  # an ego that nobody meets


def plan_of(world, bounds=NO_BOUNDS):
    """The plan [1, V, HORIZON] of the one scene's vehicles."""
    on, scene = IDM(bounds), world.scene
    episode = on.begin(scene, torch.zeros(len(scene), dtype=torch.int64), torch.zeros(len(scene)))
    return on.replan(episode, world, world.states[:, :1].expand(-1, HORIZON, -1))[1]


def acceleration(vehicles, limit=LIMIT):
    """Acceleration of vehicle 1 once the plan's first half second, over which it is taken up, has passed."""
    scene = make_scenes(
        1, vehicles=vehicles, num_vrus=0, max_vehicles=ROWS, max_agents=ROWS + 2, road=(-200.0, 400.0), limit=limit
    ).scenes
    return plan_of(world_of(scene)).motion.a[0, 1, 10].item()


@pytest.mark.parametrize("speed", [3.0, 10.0, 14.0])
def test_on_a_free_road_it_accelerates_towards_the_limit(speed):
    assert acceleration([AWAY, (0, 0, speed)]) == pytest.approx(1 - (speed / LIMIT) ** 4, abs=1e-4)


def test_at_the_limit_it_holds_and_above_it_brakes_comfortably():
    assert acceleration([AWAY, (0, 0, LIMIT)]) == pytest.approx(0, abs=1e-5)
    assert acceleration([AWAY, (0, 0, 22.0)]) == pytest.approx(-2 * (1 - (LIMIT / 22) ** 2), abs=1e-4)


def test_where_no_limit_is_known_it_wants_its_start_speed_or_the_set_one():
    assert acceleration([AWAY, (0, 0, 13.0)], limit=0.0) == pytest.approx(0, abs=1e-5)
    assert acceleration([AWAY, (0, 0, 5.0)], limit=0.0) == pytest.approx(1 - 0.5**4, abs=1e-4)


@pytest.mark.parametrize("speed", [3.0, 10.0])
def test_at_the_equilibrium_gap_it_follows_at_its_leader_s_speed(speed):
    gap = (OWN.standstill_gap + speed * OWN.headway) / math.sqrt(1 - (speed / LIMIT) ** 4)
    for extra, sign in ((0.0, 0), (2.0, 1), (-2.0, -1)):
        found = acceleration([AWAY, (0, 0, speed), (gap + LENGTH + extra, 0, speed)])
        assert found == pytest.approx(0, abs=1e-3) if not sign else found * sign > 0.02


def test_closing_in_has_the_model_s_acceleration():
    v, lead, gap = 10.0, 7.0, 30.0
    wanted = 2 + 1.5 * v + v * (v - lead) / (2 * math.sqrt(2))
    expected = 1 - (v / LIMIT) ** 4 - (wanted / gap) ** 2
    assert acceleration([AWAY, (0, 0, v), (gap + LENGTH, 0, lead)]) == pytest.approx(expected, abs=1e-3)


def test_nobody_beside_or_behind_is_followed_but_the_ego_is():
    free = acceleration([AWAY, (0, 0, 10)])
    assert acceleration([AWAY, (0, 0, 10), (9, 1, 4), (-9, 0, 12)]) == pytest.approx(free)
    assert acceleration([(14, 0, 6), (0, 0, 10)]) < free - 1


def test_vehicles_drive_on_the_middle_of_their_lane_and_never_backwards():
    scene_set = make_scenes(
        2,
        vehicles=[AWAY, (0, 0, 9), (18, 0, 2), (5, 1, 12)],
        num_vrus=0,
        steps=60,
        max_vehicles=ROWS,
        max_agents=ROWS + 2,
        road=(-200.0, 400.0),
    )
    for key in ("start", "logged"):
        scene_set.scenes[key][..., 1, 1] += 0.4
    track = drive(scene_set, IDM(BoundSettings()), 0.0)["states"][:, :, 1:4]
    assert (track[..., 3] >= 0).all() and (track.diff(dim=1)[..., 0] >= -1e-4).all()
    aside = track[..., 1] - torch.tensor([0, 0, 3.5])
    assert aside[..., 1:].abs().max() < 1e-4 and aside[:, -1, 0].max() < 0.15 and aside[..., 0].min() > -0.01


@pytest.mark.parametrize("colour", [LIGHT_RED, LIGHT_YELLOW])
def test_it_stops_at_the_line_of_a_red_or_yellow_light_and_waits(colour):
    line = 60.0
    vehicles = [AWAY, (20, 0, 9), (5, 0, 9), (line - 0.5, 1, 9)]  # two in line, one that can no longer stop
    scene_set = make_scenes(
        1,
        vehicles=vehicles,
        num_vrus=0,
        steps=200,
        red_light_x=line,
        max_vehicles=ROWS,
        max_agents=ROWS + 2,
        road=(-200.0, 400.0),
        limit=LIMIT,
    )
    scene_set.scenes["light_state"][:] = colour
    track = drive(scene_set, IDM(BoundSettings()), 0.0)["states"][0]
    front = track[:, 1:4, 0] + LENGTH / 2
    assert (front[:, 0] < line).all() and front[-1, 0] > line - 3 and track[-1, 1, 3] < 0.3
    assert front[-1, 1] < front[-1, 0] - LENGTH and track[-1, 2, 3] < 0.5
    assert front[-1, 2] > line + 50, "who is at the line at speed goes on"


def test_a_green_light_is_no_obstacle():
    found = {}
    for red in (True, False):
        scene = make_scenes(
            1,
            vehicles=[AWAY, (0, 0, 10)],
            num_vrus=0,
            red_light_x=25.0,
            max_vehicles=ROWS,
            max_agents=ROWS + 2,
            road=(-200.0, 400.0),
            limit=LIMIT,
        ).scenes
        scene["light_state"][:] = LIGHT_RED if red else LIGHT_RED + 2
        found[red] = plan_of(world_of(scene)).motion.a[0, 1, 10].item()
    assert found[True] < -1 and found[False] == pytest.approx(1 - (10 / LIMIT) ** 4, abs=1e-4)


def test_who_stands_at_the_start_stands_for_good():
    vehicles = [AWAY, (0, 0, 0.4), (30, 0, 0.0), (0, 1, 8.0)]
    scene_set = make_scenes(1, vehicles=vehicles, num_vrus=0, steps=60, max_vehicles=ROWS, max_agents=ROWS + 2)
    rollouts = drive(scene_set, IDM(BoundSettings()), 0.0)
    states = rollouts["states"][0]
    assert torch.equal(states[1:, 1:3, :2], scene_set.scenes["start"][0, 1:3, :2].expand(60, 2, 2))
    assert (states[1:, 1:3, 3] == 0).all() and states[-1, 3, 0] > 40


def test_a_vehicle_is_gone_once_its_route_leaves_the_map():
    scene_set = make_scenes(
        1,
        vehicles=[AWAY, (50, 0, 10), (0, 1, 10)],
        num_vrus=0,
        steps=60,
        max_vehicles=ROWS,
        max_agents=ROWS + 2,
        road=(-200.0, 80.0),
    )
    rollouts = drive(scene_set, IDM(BoundSettings()), 0.0)
    x, there = rollouts["states"][0, :, 1:3, 0], rollouts["valid"][0, :, 1:3]
    assert there[:, 1].all() and not there[-1, 0] and (x[:, 0][there[:, 0]] <= 80.5).all()
    assert (there[1:, 0] <= there[:-1, 0]).all(), "nobody comes back"


@pytest.mark.parametrize("floor", [-7.0, -4.0])
def test_it_never_brakes_harder_than_the_bounds_do(floor):
    scene_set = make_scenes(
        1,
        vehicles=[AWAY, (0, 0, 12), (9, 0, 2)],
        num_vrus=0,
        steps=40,
        max_vehicles=ROWS,
        max_agents=ROWS + 2,
        road=(-200.0, 400.0),
    )
    speed = drive(scene_set, IDM(BoundSettings(floor=floor)), 0.0)["states"][0, :, 1, 3]
    assert (speed.diff() / DT).min().item() == pytest.approx(floor, abs=1e-2)


CROSSING = [(-150, 40, 0, 10), (0, 0, 0, 10), (22, -22, math.pi / 2, 10)]  # two that reach (22, 0) together


def caps_of(world, plan, settings):
    on = IDM(NO_BOUNDS)
    state = on.begin(world.scene, torch.zeros(1, dtype=torch.int64), torch.zeros(1)).state
    obstacles = Obstacles(
        world.states, world.scene["size"], world.valid, torch.zeros_like(world.valid[:, : state.v.shape[1]])
    )
    return acceleration_caps(settings, plan.motion, state, obstacles)[0]


def test_it_is_under_the_bounds_of_the_prior():
    """The first knot of whoever runs into a crossing car is the bound's cap; others drive as without bounds."""
    settings, world = BoundSettings(), make_world(CROSSING)
    free, bounded = plan_of(world), plan_of(world, settings)
    caps = caps_of(world, free, settings)
    brakes = caps < NO_CAP
    assert brakes.sum() == 1 and (caps_of(world, bounded, settings)[~brakes] == NO_CAP).all()
    row = brakes.nonzero().item()
    first, before = bounded.motion.v[0, row, 4].item(), world.states[0, row, 3].item()
    onset = max(caps[row].item(), -settings.onset)
    assert first == pytest.approx(before + 0.25 * (onset + caps[row].item()), abs=1e-3)
    assert torch.equal(bounded.states()[0, ~brakes], free.states()[0, ~brakes])


def test_curves_are_taken_no_faster_than_the_bounds_allow():
    scene = curved_scenes()
    scene["route_limit"][:] = 25.0
    scene["start"][:, 1:, 3] *= 2.5
    speeds = [plan_of(world_of(scene), BoundSettings(meeting=False, lateral=lateral)).motion for lateral in (1.0, 5.0)]
    slow, fast = ((motion.v**2 * motion.kappa.abs())[0, 1:5, 25].amax().item() for motion in speeds)
    assert slow < fast
