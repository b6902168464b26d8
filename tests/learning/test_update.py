"""The update improves the policy: it learns to drive where it stood, clones what it is shown, stops where it should."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

from e2rl.ego.actor import ActorEgo
from e2rl.errors import InputError
from e2rl.learning.update import Learner, UpdateSettings
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.learning.small import small_scenes


def collector_of(env, ego, steps):
    return Collector(
        env,
        ego.network.actor,
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=-1,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


def batch_of(ego, batch=8, steps=20):
    collector = collector_of(DrivingEnv(small_scenes(4), SimSettings(), batch), ego, steps)
    data = next(iter(collector))
    collector.shutdown()
    return data


def expert_of(data, action):
    observation = data["observation"].reshape(-1, data["observation"].shape[-1])
    return TensorDict(
        {"observation": observation, "action": torch.tensor(action).repeat(len(observation), 1)}, [len(observation)]
    )


def test_ppo_learns_to_drive_from_standing():
    """Without the reference the ego first brakes to a halt (the middle of the action's range); the reward is progress,
    and a parked car stands in its way: it learns to go, not to crash."""
    torch.manual_seed(0)
    scenes = small_scenes(4, steps=30, vehicles=[(0.0, 0, 5.0), (60.0, 0, 0.0)], num_vrus=0)
    ego = ActorEgo(hidden=(32,), reference=False, initial_std=(0.4, 0.02))
    learner = Learner(
        ego.network,
        UpdateSettings(learning_rate=3e-3, minibatch=240, gamma=0.95, critic_warmup=0, target_kl=0.2, epochs=6),
    )
    collector = collector_of(DrivingEnv(scenes, SimSettings(), 16), ego, 30)
    progress = []
    for _, data in zip(range(15), collector, strict=False):
        learner.update(data)
        progress.append(data["next", "metrics", "progress"][:, -1].mean().item())
    collector.shutdown()
    assert progress[0] < 10.0 and sum(progress[-3:]) / 3 > progress[0] + 4.0
    assert not data["next", "metrics", "contact"].any()


def test_cloning_pulls_the_actor_towards_the_expert():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    learner = Learner(
        ego.network, UpdateSettings(critic_warmup=0, cloning=1.0, minibatch=80, learning_rate=3e-3, target_kl=1e9)
    )
    data, losses = batch_of(ego), []
    expert = expert_of(data, [-3.0, 0.2])
    for _ in range(4):
        losses.append(learner.update(batch_of(ego), expert)["loss_cloning"])
    assert losses[-1] < losses[0] - 1.0


def test_the_first_updates_fit_the_critic_alone():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    learner, data = Learner(ego.network, UpdateSettings(critic_warmup=1, minibatch=80)), batch_of(ego)
    before = {key: value.clone() for key, value in ego.network.weights().items()}
    learner.update(data, expert_of(data, [1.0, 0.0]))
    changed = {key for key, value in ego.network.weights().items() if not torch.equal(value, before[key])}
    assert changed and all(key.startswith(("critic", "normaliser")) for key in changed)
    learner.update(data, expert_of(data, [1.0, 0.0]))
    assert not torch.equal(ego.network.weights()["network.trunk.2.weight"], before["network.trunk.2.weight"])


def test_passes_stop_at_the_target_kl():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), initial_std=(0.05, 0.05))
    settings = UpdateSettings(critic_warmup=0, learning_rate=0.05, minibatch=40, epochs=10, target_kl=0.01)
    row = Learner(ego.network, settings).update(batch_of(ego))
    assert row["stopped_by_kl"] == 1.0 and row["steps"] < 40


def test_losses_share_the_networks_parameters():
    ego = ActorEgo(hidden=(16,))
    learner = Learner(ego.network, UpdateSettings())
    own = {id(value) for value in ego.network.parameters()}
    assert {id(value) for value in learner.ppo.parameters()} == own
    assert {id(value) for value in learner.cloning.parameters()} < own


def test_all_values_are_floats_and_what_is_not_finite_is_refused():
    ego = ActorEgo(hidden=(16,))
    learner, data = Learner(ego.network, UpdateSettings(critic_warmup=0)), batch_of(ego)
    row = learner.update(data)
    needed = {"loss_objective", "loss_critic", "kl", "clip_fraction", "entropy", "explained_variance"}
    assert needed <= set(row) and all(isinstance(value, float) for value in row.values())
    data["next", "reward"] = data["next", "reward"] * torch.nan
    with pytest.raises(InputError, match="not finite"):
        learner.update(data)
