"""Stable-Baselines3 trains on the batch, and what it trained drives as it would."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers import (
    FrameStackObservation,
    NormalizeObservation,
    RecordEpisodeStatistics,
    RescaleAction,
    TimeLimit,
    TransformAction,
    TransformObservation,
)
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

import e2rl
from e2rl.learning.adapters.gym_env import in_units
from e2rl.run.errors import InputError
from e2rl.sim.observation import OBSERVATION_SIZE


@pytest.fixture(scope="module")
def given():
    """Three scenes with recorded traffic."""
    return {
        "scenes": e2rl.load_scenes("bundled", 3),
        "method": "replay",
        "compile": False,
    }


def trained(env, kind):
    """A model after a few updates, whose actions vary."""
    if kind == "one":
        return PPO(
            "MlpPolicy", env, n_steps=16, batch_size=8, device="cpu", seed=0
        ).learn(16)
    if kind == "ppo_plain":
        return PPO(
            "MlpPolicy", env, n_steps=8, batch_size=16, device="cpu", seed=0
        ).learn(64)
    if kind == "sac":
        return SAC(
            "MlpPolicy",
            env,
            learning_starts=8,
            device="cpu",
            seed=0,
        ).learn(40)
    return PPO(
        "MlpPolicy", VecNormalize(env), n_steps=8, batch_size=16, device="cpu", seed=0
    ).learn(64)


def test_the_checker_passes(given):
    check_env(e2rl.make_gym_env(**given))


def test_it_is_the_batch_of_gymnasium(given):
    """What ends has its last observation, and is bootstrapped where it was truncated
    alone."""
    env = e2rl.make_sb3_env(3, **given)
    batch = e2rl.make_gym_env(3, **given)
    env.seed(2)
    observed, (other, _) = env.reset(), batch.reset(seed=2)
    ends = {"truncated": 0, "terminated": 0}
    for step in range(100):
        assert (observed == other).all()
        action = np.zeros((3, 2), dtype=np.float32)
        action[0] = 1.0, float(step % 2)  # speeds, and leaves the road
        action[1] = -1.0, 0.0  # stands
        observed, reward, finished, infos = env.step(action)
        other, rewards, terminated, truncated, info = batch.step(action)
        assert (reward == rewards).all()
        assert (finished == (terminated | truncated)).all()
        for row in range(3):
            message = info["final_info"] if finished[row] else info
            assert infos[row]["scene"] == message["scene"][row]
            assert infos[row]["contact"] == message["contact"][row]
            assert ("terminal_observation" in infos[row]) == finished[row]
            if finished[row]:
                assert (
                    infos[row]["terminal_observation"] == info["final_obs"][row]
                ).all()
                assert infos[row]["TimeLimit.truncated"] == (not terminated[row])
                ends["terminated" if terminated[row] else "truncated"] += 1
    assert min(ends.values()) > 0


@pytest.mark.parametrize(
    "kind",
    ["ppo", "sac", "one"],
)
def test_a_saved_policy_does_what_the_model_predicts(given, tmp_path, kind):
    """Statistics of VecNormalize and the scale of the actions included."""
    model = trained(
        e2rl.make_gym_env(**given) if kind == "one" else e2rl.make_sb3_env(4, **given),
        kind,
    )
    training = model.policy.training
    ego = e2rl.make_ego(
        "policy_file", file=str(e2rl.save_policy(model, tmp_path / "policy.pt"))
    )
    observation = 3 * np.random.default_rng(0).normal(
        size=(200, OBSERVATION_SIZE)
    ).astype(np.float32)
    assert model.policy.training == training, "the model goes on as it was"
    normaliser = model.get_vec_normalize_env()
    observed = normaliser.normalize_obs(observation) if normaliser else observation
    predicted = torch.tensor(model.predict(observed, deterministic=True)[0])
    wanted = in_units(
        predicted, torch.tensor([-8.0, -1.6]), high=torch.tensor([5.0, 1.6])
    )
    assert torch.allclose(ego.decide(torch.tensor(observation)), wanted, atol=1e-4)
    assert wanted.std(0).min() > 5e-3


def test_a_saved_model_says_its_bounds_itself(given, tmp_path):
    """Loaded without an environment; with one of other bounds it is refused."""
    model = trained(e2rl.make_sb3_env(4, **given, max_acceleration=2.0), "ppo_plain")
    model.save(tmp_path / "model.zip")
    here = e2rl.save_policy(model, tmp_path / "here.pt")
    loaded = e2rl.save_policy(
        PPO.load(tmp_path / "model.zip", device="cpu"), tmp_path / "loaded.pt"
    )
    assert same_actions(here, loaded, high=[2.0, 1.6])
    for other in (
        PPO.load(
            tmp_path / "model.zip", env=e2rl.make_sb3_env(1, **given), device="cpu"
        ),
        model,
    ):
        with pytest.raises(InputError, match="-8 to 2 m.*-8 to 5 m"):
            e2rl.save_policy(
                other, tmp_path / "policy.pt", env=e2rl.make_sb3_env(1, **given)
            )


def test_a_saved_model_takes_its_normalisation_along(given, tmp_path):
    """The statistics that were saved with it; without them, or with others, it is
    refused."""
    model = trained(e2rl.make_sb3_env(4, **given), "ppo")
    model.save(tmp_path / "model.zip")
    model.get_vec_normalize_env().save(tmp_path / "normalize.pkl")
    here = e2rl.save_policy(model, tmp_path / "here.pt")
    env = VecNormalize.load(tmp_path / "normalize.pkl", e2rl.make_sb3_env(1, **given))
    loaded = PPO.load(tmp_path / "model.zip", device="cpu")
    assert same_actions(here, e2rl.save_policy(loaded, tmp_path / "loaded.pt", env=env))
    with pytest.raises(
        InputError, match="with normalised observations: pass the VecNormalize"
    ):
        e2rl.save_policy(loaded, tmp_path / "policy.pt")
    with pytest.raises(InputError, match="with other statistics"):
        e2rl.save_policy(
            loaded,
            tmp_path / "policy.pt",
            env=VecNormalize(e2rl.make_sb3_env(1, **given)),
        )
    with pytest.raises(
        InputError, match="does not tell whether it was trained under VecNormalize"
    ):
        attached = PPO.load(
            tmp_path / "model.zip", env=e2rl.make_sb3_env(1, **given), device="cpu"
        )
        e2rl.save_policy(attached, tmp_path / "policy.pt")
    plain = trained(e2rl.make_sb3_env(4, **given), "ppo_plain")
    plain.save(tmp_path / "plain.zip")
    with pytest.raises(InputError, match="with other statistics"):
        e2rl.save_policy(
            PPO.load(tmp_path / "plain.zip", device="cpu"),
            tmp_path / "policy.pt",
            env=env,
        )


def test_statistics_of_several_normalisers_are_applied_in_turn(given, tmp_path):
    env = VecNormalize(VecNormalize(e2rl.make_sb3_env(4, **given), clip_obs=2.0))
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=8,
        batch_size=16,
        device="cpu",
        seed=0,
    ).learn(64)
    ego = e2rl.make_ego(
        "policy_file", file=str(e2rl.save_policy(model, tmp_path / "policy.pt"))
    )
    observation = (
        np.random.default_rng(0).normal(size=(50, OBSERVATION_SIZE)).astype(np.float32)
    )
    observed = env.normalize_obs(env.venv.normalize_obs(observation))
    predicted = torch.tensor(model.predict(observed, deterministic=True)[0])
    wanted = in_units(
        predicted, torch.tensor([-8.0, -1.6]), high=torch.tensor([5.0, 1.6])
    )
    assert torch.allclose(ego.decide(torch.tensor(observation)), wanted, atol=1e-4)


WRAPPED = {  # environments whose models do not map e2rl's observation to its actions; the message
    "stacked": (lambda env: VecFrameStack(DummyVecEnv([lambda: env]), 3), "stacked"),
    "a stack of gymnasium": (lambda env: FrameStackObservation(env, 3), "stacked"),
    "normalised by gymnasium": (NormalizeObservation, "wrapper of gymnasium"),
    "transformed": (
        lambda env: TransformObservation(env, lambda seen: seen / 10, None),
        "wrapper of gymnasium",
    ),
    "rescaled": (lambda env: RescaleAction(env, -2.0, 2.0), r"\[-2, 2\]"),
    "another action": (
        lambda env: TransformAction(env, lambda action: -action, None),
        "wrapper of gymnasium",
    ),
}


@pytest.mark.parametrize("name", WRAPPED)
def test_what_a_file_cannot_carry_is_refused(given, tmp_path, name):
    wrap, message = WRAPPED[name]
    model = PPO(
        "MlpPolicy",
        wrap(e2rl.make_gym_env(**given)),
        n_steps=8,
        batch_size=8,
        device="cpu",
    ).learn(8)
    with pytest.raises(InputError, match=message):
        e2rl.save_policy(model, tmp_path / "policy.pt")
    assert not list(tmp_path.iterdir()), "nothing half-written"


@pytest.mark.parametrize("wrap", [VecMonitor, VecCheckNan])
def test_wrappers_of_the_batch_that_change_nothing_are_passed_through(
    given, tmp_path, wrap
):
    model = trained(wrap(e2rl.make_sb3_env(4, **given)), "ppo")
    e2rl.save_policy(model, tmp_path / "policy.pt")
    assert (tmp_path / "policy.pt").is_file()


@pytest.mark.parametrize(
    "wrap", [lambda env: TimeLimit(env, 20), RecordEpisodeStatistics]
)
def test_wrappers_of_gymnasium_that_change_nothing_are_passed_through(
    given, tmp_path, wrap
):
    model = trained(wrap(e2rl.make_gym_env(**given)), "one")
    e2rl.save_policy(model, tmp_path / "policy.pt")
    assert (tmp_path / "policy.pt").is_file()


def test_a_model_of_another_environment_is_refused(given, tmp_path):
    model = PPO(
        "MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu"
    ).learn(8)
    with pytest.raises(InputError, match=r"\[3\] numbers, not the 326"):
        e2rl.save_policy(model, tmp_path / "policy.pt")
    with pytest.raises(InputError, match="name the policy.s file POLICY.pt"):
        e2rl.save_policy(
            trained(e2rl.make_sb3_env(4, **given), "ppo"), tmp_path / "policy.zip"
        )
    assert not list(tmp_path.iterdir()), "nothing half-written"


def same_actions(file, other, high=(5.0, 1.6)):
    """Whether two policies act alike, and use the bounds."""
    observation = torch.tensor(
        9 * np.random.default_rng(0).normal(size=(200, OBSERVATION_SIZE)),
        dtype=torch.float32,
    )
    first, second = (
        e2rl.make_ego("policy_file", file=str(path)).decide(observation)
        for path in (file, other)
    )
    return bool(torch.equal(first, second)) and bool(
        (first <= torch.tensor(high) + 1e-6).all()
    )
