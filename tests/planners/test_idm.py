"""The IDM ego: its leader, returning to its lane; the model itself: tests/sim/test_leaders.py."""

import torch

from e2rl.planners.ego import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from tests.planners.planners import driven, worlds
from tests.synthetic import make_scenes


def test_settles_behind_a_slower_leader():
    data, state = driven(IDMEgo(), vehicles=[(0.0, 0, 9.0), (30.0, 0, 6.0), (30.0, 1, 0.0)], limit=10.0)
    gap = 30.0 + 8 * 6.0 - state[0] - 4.5
    assert not data["next", "done"][:, :-1].any() and state[3] < 7.0 and 8 < gap < 20


def test_returns_to_its_lane():
    scenes = make_scenes(1, num_vehicles=1)
    scenes.scenes["start"][0, 0, 1:3] = torch.tensor([0.8, -0.1])
    env, _ = worlds(scenes)
    data = env.rollout(60, EgoPolicy(IDMEgo(), env))
    assert env.world().states[0, 0, 1].abs() < 0.03
    assert data["action"][..., 1].abs().max() < 0.3
