"""The batch by Stable-Baselines3's interface, and its policies as modules (extra
`gym`)."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformAction
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from torch import Tensor, nn

from e2rl.learning.adapters.gym_env import Driving, DrivingVectorEnv, in_units, row_of
from e2rl.run.errors import InputError
from e2rl.sim.observation import ELAPSED, OBSERVATION_SIZE


class SB3Env(VecEnv):
    """A DrivingVectorEnv as a VecEnv. Seed and options of the first environment are the
    batch's."""

    def __init__(self, batch: DrivingVectorEnv) -> None:
        self.batch = batch
        super().__init__(
            batch.num_envs,
            batch.single_observation_space,
            batch.single_action_space,
        )

    @property
    def autoreset_mode(self) -> Any:
        """Raises InputError, as the batch's does."""
        return self.batch.autoreset_mode

    def reset(self) -> np.ndarray:
        observation, info = self.batch.reset(
            seed=self._seeds[0], options=self._options[0]
        )
        self.reset_infos = [row_of(info, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._given = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Any]]:
        observation, reward, terminated, truncated, info = self.batch.step(self._given)
        ended = terminated | truncated
        last = info.pop("final_info", {})
        final = info.pop("final_obs", observation)
        infos = [row_of(last if over else info, row) for row, over in enumerate(ended)]
        for row in ended.nonzero()[0]:
            infos[row] |= {
                "terminal_observation": final[row],
                "TimeLimit.truncated": not terminated[row],
            }
        return observation, reward, ended, infos

    def close(self) -> None:
        self.batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.batch, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError("the environments are one batch")

    env_method = set_attr

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


class Deterministic(nn.Module):
    """What `model.predict(observation, deterministic=True)` returns for e2rl's
    observation, in m/s^2 and rad/s.

    The statistics of every VecNormalize of its environment come along.
    """

    def __init__(self, model: BaseAlgorithm, env: VecEnv | None = None) -> None:
        """
        Args:
            model: as trained, or loaded without an environment.
            env: of a loaded model, its VecNormalize included; None: it had none.

        Raises:
            InputError: another observation, action or normalisation than the model was
                trained with.
        """
        super().__init__()
        check_spaces(model)
        driving = driving_of(model, env)
        self.low = torch.tensor(driving["low"])
        self.high = torch.tensor(driving["high"])
        self.policy = type(model.policy)(
            **model.policy._get_constructor_parameters()
        )  # a copy on the CPU
        self.policy.load_state_dict(model.policy.state_dict())
        trained_in = env if env is not None else model.get_env()
        self.normalisers = normalisers_of(trained_in)
        check_wrappers(trained_in)
        in_training = (
            trained_in is model.get_env() is not None and model._last_obs is not None
        )
        if not in_training:
            check_last_observation(model, self.normalisers, steps=driving["steps"])

    def forward(self, observation: Tensor) -> Tensor:
        for mean, scale, clip in self.normalisers:
            observation = ((observation - mean) / scale).clamp(-clip, clip)
        action = self.policy._predict(observation, deterministic=True)
        return in_units(action, self.low, high=self.high)


def check_spaces(model: BaseAlgorithm) -> None:
    """Raises InputError where a model maps other numbers than e2rl's observation to two
    in [-1, 1]."""
    shape = model.observation_space.shape
    if shape != (OBSERVATION_SIZE,):
        raise InputError(
            f"the model observes {list(shape or ())} numbers, not the "
            f"{OBSERVATION_SIZE} of a moment: as an ego it gets no stacked or added "
            "ones; train it without that wrapper"
        )
    low, high = (
        np.asarray(getattr(model.action_space, name)) for name in ("low", "high")
    )
    if not ((low == -1).all() and (high == 1).all()):
        raise InputError(
            f"the model's actions lie in [{low.min():g}, {high.max():g}], those of "
            "e2rl in [-1, 1]: train it without the wrapper that rescales them"
        )


def driving_of(model: BaseAlgorithm, env: VecEnv | None) -> Driving:
    """What the model was trained to drive: its action space tells, else an environment.

    Raises InputError where an environment has other bounds, or nothing tells them.
    """
    trained = getattr(model.action_space, "driving", None)
    source = env if env is not None else model.get_env()
    if source is None or not source.has_attr("driving"):
        if trained is None:
            raise InputError(
                "the model has no environment of e2rl, which has the bounds: "
                "pass env=e2rl.make_sb3_env(1)"
            )
        return trained
    present = source.get_attr("driving")[0]
    if trained is not None and bounds_line(trained) != bounds_line(present):
        raise InputError(
            f"the model was trained with actions from {bounds_line(trained)}, its "
            f"environment has those from {bounds_line(present)}: load it without one, "
            "by load(FILE), or give the environment the same max_acceleration, "
            "max_braking and max_yaw_rate"
        )
    return present if trained is None else trained


def bounds_line(driving: Driving) -> str:
    """The bounds of the actions in words."""
    accelerations, yaw_rates = zip(driving["low"], driving["high"], strict=True)
    return (
        f"{accelerations[0]:g} to {accelerations[1]:g} m/s^2 and "
        f"{yaw_rates[0]:g} to {yaw_rates[1]:g} rad/s"
    )


def normalisers_of(env: VecEnv | None) -> list[tuple[Tensor, Tensor, float]]:
    """Mean, scale and clip of each VecNormalize of an environment, the first that an
    observation meets first."""
    normalisers: list[tuple[Tensor, Tensor, float]] = []
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecNormalize) and env.norm_obs:
            statistics: Any = env.obs_rms
            mean = torch.tensor(statistics.mean).float()
            scale = torch.tensor((statistics.var + env.epsilon) ** 0.5).float()
            normalisers.insert(0, (mean, scale, float(env.clip_obs)))
        env = env.venv
    return normalisers


def check_wrappers(env: VecEnv | None) -> None:
    """Raises InputError where gymnasium's wrappers change observations or actions of an
    environment."""
    if env is None:
        return
    if any(
        any(env.env_is_wrapped(kind))
        for kind in (gymnasium.ObservationWrapper, TransformAction)
    ):
        raise InputError(
            "a wrapper of gymnasium changes the model's observations or actions, and "
            "the policy's file would not have it: normalise by VecNormalize of "
            "Stable-Baselines3, which is saved, or pass a module of the whole map"
        )


def check_last_observation(
    model: BaseAlgorithm,
    normalisers: list[tuple[Tensor, Tensor, float]],
    steps: int,
) -> None:
    """Raises InputError where the last observation that a model holds was not
    normalised by these.

    Undone, it has e2rl's elapsed fraction of the episode: one of k / steps.
    """
    if model.num_timesteps == 0:
        return
    if model._last_obs is None:
        raise InputError(
            "a model that was loaded with an environment does not tell whether it was "
            "trained under VecNormalize: load it without one, and pass the "
            "VecNormalize, if it had any: save_policy(PPO.load(FILE), POLICY, env=ENV)"
        )
    elapsed = torch.as_tensor(np.asarray(model._last_obs), dtype=torch.float64)[
        :, ELAPSED
    ]
    for mean, scale, _ in reversed(normalisers):
        elapsed = elapsed * scale[ELAPSED] + mean[ELAPSED]
    step = elapsed * steps
    whole = (step - step.round()).abs() < 0.01
    if not bool((whole & (step > -0.5) & (step < steps + 0.5)).all()):
        missing = (
            "with other statistics than those of env"
            if normalisers
            else "with normalised observations"
        )
        raise InputError(
            f"the model was trained {missing}: pass the VecNormalize that was saved with it, "
            "env=VecNormalize.load(FILE, e2rl.make_sb3_env(1))"
        )
