"""Episodes are what the sampler drew: scenes by probability, one scene and one traffic per trajectory."""

import torch
from e2rl.learning.pool import TrafficPool
from e2rl.learning.scene_sampler import SceneSampler
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from e2rl.ego.actor import ActorEgo
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.learning.small import brake_check, small_scenes


def make_env(batch=16, num_scenes=4, **kwargs):
    scenes = small_scenes(num_scenes, **kwargs)
    sampler = SceneSampler(num_scenes, batch)
    return TransformedEnv(DrivingEnv(scenes, SimSettings(), batch), sampler), sampler, scenes


def mixed_pool(scenes):
    index = torch.arange(len(scenes))
    attack = TrafficPool.synthesized(brake_check(scenes)(None, index, 4.0, 0), adversarial=True)
    return attack + TrafficPool.recorded(index)


def collect(env, steps, seed=0):
    torch.manual_seed(seed)
    batch = env.batch_size[0]
    collector = Collector(
        env,
        ActorEgo(hidden=(8,), initial_std=(0.9, 0.5)).network.actor,
        frames_per_batch=batch * steps,
        total_frames=-1,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    data = next(iter(collector))
    collector.shutdown()
    return data


def test_specs():
    env, _, _ = make_env(4)
    check_env_specs(env, seed=0)


def test_trajectories_never_mix_scenes_or_traffic():
    env, sampler, scenes = make_env()
    pool = mixed_pool(scenes)
    sampler.load(pool, torch.full((4,), 0.25), 0.5)
    data = collect(env, 60)
    for key in ("scene_index", "traffic_row"):
        assert torch.equal(data["next", key], data[key])
        changed = (data[key][:, 1:] != data[key][:, :-1]) & ~data["next", "done"][:, :-1]
        assert not changed.any()
    assert torch.equal(pool.scene_index[data["traffic_row"]], data["scene_index"])
    assert torch.equal(data["next", "timestep"], data["timestep"] + 1)
    assert len(data["traffic_row"].unique()) == len(pool) and data["next", "done"].sum() > 16


def test_the_traffic_driven_in_is_the_rows():
    """Vehicle 1 stands where its row of the pool says, at every moment of a mixed batch."""
    env, sampler, scenes = make_env(8)
    pool = mixed_pool(scenes)
    sampler.load(pool, torch.full((4,), 0.25), 0.5)
    td = env.reset()
    for _ in range(50):
        td["action"] = torch.tensor([0.0, 0.3]).repeat(8, 1)
        td = env.step_and_maybe_reset(td)[1]
        world = env.base_env.world()
        row = td["traffic_row"][:, 0]
        stored = torch.cat([pool.states, scenes.scenes["logged"][pool.scene_index[4:]]])
        moving = world.step > 0
        assert torch.equal(world.states[moving, 1], stored[row, world.step][moving, 1])


def test_draws_follow_the_priorities():
    env, sampler, scenes = make_env(64, steps=1)
    pool, priority = mixed_pool(scenes), torch.tensor([0.1, 0.2, 0.3, 0.4])
    sampler.load(pool, priority, 0.75)
    rows = torch.cat([env.reset()["traffic_row"][:, 0] for _ in range(60)])
    share = torch.bincount(rows, minlength=8) / len(rows)
    assert torch.allclose(share.double(), pool.probabilities(priority, 0.75), atol=0.03)


def test_state_goes_on_drawing():
    (env, sampler, _), (other, second, _) = make_env(8), make_env(8)
    env.reset()
    second.set_extra_state(sampler.get_extra_state())
    assert torch.equal(env.reset()["traffic_row"], other.reset()["traffic_row"])
