"""Tracking leaves no error on drivable plans, makes good deviations, and a policy restarts with its episodes."""

import pytest
import torch
from torchrl.collectors import Collector

from e2rl.ego.base import PLAN_STEPS, Ego, EgoPolicy, track
from e2rl.ego.path import MissionPath
from e2rl.ego.replay import ReplayEgo
from e2rl.errors import InputError
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.synthetic import make_scenes


class Cruise(Ego):
    """The example of e2rl.ego.base, counting its plans."""

    plans = 0

    def plan(self, world):
        self.plans += 1
        path = MissionPath(world)
        return path.drive(world.states[:, 0, 3:].expand(-1, PLAN_STEPS + 1))


def test_a_drivable_plan_is_followed_without_error():
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([0.0, 0.0, 0.5, 12.0], dtype=torch.float64)
    actions = torch.randn(50, 2, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 0.2])
    plan = torch.cat([start[None], dynamics.rollout(start, actions)])
    state = start
    for k in range(50):
        state = dynamics.step(state, track(state, plan[k], plan[k + 1]))
        assert torch.allclose(state[:2], plan[k + 1, :2], atol=1e-6)


def test_deviations_are_made_good():
    distance = torch.arange(0, 60.0)
    plan = torch.stack([distance, 0 * distance, 0 * distance, 10 + 0 * distance], -1)
    state = torch.tensor([-0.8, 1.0, 0.1, 9.0])
    for k in range(50):
        state = dynamics.step(state, track(state, plan[k], plan[k + 1]))
    assert (state - plan[50])[:2].abs().max() < 0.05 and state[2].abs() < 0.02


def test_policy_collects_and_replans_at_its_own_rate():
    env = DrivingEnv(make_scenes(2, num_vehicles=1), SimSettings(), 2)
    ego = Cruise(replan_every=5)
    collector = Collector(
        env, EgoPolicy(ego, env), frames_per_batch=160, total_frames=160, auto_register_policy_transforms=False
    )
    ego.plans = 0  # building the collector tries the policy out
    data = next(iter(collector))
    assert data["next", "done"][:, -1].all() and not data["next", "terminated"].any()
    assert torch.allclose(data["next", "metrics", "progress"][:, -1], torch.tensor(80.0), atol=0.1)
    assert ego.plans == 16


def test_what_was_announced_is_driven_and_asked_for_once():
    env = DrivingEnv(make_scenes(2, num_vehicles=1), SimSettings(), 2)
    env.reset()
    ego, world = Cruise(replan_every=5), env.world()
    ego.announce(world)
    ego.act(env.world())
    assert ego.plans == 1, "the same moment"
    moved = env.world()
    moved.states = moved.states + 0.1
    Cruise.reset(ego, moved)
    moved.step = moved.step * 0
    ego.act(moved)
    assert ego.plans == 2, "another one"


def test_a_reset_in_between_makes_a_new_plan_there():
    """Environment 0 hits a wall early and starts anew while 1 drives on: both stay on their lanes' centre."""
    scenes = make_scenes(2, vehicles=[(0.0, 0, 10.0), (23.0, 0, 0.0)])
    scenes.scenes["valid"][1, 1] = False
    scenes.scenes["logged_valid"][1, :, 1] = False
    env = DrivingEnv(scenes, SimSettings(), 4)
    env.set_seed(1)
    data = env.rollout(70, EgoPolicy(Cruise(replan_every=5), env), break_when_any_done=False)
    done = data["next", "done"]
    assert done.any() and not done.all(0).any()
    assert data["action"].abs().max() < 1e-3


def test_replayed_log_is_tracked():
    env = DrivingEnv(make_scenes(1, num_vehicles=2), SimSettings(), 1)
    env.rollout(80, EgoPolicy(ReplayEgo(), env))
    assert torch.allclose(env.world().states[:, 0], env.scene["logged"][:, 80, 0], atol=0.01)


def test_replan_rate_is_checked():
    with pytest.raises(InputError, match="replan_every"):
        Cruise(replan_every=0)
