"""The IDM ego: leaders, red lights, returning to its lane; the model itself: tests/sim/test_car_following.py."""

import torch

from e2rl.planners.ego import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.synthetic import make_scenes


def drive(steps=80, ego=None, **scene):
    env = DrivingEnv(make_scenes(1, **scene), SimSettings(), 1, agents=True)
    data = env.rollout(steps, EgoPolicy(ego or IDMEgo(), env))
    return env, data


def test_settles_behind_a_slower_leader():
    env, data = drive(80, vehicles=[(0.0, 0, 9.0), (30.0, 0, 6.0), (30.0, 1, 0.0)], limit=10.0)
    world = env.world()
    assert not data["next", "done"][:, :-1].any()
    gap = world.states[0, 1, 0] - world.states[0, 0, 0] - 4.5
    assert world.states[0, 0, 3] < 7.0 and 8 < gap < 20


def test_adjacent_lanes_do_not_lead():
    world, data = drive(30, vehicles=[(0.0, 0, 10.0), (10.0, 1, 0.0)], limit=10.0)
    assert world.world().states[0, 0, 3] > 9.9


def test_stops_behind_a_parked_car():
    env, data = drive(80, vehicles=[(0.0, 0, 10.0), (62.0, 0, 0.0)])
    x, speed = env.world().states[0, 0, 0], env.world().states[0, 0, 3]
    assert not data["next", "terminated"].any() and speed < 2.5 and 40 < x < 58


def test_returns_to_its_lane():
    scenes = make_scenes(1, num_vehicles=1)
    scenes.scenes["start"][0, 0, 1:3] = torch.tensor([0.8, -0.1])
    env = DrivingEnv(scenes, SimSettings(), 1, agents=True)
    data = env.rollout(60, EgoPolicy(IDMEgo(), env))
    assert env.world().states[0, 0, 1].abs() < 0.03
    assert data["action"][..., 1].abs().max() < 0.3
