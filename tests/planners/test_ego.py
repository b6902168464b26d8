"""Tracking leaves no error on drivable plans, makes good deviations, and a policy restarts with its episodes."""

import pytest
import torch

from e2rl.planners.bits import BitsEgo
from e2rl.planners.ego import PLAN_STEPS, Ego, EgoPlanner, EgoPolicy, track
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import SamplingEgo
from e2rl.run.config import built, load_choice
from e2rl.run.errors import InputError
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.planners.planners import driven, world_of, worlds
from tests.synthetic import make_scenes


class Cruise(Ego):
    """Holds its speed along its mission, and counts its plans."""

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


def make_env(scenes, batch):
    return DrivingEnv(scenes, SimSettings(), batch, agents=True)


@pytest.mark.parametrize(("kind", "atol"), [(Cruise, 1e-3), (IDMEgo, 0.05)])
def test_what_a_policy_writes_as_its_plan_is_what_it_then_drives(kind, atol):
    """It plans once in each interval; in between, its plan is the rest of the last one."""
    env, ego, made = make_env(make_scenes(2, num_vehicles=1, limit=12.0), 2), kind(replan_every=5), []
    plan = ego.plan
    ego.plan = lambda world: made.append(plan(world)) or made[-1]
    data = env.rollout(30, EgoPolicy(ego, env))
    told, driven = data["ego", "plan"], data["next", "agents", "states"][:, :, 0]
    assert len(made) == 6 and told.shape[2] == PLAN_STEPS
    for step in range(30):
        fresh, age = made[step // 5], step % 5
        assert torch.equal(told[:, step, : PLAN_STEPS - age], fresh[:, age:])
        assert torch.equal(told[:, step, PLAN_STEPS - age :], fresh[:, -1:].expand(-1, age, -1)), "its end is held"
    assert torch.allclose(driven, told[:, :, 0], atol=atol)
    for step in range(0, 30, 5):
        assert torch.allclose(driven[:, step : step + 5], told[:, step, :5], atol=atol), "the interval that follows"


def test_a_planner_beside_another_policy_tells_the_plan_and_leaves_the_action():
    env, ego = make_env(make_scenes(2, num_vehicles=1), 2), Cruise(replan_every=5)
    constant = lambda td: td.set("action", torch.tensor([-1.0, 0.0]).repeat(2, 1))  # noqa: E731
    planner = EgoPlanner(ego, env)
    data = env.rollout(12, lambda td: constant(planner(td)))
    assert ego.plans == 3 and (data["action"] == torch.tensor([-1.0, 0.0])).all()
    speed = data["agents", "states"][:, ::5, 0, 3]
    assert torch.allclose(data["ego", "plan"][:, ::5, -1, 3], speed, atol=1e-4), "each plan begins where the ego is"


def test_a_reset_in_between_makes_a_new_plan_there():
    """Environment 0 hits a wall early and starts anew while 1 drives on: both stay on their lanes' centre."""
    scenes = make_scenes(2, vehicles=[(0.0, 0, 10.0), (23.0, 0, 0.0)])
    scenes.scenes["valid"][1, 1] = False
    scenes.scenes["logged_valid"][1, :, 1] = False
    env = make_env(scenes, 4)
    env.set_seed(1)
    data = env.rollout(70, EgoPolicy(Cruise(replan_every=5), env), break_when_any_done=False)
    done = data["next", "done"]
    assert done.any() and not done.all(0).any()
    assert data["action"].abs().max() < 1e-3


def test_replayed_log_is_tracked():
    env = make_env(make_scenes(1, num_vehicles=2), 1)
    env.rollout(80, EgoPolicy(ReplayEgo(), env))
    assert torch.allclose(env.world().states[:, 0], env.scene["logged"][:, 80, 0], atol=0.01)


@pytest.mark.parametrize("name", ["idm", "lane_graph", "lane_graph_tuned", "replay", "sampling", "bits"])
def test_a_file_of_the_configuration_builds_its_ego(name):
    """The class alone has the values of its file; each value is checked."""
    group = load_choice("ego", name)
    ego = built(group, "ego", Ego)
    for key in set(group) - {"_target_", "predicted_speeds"}:
        assert getattr(ego, key) == group[key]
        assert name == "lane_graph_tuned" or getattr(type(ego)(), key) == group[key]
    plan = ego.plan(world_of(num_scenes=2)[1])
    assert plan.shape == (2, PLAN_STEPS, 4) and torch.isfinite(plan).all()
    with pytest.raises(InputError, match=r"ego\.replan_every=0"):
        type(ego)(replan_every=0)


@pytest.mark.parametrize("kind", [LaneGraphEgo, SamplingEgo, BitsEgo])
def test_scenes_of_a_batch_do_not_mix(kind):
    """Planned together, beyond a chunk, or alone, a scene gets the same plan."""
    ego, count = kind(), 66 if kind is BitsEgo else 10
    scenes = make_scenes(count, vehicles=[(0.0, 0, 10.0), (22.0, 0, 6.0), (10.0, 1, 10.0), (-15.0, 0, 11.0)])
    scenes.scenes["start"][1, 1:4, 0] += 6.0
    scenes.scenes["valid"][2, 1:] = False
    together = ego.plan(worlds(scenes)[1])
    for k in (0, 1, 2, count - 1):
        alone = ego.plan(worlds(scenes.chosen([k]))[1])[0]
        torch.testing.assert_close(alone, together[k], atol=1e-3, rtol=0)
    assert not torch.allclose(together[1, :, 3], together[2, :, 3])


@pytest.mark.parametrize("kind", [IDMEgo, LaneGraphEgo, SamplingEgo, BitsEgo])
def test_a_red_light_is_halted_at_and_without_one_it_drives_on(kind):
    halts_by = 48.3 if kind is IDMEgo else 47.8  # the line is at 50 m, the front 2.25 m ahead of the centre
    for light, low, high in ((50.0, 35.0, halts_by), (None, 55.0, 1e3)):
        _, state = driven(kind(), num_vehicles=1, num_vrus=0, red_light_x=light)
        assert low < state[0] < high and (state[3] < 2.5) == (light is not None)
