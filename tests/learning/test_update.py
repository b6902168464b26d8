"""The update improves the policy: it learns to drive where it stood, clones what it is shown, stops where it should."""

import os
import signal

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.objectives.value import GAE

from e2rl.learning.update import Learner, UpdateSettings, action_penalty
from e2rl.planners.actor import ActorEgo
from e2rl.planners.network import ActorNetwork
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import mirrored
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
    collector = collector_of(DrivingEnv(small_scenes(4), SimSettings(), batch), ego, steps)
    data = next(iter(collector))
    collector.shutdown()
    return data


def expert_of(data, action):
    observation = data["observation"].reshape(-1, data["observation"].shape[-1])
    action = torch.tensor(action).expand(len(observation), 1, 2)
    shown = {"observation": observation, "action": action, "weight": torch.ones(len(observation), 1)}
    return [TensorDict(shown, [len(observation)])]


def test_ppo_learns_to_drive_from_standing():
    """Without the reference the ego first brakes to a halt (the middle of the action's range); the reward is progress,
    and a parked car stands in its way: it learns to go, not to crash."""
    torch.manual_seed(0)
    scenes = small_scenes(4, steps=30, vehicles=[(0.0, 0, 5.0), (60.0, 0, 0.0)], num_vrus=0)
    ego = ActorEgo(hidden=(32,), reference=False, initial_std=(0.4, 0.02))
    learner = Learner(
        ego.network,
        settings_of(learning_rate=1e-3, minibatch=240, gamma=0.95, critic_warmup=0, target_kl=0.2, epochs=6),
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
        ego.network, settings_of(critic_warmup=0, cloning=1.0, minibatch=80, learning_rate=3e-3, target_kl=1e9)
    )
    data, losses = batch_of(ego), []
    expert = expert_of(data, [-3.0, 0.2])
    for _ in range(6):
        losses.append(learner.update(batch_of(ego), expert)["loss_cloning"])
    assert losses[-1] < losses[0] - 1.0


def test_a_teacher_of_the_left_teaches_the_right_too():
    """Labels steer to the left; in the mirror of the same states, which nobody labelled, the policy steers right."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    settings = settings_of(critic_warmup=0, teaching=1.0, minibatch=80, learning_rate=3e-3, target_kl=1e9)
    learner, (labels,) = Learner(ego.network, settings), expert_of(batch_of(ego), [0.0, 0.3])

    def turns():
        return [ego.decide(seen)[:, 1].mean() for seen in (labels["observation"], mirrored(labels["observation"]))]

    before = turns()
    for _ in range(8):
        learner.update(batch_of(ego), labels=labels)
    left, right = (now - then for now, then in zip(turns(), before, strict=True))
    assert left > 0.05 and right < -0.05


def test_the_action_penalty_makes_meant_accelerations_smaller():
    """At equal data the price on the policy's own mean makes its accelerations smaller, and 0 changes nothing."""
    meant = {}
    for price in (0.0, 5.0):
        torch.manual_seed(0)
        ego = ActorEgo(hidden=(16,))
        settings = settings_of(critic_warmup=0, action_penalty=price, learning_rate=3e-3, target_kl=1e9)
        learner = Learner(ego.network, settings)
        data = batch_of(ego)
        row = learner.update(data)
        assert ("action_penalty" in row) == (price > 0)
        meant[price] = ego.network.network.deterministic(data["observation"])[..., 0].abs().mean().item()
    assert meant[5.0] < 0.9 * meant[0.0]


def test_the_action_penalty_counts_calm_frames_alone():
    """Who is about to be hit may brake or accelerate as hard as it helps."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    data = batch_of(ego)
    meant = ego.network.network.deterministic(data["observation"])[..., 0].abs()
    inputs = TensorDict(ego.network.prepared(data["observation"]), data.shape)
    for calm in (torch.rand(data.shape) < 0.5, torch.ones(data.shape, dtype=torch.bool)):
        found = action_penalty(ego.network.network, inputs.set("calm", calm)).item()
        assert found == pytest.approx(meant[calm].mean().item() / 4, rel=1e-4)
    assert action_penalty(ego.network.network, inputs.set("calm", torch.zeros_like(calm))).item() == 0


def test_the_first_updates_fit_the_critic_alone():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    learner, data = Learner(ego.network, settings_of(critic_warmup=1, minibatch=80)), batch_of(ego)
    before = {key: value.clone() for key, value in ego.network.weights().items()}
    learner.update(data, expert_of(data, [1.0, 0.0]))
    changed = {key for key, value in ego.network.weights().items() if not torch.equal(value, before[key])}
    assert changed and all(key.startswith(("critic", "normaliser")) for key in changed)
    learner.update(data, expert_of(data, [1.0, 0.0]))
    assert not torch.equal(ego.network.weights()["network.trunk.last.weight"], before["network.trunk.last.weight"])


def test_passes_stop_at_the_target_kl():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), initial_std=(0.05, 0.05))
    settings = settings_of(critic_warmup=0, learning_rate=0.05, minibatch=40, epochs=10, target_kl=0.01)
    row = Learner(ego.network, settings).update(batch_of(ego))
    assert row["stopped_by_kl"] == 1.0 and row["steps"] < 40


def test_advantages_are_those_of_torchrl():
    """Of one pass over the observations, where TorchRL takes two; with episodes that end and are cut off inside."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), initial_std=(0.9, 0.9))
    learner, data = Learner(ego.network, settings_of(gamma=0.9, lmbda=0.8)), batch_of(ego, 16, 50)
    assert data["next", "terminated"].any() and data["next", "truncated"].any()
    learner.returns.update(5 * torch.randn(100, 1) + 3)
    learner.network.normaliser.observe(data["observation"])
    values = TensorDictModule(
        lambda seen: learner.returns.denormalize(ego.network.critic.module(seen)), ["observation"], ["state_value"]
    )
    expected = GAE(gamma=0.9, lmbda=0.8, value_network=values, deactivate_vmap=True)(data.clone())
    found = learner.advantages(data, ego.network.prepared(data["observation"])["seen"])
    for name, value in zip(("advantage", "value_target"), found, strict=True):
        torch.testing.assert_close(value, expected[name], rtol=1e-4, atol=1e-4)


def test_the_critic_learns_values_of_any_size():
    """Its loss and error in units of the returns' spread do not depend on the reward's scale."""
    errors = []
    for scale in (1.0, 1000.0):
        torch.manual_seed(0)
        ego = ActorEgo(hidden=(16,))
        data = batch_of(ego)
        data["next", "reward"] *= scale
        learner = Learner(ego.network, settings_of(minibatch=40, critic_warmup=10, gamma=0.9))
        errors.append([learner.update(data)["loss_critic"] for _ in range(4)])
    assert errors[0][-1] < errors[0][0]
    torch.testing.assert_close(torch.tensor(errors[0]), torch.tensor(errors[1]), rtol=0.02, atol=1e-3)


def test_the_learning_rate_falls_to_its_end_over_the_run():
    ego = ActorEgo(hidden=(16,))
    settings, data = settings_of(learning_rate=1e-3, final_lr=0.2, epochs=1), batch_of(ego)
    learner = Learner(ego.network, settings, total=4)
    rates = [learner.update(data)["learning_rate"] for _ in range(6)]
    assert rates == pytest.approx([1e-3, 8e-4, 6e-4, 4e-4, 2e-4, 2e-4])
    assert learner.optimiser.param_groups[0]["lr"] == rates[-1]
    constant = Learner(ego.network, settings)
    assert [constant.update(data)["learning_rate"] for _ in range(3)] == [1e-3] * 3


def test_frames_with_little_to_learn_are_left_out():
    """Those below a fraction of the running maximum of |advantage|; none while the critic warms up."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    data = batch_of(ego)
    learner = Learner(ego.network, settings_of(advantage_filter=0.3, critic_warmup=1, epochs=1))
    assert learner.update(data)["frames_used"] == 1.0
    seen = ego.network.prepared(data["observation"])["seen"]
    advantage, before = learner.advantages(data, seen)[0].abs(), learner.peak.clone()
    expected = (advantage >= 0.3 * (0.75 * before + 0.25 * advantage.max())).float().mean().item()
    assert learner.update(data)["frames_used"] == pytest.approx(expected) and 0 < expected < 1
    every = Learner(ego.network, settings_of(advantage_filter=0.0, critic_warmup=0, epochs=1))
    assert every.update(data)["frames_used"] == 1.0


def test_running_statistics_mix_the_past_and_a_batch():
    """The normaliser sees a batch only after the passes over it, so that the collected probabilities stay right."""
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    learner, data = Learner(ego.network, settings_of(epochs=1, critic_warmup=0)), batch_of(ego)
    learner.update(data)
    mean, peak = ego.network.normaliser.mean.clone(), learner.peak.clone()
    other = batch_of(ego)
    seen = ego.network.prepared(other["observation"])["seen"]
    highest = learner.advantages(other, seen)[0].abs().max()
    assert learner.update(other)["kl"] < 1e-2
    assert not torch.equal(ego.network.normaliser.mean, mean)
    torch.testing.assert_close(learner.peak, 0.75 * peak + 0.25 * highest)


def test_all_values_are_floats_and_what_is_not_finite_is_refused():
    ego = ActorEgo(hidden=(16,))
    learner, data = Learner(ego.network, settings_of(critic_warmup=0)), batch_of(ego)
    row = learner.update(data)
    needed = {"loss_objective", "loss_critic", "kl", "clip_fraction", "entropy", "explained_variance"}
    assert needed <= set(row) and all(isinstance(value, float) for value in row.values())
    data["next", "reward"] = data["next", "reward"] * torch.nan
    with pytest.raises(InputError, match="not finite"):
        learner.update(data)


def test_an_interrupt_in_an_update_ends_in_one_line_that_says_how_to_go_on(monkeypatch, capsys):
    """TensorDict runs the loss in a `with` block whose end turns the interrupt into an error of its own."""
    ego = ActorEgo(hidden=(16,))
    learner, data, head = Learner(ego.network, settings_of(critic_warmup=0)), batch_of(ego), ActorNetwork.head
    monkeypatch.setattr(ActorNetwork, "head", lambda *given: os.kill(os.getpid(), signal.SIGTERM) or head(*given))
    with pytest.raises(SystemExit) as end, ending(lambda: "python train.py resume=RUN"):
        learner.update(data)
    assert end.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err.strip() == "interrupted (SIGTERM); go on with: python train.py resume=RUN"


@pytest.mark.parametrize("name", ["cloning", "teaching"])
def test_what_is_shown_counts_by_its_weight(name):
    """One step with a weight that is next to nothing is the step without; with a weight of 1 it is another."""

    def after(weight):
        torch.manual_seed(0)
        ego = ActorEgo(hidden=(16,))
        data = batch_of(ego)
        shown = expert_of(data, (1.0, 0.5))
        others = {"cloning": 0.0, "teaching": 0.0, name: weight}
        learner = Learner(ego.network, settings_of(critic_warmup=0, epochs=1, minibatch=10_000, **others))
        torch.manual_seed(1)
        learner.update(data, shown if name == "cloning" else (), shown[0] if name == "teaching" else None)
        return torch.cat([each.detach().flatten() for each in ego.network.parameters()])

    none, little, much = after(0.0), after(1e-9), after(1.0)
    assert torch.allclose(none, little, atol=2e-5) and not torch.allclose(none, much, atol=2e-5)
