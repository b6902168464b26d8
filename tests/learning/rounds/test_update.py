"""The update improves the policy: it learns to drive where it stood, clones what it is
shown, stops where it should."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.objectives.value import GAE

from e2rl.learning.rounds.update import Learner, UpdateSettings, action_penalty
from e2rl.planners.actor import ActorEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
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


def settings_of(**changes):
    """Without penalties and filters, which each have tests of their own."""
    plain = {"action_penalty": 0.0, "advantage_filter": 0.0, "minibatch": 80}
    return UpdateSettings(**plain | changes)


def batch_of(ego, batch=8, steps=20):
    collector = collector_of(
        DrivingEnv(small_scenes(4), SimSettings(), batch), ego, steps=steps
    )
    data = next(iter(collector))
    collector.shutdown()
    return data


def begun(std=None, **changes):
    """A new ego, its learner, and a batch that the ego has driven."""
    torch.manual_seed(0)
    ego = ActorEgo(
        hidden=(16,), room=None, **({} if std is None else {"initial_std": (std, std)})
    )
    return ego, Learner(ego.network, settings_of(**changes)), batch_of(ego)


def test_ppo_learns_to_drive_from_standing():
    """Without the reference the ego first brakes to a halt (the middle of the action's
    range); the reward is progress, and a parked car stands in its way: it learns to go,
    not to crash."""
    torch.manual_seed(0)
    scenes = small_scenes(
        4, steps=30, vehicles=[(0.0, 0, 5.0), (60.0, 0, 0.0)], num_vrus=0
    )
    ego = ActorEgo(hidden=(32,), reference=False, initial_std=(0.4, 0.02))
    learner = Learner(
        ego.network,
        settings_of(
            learning_rate=1e-3,
            minibatch=240,
            gamma=0.95,
            critic_warmup=0,
            target_kl=0.2,
            epochs=6,
        ),
    )
    collector = collector_of(DrivingEnv(scenes, SimSettings(), 16), ego, steps=30)
    progress = []
    for _, data in zip(range(15), collector, strict=False):
        learner.update(data)
        progress.append(data["next", "metrics", "progress"][:, -1].mean().item())
    collector.shutdown()
    assert progress[0] < 10.0
    assert sum(progress[-3:]) / 3 > progress[0] + 4.0
    assert not data["next", "metrics", "contact"].any()


def test_the_action_penalty_makes_meant_accelerations_smaller():
    """At equal data the price on the policy's own mean makes its accelerations smaller,
    and 0 changes nothing."""
    meant = {}
    for price in (0.0, 5.0):
        ego, learner, data = begun(
            critic_warmup=0, action_penalty=price, learning_rate=3e-3, target_kl=1e9
        )
        row = learner.update(data)
        assert ("action_penalty" in row) == (price > 0)
        meant[price] = (
            ego.network.network.deterministic(data["observation"])[..., 0]
            .abs()
            .mean()
            .item()
        )
    assert meant[5.0] < 0.9 * meant[0.0]


def test_the_action_penalty_counts_calm_frames_alone():
    """Who is about to be hit may brake or accelerate as hard as it helps."""
    ego, _, data = begun()
    meant = ego.network.network.deterministic(data["observation"])[..., 0].abs()
    inputs = TensorDict(ego.network.prepared(data), data.shape)
    for calm in (
        torch.rand(data.shape) < 0.5,
        torch.ones(data.shape, dtype=torch.bool),
    ):
        result = action_penalty(ego.network.network, inputs.set("calm", calm)).item()
        assert result == pytest.approx(meant[calm].mean().item() / 4, rel=1e-4)
    assert (
        action_penalty(
            ego.network.network, inputs.set("calm", torch.zeros_like(calm))
        ).item()
        == 0
    )


def test_the_first_updates_fit_the_critic_alone():
    ego, learner, data = begun(critic_warmup=1)
    before = {key: value.clone() for key, value in ego.network.weights().items()}
    learner.update(data)
    changed = {
        key
        for key, value in ego.network.weights().items()
        if not torch.equal(value, before[key])
    }
    assert changed
    assert all(key.startswith(("critic", "normaliser")) for key in changed)
    learner.update(data)
    assert not torch.equal(
        ego.network.weights()["network.trunk.last.weight"],
        before["network.trunk.last.weight"],
    )


def test_passes_stop_at_the_target_kl():
    options = {
        "critic_warmup": 0,
        "learning_rate": 0.05,
        "minibatch": 40,
        "epochs": 10,
        "target_kl": 0.01,
    }
    _, learner, data = begun(std=0.05, **options)
    row = learner.update(data)
    assert row["stopped_by_kl"] == 1.0
    assert row["steps"] < 40


def test_advantages_are_those_of_torchrl():
    """Of one pass over the observations, where TorchRL takes two; with episodes that
    end and are cut off inside."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), room=None, initial_std=(0.9, 0.9))
    learner = Learner(ego.network, settings_of(gamma=0.9, lmbda=0.8))
    data = batch_of(ego, 16, steps=50)
    assert data["next", "terminated"].any()
    assert data["next", "truncated"].any()
    learner.returns.update(5 * torch.randn(100, 1) + 3)
    learner.network.normaliser.observe(data["observation"])
    values = TensorDictModule(
        lambda seen: learner.returns.denormalize(ego.network.critic.module(seen)),
        ["observation"],
        ["state_value"],
    )
    expected = GAE(
        gamma=0.9,
        lmbda=0.8,
        value_network=values,
        deactivate_vmap=True,
    )(data.clone())
    result = learner.advantages(data, ego.network.prepared(data)["seen"])
    for name, value in zip(("advantage", "value_target"), result, strict=True):
        torch.testing.assert_close(
            value,
            expected[name],
            rtol=1e-4,
            atol=1e-4,
        )


def test_the_critic_learns_values_of_any_size():
    """Its loss and error in units of the returns' spread do not depend on the reward's
    scale."""
    errors = []
    for scale in (1.0, 1000.0):
        _, learner, data = begun(minibatch=40, critic_warmup=10, gamma=0.9)
        data["next", "reward"] *= scale
        errors.append([learner.update(data)["loss_critic"] for _ in range(4)])
    assert errors[0][-1] < errors[0][0]
    torch.testing.assert_close(
        torch.tensor(errors[0]), torch.tensor(errors[1]), rtol=0.02, atol=1e-3
    )


def test_the_learning_rate_falls_to_its_end_over_the_run():
    ego = ActorEgo(hidden=(16,), room=None)
    settings = settings_of(learning_rate=1e-3, final_lr=0.2, epochs=1)
    data = batch_of(ego)
    learner = Learner(ego.network, settings, total=4)
    rates = [learner.update(data)["learning_rate"] for _ in range(6)]
    assert rates == pytest.approx([1e-3, 8e-4, 6e-4, 4e-4, 2e-4, 2e-4])
    assert learner.optimiser.param_groups[0]["lr"] == rates[-1]
    constant = Learner(ego.network, settings)
    assert [constant.update(data)["learning_rate"] for _ in range(3)] == [1e-3] * 3


def test_frames_with_little_to_learn_are_left_out():
    """Those below a fraction of the running maximum of |advantage|; none while the
    critic warms up."""
    ego, learner, data = begun(advantage_filter=0.3, critic_warmup=1, epochs=1)
    assert learner.update(data)["frames_used"] == 1.0
    observed = ego.network.prepared(data)["seen"]
    advantage = learner.advantages(data, observed)[0].abs()
    before = learner.peak.clone()
    expected = (
        (advantage >= 0.3 * (0.75 * before + 0.25 * advantage.max()))
        .float()
        .mean()
        .item()
    )
    assert learner.update(data)["frames_used"] == pytest.approx(expected)
    assert 0 < expected < 1
    every = Learner(
        ego.network, settings_of(advantage_filter=0.0, critic_warmup=0, epochs=1)
    )
    assert every.update(data)["frames_used"] == 1.0


def test_the_normaliser_sees_a_batch_after_the_passes_over_it():
    """So the collected probabilities stay right."""
    ego, learner, data = begun(epochs=1, critic_warmup=0)
    learner.update(data)
    mean = ego.network.normaliser.mean.clone()
    assert learner.update(batch_of(ego))["kl"] < 1e-2
    assert not torch.equal(ego.network.normaliser.mean, mean)


def test_what_is_not_finite_is_refused():
    _, learner, data = begun(critic_warmup=0)
    data["next", "reward"] = data["next", "reward"] * torch.nan
    with pytest.raises(InputError, match="not finite"):
        learner.update(data)
