"""Stable-Baselines3 trains on the batch, and what it trained drives as it would."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecNormalize

import e2rl
from e2rl.learning.gym_env import in_units
from e2rl.run.errors import InputError
from e2rl.sim.observation import OBSERVATION_SIZE


@pytest.fixture(scope="module")
def given():
    """Three scenes with recorded traffic."""
    return {"scenes": e2rl.load_scenes("bundled", 3), "method": "replay", "compile": False}


def trained(env, kind):
    """A model after a few updates, whose actions vary."""
    if kind == "one":
        return PPO("MlpPolicy", env, n_steps=16, batch_size=8, device="cpu", seed=0).learn(16)
    if kind == "sac":
        return SAC("MlpPolicy", env, learning_starts=8, device="cpu", seed=0).learn(40)
    return PPO("MlpPolicy", VecNormalize(env), n_steps=8, batch_size=16, device="cpu", seed=0).learn(64)


def test_the_checker_passes(given):
    check_env(e2rl.make_gym_env(**given))


def test_it_is_the_batch_of_gymnasium(given):
    """What ends has its last observation, and is bootstrapped where it was truncated alone."""
    env, batch = e2rl.make_sb3_env(3, **given), e2rl.make_gym_env(3, **given)
    env.seed(2)
    seen, (other, _) = env.reset(), batch.reset(seed=2)
    ends = {"truncated": 0, "terminated": 0}
    for step in range(100):
        assert (seen == other).all()
        action = np.zeros((3, 2), dtype=np.float32)
        action[0] = 1.0, float(step % 2)  # speeds, and leaves the road
        action[1] = -1.0, 0.0  # stands
        seen, reward, done, infos = env.step(action)
        other, rewards, terminated, truncated, info = batch.step(action)
        assert (reward == rewards).all() and (done == (terminated | truncated)).all()
        for row in range(3):
            told = info["final_info"] if done[row] else info
            assert infos[row]["scene"] == told["scene"][row] and infos[row]["contact"] == told["contact"][row]
            assert ("terminal_observation" in infos[row]) == done[row]
            if done[row]:
                assert (infos[row]["terminal_observation"] == info["final_obs"][row]).all()
                assert infos[row]["TimeLimit.truncated"] == (not terminated[row])
                ends["terminated" if terminated[row] else "truncated"] += 1
    assert min(ends.values()) > 0


@pytest.mark.parametrize(("kind", "suffix"), [("ppo", "pt"), ("ppo", "onnx"), ("sac", "onnx"), ("one", "onnx")])
def test_a_saved_policy_does_what_the_model_predicts(given, tmp_path, kind, suffix):
    """Statistics of VecNormalize and the scale of the actions included; the file holds arithmetic, no pickle."""
    model = trained(e2rl.make_gym_env(**given) if kind == "one" else e2rl.make_sb3_env(4, **given), kind)
    training = model.policy.training
    ego = e2rl.make_ego("policy_file", file=str(e2rl.save_policy(model, tmp_path / f"policy.{suffix}")))
    observation = 3 * np.random.default_rng(0).normal(size=(200, OBSERVATION_SIZE)).astype(np.float32)
    assert model.policy.training == training, "the model goes on as it was"
    normaliser = model.get_vec_normalize_env()
    seen = normaliser.normalize_obs(observation) if normaliser else observation
    predicted = torch.tensor(model.predict(seen, deterministic=True)[0])
    wanted = in_units(predicted, torch.tensor([-8.0, -1.6]), torch.tensor([5.0, 1.6]))
    assert torch.allclose(ego.decide(torch.tensor(observation)), wanted, atol=1e-4) and wanted.std(0).min() > 5e-3


def test_a_model_that_was_trained_elsewhere_is_refused(given, tmp_path):
    model = trained(e2rl.make_sb3_env(4, **given), "ppo")
    model.save(tmp_path / "model.zip")
    with pytest.raises(InputError, match="no environment of e2rl"):
        e2rl.save_policy(PPO.load(tmp_path / "model.zip", device="cpu"), tmp_path / "policy.onnx")
    with pytest.raises(InputError, match="no kind of policy"):
        e2rl.save_policy(model, tmp_path / "policy.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"], "nothing half-written"
