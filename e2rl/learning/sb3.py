"""The batch for Stable-Baselines3, which has a vector interface of its own, and its policies as egos (extra `gym`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from e2rl.learning.gym_env import DrivingVectorEnv, in_units, row_of
from e2rl.planners.policy_export import write_policy
from e2rl.run.errors import InputError


class SB3Env(VecEnv):
    """A DrivingVectorEnv as a VecEnv: all scenes as one batch in this process."""

    def __init__(self, batch: DrivingVectorEnv) -> None:
        self.batch = batch
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)

    def reset(self) -> np.ndarray:
        """Observations [B, D] of new episodes; `seed` and `set_options` decide them as in VecEnv."""
        scenes = [options.get("scene") for options in self._options]
        observation, self._info = self.batch.reset(seed=self._seeds[0], options={"scene": scenes})
        self.reset_infos = [row_of(self._info, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self.batch.step(self._actions)
        done, last = terminated | truncated, info.pop("final_info", {})
        seen = info.pop("final_obs", None)
        infos = [row_of(last if ended else info, row) for row, ended in enumerate(done)]
        for row in done.nonzero()[0]:
            ended = {"terminal_observation": seen[row], "TimeLimit.truncated": not terminated[row]}
            infos[row] |= ended
        return observation, reward, done, infos

    def close(self) -> None:
        self.batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.batch, attr_name)] * len(self._get_indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("the environments are one batch")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError("the environments are one batch")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(self._get_indices(indices))


class Deterministic(nn.Module):
    """What `model.predict(observation, deterministic=True)` returns, in m/s^2 and rad/s."""

    mean: Tensor
    scale: Tensor
    bounds: Tensor

    def __init__(self, model: BaseAlgorithm) -> None:
        """Raises InputError for a model without an environment of e2rl, which has the bounds of its actions."""
        super().__init__()
        env, normalised = model.get_env(), model.get_vec_normalize_env()
        if env is None or not env.has_attr("bounds"):
            raise InputError("the model has no environment of e2rl: load it with env=e2rl.make_sb3_env(...)")
        self.policy = model.policy
        self.clip, mean, scale = torch.inf, np.zeros(1), np.ones(1)
        if normalised is not None and normalised.norm_obs:
            statistics, self.clip = normalised.obs_rms, normalised.clip_obs
            mean, scale = statistics.mean, np.sqrt(statistics.var + normalised.epsilon)
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32))
        self.register_buffer("bounds", env.get_attr("bounds")[0])

    def forward(self, observation: Tensor) -> Tensor:
        seen = ((observation - self.mean) / self.scale).clamp(-self.clip, self.clip)
        return in_units(self.policy._predict(seen, deterministic=True), *self.bounds)


def save_policy(model: BaseAlgorithm, file: Path) -> None:
    """See `e2rl.api.save_policy`."""
    write_policy(Deterministic(model), file)
