"""The transform and closed-loop rollouts: traffic is the plan, resets are partial, seeds decide, routes end."""

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from e2rl.ego.base import EgoPolicy
from e2rl.ego.idm import IDMEgo
from e2rl.ego.replay import ReplayEgo
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.transform import AdversarialSynthesizer
from tests.synthesizer.traffic_scenes import ROWS, VEHICLES, drive, scenes, synthesizer


def environment(count=3, eta=0.0, on=None, steps=20, sim=None):
    """Environment of `count` scenes whose k-th scene ever drawn is k modulo their number, with seed k."""
    drawn = [0]

    def draw(number):
        index = torch.arange(drawn[0], drawn[0] + number)
        drawn[0] += number
        return index % count, index, torch.full((number,), eta)

    transform = AdversarialSynthesizer(on or synthesizer(), IDMEgo(), draw)
    base = DrivingEnv(scenes(count, steps), sim or SimSettings(end_on_contact=False, end_off_road=False), count)
    return TransformedEnv(base, transform), transform


def advance(env, policy, tensordict, steps):
    for _ in range(steps):
        tensordict = env.step(policy(tensordict))["next"]
    return tensordict


def test_the_specs_hold():
    check_env_specs(environment()[0])


def test_executed_traffic_is_the_plan_and_is_replanned_every_five_steps():
    env, transform = environment(eta=1.0)
    policy, tensordict = EgoPolicy(IDMEgo(), env), env.reset()
    for step in range(12):
        planned, seen = (value.clone() for value in transform._plan)
        since = transform._planned.clone()
        tensordict = env.step(policy(tensordict))["next"]
        world = env.base_env.world()
        at = step - int(since[0])
        torch.testing.assert_close(world.states[:, 1:ROWS], planned[:, at, 1:ROWS])
        assert torch.equal(world.valid[:, 1:ROWS], seen[:, at, 1:ROWS])
        assert transform._planned.tolist() == [(step + 1) // 5 * 5] * 3
    assert transform.episode.replans.tolist() == [3, 3, 3]


def test_walkers_replay_their_log_and_the_others_plan_is_shown_to_the_ego():
    env, _ = environment()
    advance(env, EgoPolicy(IDMEgo(), env), env.reset(), 7)
    world = env.base_env.world()
    torch.testing.assert_close(world.states[:, ROWS:], world.scene["logged"][:, 7, ROWS:])
    torch.testing.assert_close(world.plan[:, 1:ROWS, 0], env.base_env._traffic.states[:, 8, 1:ROWS])


def test_a_partial_reset_begins_those_rows_anew_and_leaves_the_others():
    env, transform = environment()
    policy = EgoPolicy(IDMEgo(), env)
    tensordict = advance(env, policy, env.reset(), 7)
    before, plan = transform.episode, transform._plan[0].clone()
    tensordict = env.reset(tensordict.set("_reset", torch.tensor([[False], [True], [False]])))
    after = transform.episode
    assert after.seed.tolist() == [0, 3, 2] and after.replans.tolist() == [2, 1, 2]
    assert tensordict["scene_index"][:, 0].tolist() == [0, 0, 2] and tensordict["timestep"][:, 0].tolist() == [7, 0, 7]
    assert torch.equal(transform._plan[0][[0, 2]], plan[[0, 2]]) and not torch.equal(transform._plan[0][1], plan[1])
    assert torch.equal(after.state.s[[0, 2]], before.state.s[[0, 2]])
    advance(env, policy, tensordict, 3)
    assert transform.episode.replans.tolist() == [3, 1, 3] and transform._planned.tolist() == [10, 0, 10]


def test_other_rows_resets_do_not_change_a_row_s_traffic():
    whole, _ = environment(eta=1.0)
    advance(whole, EgoPolicy(IDMEgo(), whole), whole.reset(), 12)
    env, _ = environment(eta=1.0)
    policy = EgoPolicy(IDMEgo(), env)
    tensordict = advance(env, policy, env.reset(), 7)
    tensordict = env.reset(tensordict.set("_reset", torch.tensor([[False], [True], [False]])))
    advance(env, policy, tensordict, 5)
    here, there = (e.base_env._traffic.states[[0, 2], :13, 1:ROWS] for e in (env, whole))
    torch.testing.assert_close(here, there, rtol=0, atol=2e-2)


def test_ended_episodes_are_reset_in_a_rollout():
    env, transform = environment(steps=10)
    out = env.rollout(25, EgoPolicy(IDMEgo(), env), break_when_any_done=False)
    assert out["next", "done"][:, :, 0].sum(1).tolist() == [2, 2, 2]
    assert sorted(transform.episode.seed.tolist()) == [6, 7, 8]


def test_rollouts_repeat_and_seeds_matter():
    scene_set = scenes()
    first, again = (drive(scene_set, synthesizer(), 1.0) for _ in range(2))
    other = drive(scene_set, synthesizer(), 1.0, seeds=[10, 11, 12])
    assert torch.equal(first["states"], again["states"]) and torch.equal(first["valid"], again["valid"])
    assert not torch.equal(first["states"][:, :, 1:5], other["states"][:, :, 1:5])


def test_zero_intensity_is_the_nominal_rollout_and_more_of_it_is_not():
    scene_set = scenes()
    nominal = drive(scene_set, synthesizer(reselect=0), 0.0)
    zero, pushed = drive(scene_set, synthesizer(), 0.0), drive(scene_set, synthesizer(), 2.0)
    assert torch.equal(nominal["states"], zero["states"]) and not zero["adversaries"].any()
    assert (pushed["adversaries"].any(1)).all() and not pushed["adversaries"][:, 0].any()
    assert (zero["transport_adversary"] == 0).all() and (pushed["transport_adversary"] > 0).all()


def test_the_start_is_the_scene_s_and_parked_vehicles_stay():
    scene_set = scenes()
    out = drive(scene_set, synthesizer(), 2.0)
    assert out["states"].shape == (3, 21, ROWS + 2, 4)
    torch.testing.assert_close(out["states"][:, 0], scene_set.scenes["start"])
    assert torch.equal(out["valid"][:, 0], scene_set.scenes["valid"])
    parked = len(VEHICLES) - 1
    torch.testing.assert_close(out["states"][:, :, parked], out["states"][:, :1, parked].expand(-1, 21, -1))
    assert out["simulated"][:, : len(VEHICLES)].all() and not out["simulated"][:, len(VEHICLES) :].any()
    assert out["states"].isfinite().all()


def test_vehicles_are_gone_once_their_route_has_ended_and_stay_away():
    out = drive(scenes(2, steps=40, road=(-60.0, 60.0)), synthesizer(), 0.0)
    x, valid = out["states"][:, :, 4, 0], out["valid"][:, :, 4]
    assert not valid[:, -1].any()
    assert (valid.int().diff(dim=1) <= 0).all()
    assert (x[valid] < 60.0 + 1e-3).all()


def test_traffic_drives_on_as_planned_after_the_ego_has_left():
    """The recording would put everybody back by hundreds of metres once a plan of 50 steps is used up."""
    scene_set = scenes(2, steps=80)
    scene_set.scenes["logged_valid"][:, 4:, 0] = False
    scene_set.scenes["logged"][:, 50:, 1:ROWS, :2] += 500.0
    out = roll_out(
        scene_set,
        torch.arange(2),
        torch.arange(2),
        torch.zeros(2),
        ReplayEgo(),
        synthesizer(),
        SimSettings(replay_ego=True),
    )
    assert not out["valid"][:, 5:, 0].any()
    there = out["valid"][:, 1:, 1:5] & out["valid"][:, :-1, 1:5]
    jump = (out["states"][:, 1:, 1:5, :2] - out["states"][:, :-1, 1:5, :2]).norm(dim=-1)
    assert there.any() and jump[there].max() < 4.0


@pytest.mark.parametrize("replan", [1, 10])
def test_the_interval_between_replans_can_be_chosen(replan):
    out = drive(scenes(1, steps=10), synthesizer(), 0.0, replan=replan)
    speed = out["states"][:, :, 1:5, 3]
    assert speed.diff(dim=1).abs().max() < 1.0
