"""gymnasium sees the same episodes as TorchRL, by interfaces that pass both checkers."""

import multiprocessing
import sys
from functools import partial

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import vector
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

import e2rl
from e2rl.learning.adapters.gym_env import in_units
from e2rl.run.errors import InputError
from e2rl.sim.observation import ELAPSED

SPEED = 0  # of the observation


@pytest.fixture(scope="module")
def given():
    """Three scenes with recorded traffic."""
    return {
        "scenes": e2rl.load_scenes("bundled", 3),
        "method": "replay",
        "eta": 0.0,
        "compile": False,
    }


@pytest.fixture(scope="module")
def bundled():
    """So many bundled scenes that two draws of several are hardly ever alike."""
    return {
        "scenes": e2rl.load_scenes("bundled", 12),
        "method": "replay",
        "eta": 0.0,
        "compile": False,
    }


def actions(batch, seed=0):
    """Scaled actions [B, 2], some of which leave the road before long."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (batch, 2)).astype(np.float32)


def test_the_checkers_of_gymnasium_and_torchrl_pass(given):
    attacked = given | {"method": "e2", "eta": (0.0, 2.0)}
    check_env(e2rl.make_gym_env(**attacked), skip_render_check=True)
    check_env_specs(e2rl.make_env(3, **attacked))


def test_a_batch_has_the_episodes_of_the_torchrl_environment(given):
    """Through ends and resets: observations, rewards, flags and what ended, from equal
    seeds and actions."""
    env = e2rl.make_env(4, **given)
    batch = e2rl.make_gym_env(4, **given)
    env.set_seed(5)
    td, (observed, info) = env.reset(), batch.reset(seed=5)
    ended = 0
    for step in range(90):
        assert (observed == td["observation"].numpy()).all()
        assert observed.dtype == np.float32
        assert [given["scenes"].index(scene) for scene in info["scene"]] == td[
            "scene_index"
        ][:, 0].tolist()
        action = actions(4, step)
        td["action"] = in_units(torch.tensor(action), *batch.bounds)
        finished, td = env.step_and_maybe_reset(td)
        observed, *flags, info = batch.step(action)
        for key, value in zip(
            ("reward", "terminated", "truncated"), flags, strict=True
        ):
            assert (value == finished["next", key][:, 0].numpy()).all()
        over = finished["next", "done"][:, 0].numpy()
        assert (over == info.get("_final_obs", False)).all()
        for row in over.nonzero()[0]:
            assert (
                info["final_obs"][row] == finished["next", "observation"][row].numpy()
            ).all()
            assert (
                info["final_info"]["off_road"][row]
                == finished["next", "metrics", "off_road"][row, 0]
            )
            assert observed[row, ELAPSED] == 0, "the next episode's first"
            ended += 1
    assert ended > 4


def test_a_scene_drives_alone_as_in_a_batch(given):
    """In a chosen scene, to the end of the episode, whose observation and info are
    those of the step."""
    single = e2rl.make_gym_env(**given)
    batch = e2rl.make_gym_env(2, **given)
    name = given["scenes"].scene_id[1]
    (alone, info), (both, _) = (
        single.reset(options={"scene": name}),
        batch.reset(options={"scene": 1}),
    )
    assert info["scene"] == name
    for step in range(200):
        assert np.allclose(alone, both, atol=1e-5)
        action = actions(1, step)[0]
        alone, reward, terminated, truncated, info = single.step(action)
        both, rewards, *_, infos = batch.step(np.stack([action, action]))
        assert reward == pytest.approx(rewards[0], abs=1e-5)
        assert info["scene"] == name
        if terminated or truncated:
            assert np.allclose(alone, infos["final_obs"][0], atol=1e-5)
            assert alone[ELAPSED] > 0
            assert terminated == (info["contact"] or info["off_road"])
            return
    pytest.fail("no end")


def test_a_seed_decides_the_episodes_in_attacked_traffic(given):
    batch = e2rl.make_gym_env(3, **given | {"method": "e2", "eta": 2.0})

    def driven(seed):
        first, info = batch.reset(seed=seed)
        return [first, *(batch.step(np.zeros((3, 2)))[0] for _ in range(12))], info[
            "scene"
        ].tolist()

    (ours, scenes), (again, same), (_, others) = driven(1), driven(1), driven(3)
    assert all(map(np.array_equal, ours, again))
    assert scenes == same != others


def test_environments_without_a_seed_drive_in_other_scenes(bundled):
    """As workers of one function, and as one environment that is copied into several
    processes."""
    batches = [e2rl.make_gym_env(8, **bundled) for _ in range(2)]
    first, second = (batch.reset()[1]["scene"].tolist() for batch in batches)
    assert first != second
    with multiprocessing.get_context("fork").Pool(1) as pool:
        (copied,) = pool.map(scenes_of, [batches[0]])
    assert copied != batches[0].reset()[1]["scene"].tolist()


def test_environments_with_a_seed_drive_in_the_same_scenes(bundled):
    """In other processes, too; `reset(seed=...)` decides over the seed of the making."""
    seeded = [e2rl.make_gym_env(8, **bundled, seed=seed) for seed in (4, 4, 5)]
    with multiprocessing.get_context("fork").Pool(1) as pool:
        (copied,) = pool.map(scenes_of, [seeded[0]])
    first, second, other = (env.reset()[1]["scene"].tolist() for env in seeded)
    assert copied == first == second != other
    unseeded = e2rl.make_gym_env(8, **bundled)
    chosen = unseeded.reset(seed=9)[1]["scene"].tolist()
    assert chosen == seeded[2].reset(seed=9)[1]["scene"].tolist()
    with multiprocessing.get_context("fork").Pool(1) as pool:
        (copied,) = pool.map(scenes_of, [unseeded])
    assert copied == unseeded.reset()[1]["scene"].tolist()


def scenes_of(env):
    """Of the next episodes."""
    return env.reset()[1]["scene"].tolist()


@pytest.mark.parametrize(
    "kind", [SyncVectorEnv, partial(AsyncVectorEnv, context="fork")]
)
def test_gymnasium_s_own_batches_drive_in_scenes_of_their_own(bundled, kind):
    """Every environment by a seed of its own, the same again by the same seed."""
    workers = kind([lambda: e2rl.make_gym_env(**bundled)] * 6)
    try:
        unseeded, _ = workers.reset()
        first, second, other = (workers.reset(seed=seed)[0] for seed in (1, 1, 40))
    finally:
        workers.close()
    assert len(np.unique(unseeded, axis=0)) > 1
    assert len(np.unique(first, axis=0)) > 1
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_in_the_next_step_an_episode_begins_whatever_is_done(given):
    """As in gymnasium's own batches: its action is ignored, it has no reward, and
    nothing is final."""
    env = e2rl.make_gym_env(4, autoreset="next_step", **given)
    env.reset(seed=5)
    begins = np.zeros(4, dtype=bool)
    episodes = 0
    for step in range(100):
        observation, reward, terminated, truncated, info = env.step(actions(4, step))
        assert (observation[begins, ELAPSED] == 0).all()
        assert (observation[~begins, ELAPSED] > 0).all()
        assert not (terminated | truncated)[begins].any()
        assert not reward[begins].any()
        assert "final_obs" not in info
        begins = terminated | truncated
        assert not info["off_road"][~begins].any()
        episodes += begins.sum()
    assert episodes > 4


def test_gymnasium_normalises_the_observations_of_a_batch(given):
    env = vector.NormalizeObservation(
        e2rl.make_gym_env(3, autoreset="next_step", **given)
    )
    env.reset(seed=0)
    for step in range(40):
        observation = env.step(actions(3, step))[0]
    assert np.abs(observation).max() < 20
    assert env.obs_rms.count > 100
    with pytest.raises(InputError, match="autoreset=never"):
        e2rl.make_gym_env(3, autoreset="never", **given)


def test_torchrl_is_pointed_to_its_own_environment(given):
    for batch in (e2rl.make_gym_env(3, **given), e2rl.make_sb3_env(3, **given)):
        with pytest.raises(InputError, match=r"e2rl.make_env\(NUM_ENVS\)"):
            GymWrapper(batch)
    check_env_specs(GymWrapper(e2rl.make_gym_env(**given)))


def test_actions_are_scaled_about_keeping_speed_and_heading(given):
    low = torch.tensor([-8.0, -1.6])
    high = torch.tensor([5.0, 1.6])
    scaled = in_units(
        torch.tensor([[-2.0, -1.0], [-0.5, 0.0], [0.0, 0.5], [1.0, 3.0]]),
        low,
        high=high,
    )
    assert scaled.tolist() == [
        pytest.approx(row)
        for row in ([-8.0, -1.6], [-4.0, 0.0], [0.0, 0.8], [5.0, 1.6])
    ]
    env = e2rl.make_gym_env(**given, max_acceleration=2.0)
    assert env.bounds.tolist() == [
        pytest.approx([-8.0, -1.6]),
        pytest.approx([2.0, 1.6]),
    ]
    before = env.reset(options={"scene": 0})[0][SPEED]
    assert env.step(np.zeros(2))[0][SPEED] == pytest.approx(before, abs=1e-5)


def test_what_cannot_be_is_named(given, monkeypatch):
    env = e2rl.make_gym_env(**given)
    with pytest.raises(InputError, match="scene=nowhere"):
        env.reset(options={"scene": "nowhere"})
    before = env.reset(seed=1)[1]["scene"]
    assert len({env.reset(seed=seed)[1]["scene"] for seed in range(8)}) > 1
    assert env.reset(seed=1)[1]["scene"] == before
    with pytest.raises(InputError, match="num_envs=0"):
        e2rl.make_gym_env(0, **given)
    with pytest.raises(InputError, match="max_speed"):
        e2rl.make_env(1, **given, max_speed=3.0)
    monkeypatch.delitem(sys.modules, "e2rl.learning.adapters.gym_env")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(InputError, match=r"pip install -e '.*\[gym\]'"):
        e2rl.make_gym_env(**given)
