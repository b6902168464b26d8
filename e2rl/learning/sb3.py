"""The batch by Stable-Baselines3's interface, and its policies as modules (extra `gym`)."""

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from e2rl.learning.gym_env import DrivingVectorEnv, in_units, row_of
from e2rl.run.errors import InputError


class SB3Env(VecEnv):
    """A DrivingVectorEnv as a VecEnv. Seed and options of the first environment are the batch's."""

    def __init__(self, batch: DrivingVectorEnv) -> None:
        self.batch = batch
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)

    def reset(self) -> np.ndarray:
        observation, info = self.batch.reset(seed=self._seeds[0], options=self._options[0])
        self.reset_infos = [row_of(info, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._given = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Any]]:
        observation, reward, terminated, truncated, info = self.batch.step(self._given)
        done, last, seen = terminated | truncated, info.pop("final_info", {}), info.pop("final_obs", observation)
        infos = [row_of(last if ended else info, row) for row, ended in enumerate(done)]
        for row in done.nonzero()[0]:
            infos[row] |= {"terminal_observation": seen[row], "TimeLimit.truncated": not terminated[row]}
        return observation, reward, done, infos

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
    """What `model.predict(observation, deterministic=True)` returns, in m/s^2 and rad/s."""

    def __init__(self, model: BaseAlgorithm) -> None:
        """Raises InputError for a model without an environment of e2rl, which has the bounds."""
        super().__init__()
        env, normal = model.get_env(), model.get_vec_normalize_env()
        if env is None or not env.has_attr("bounds"):
            raise InputError("the model has no environment of e2rl: load it with env=e2rl.make_sb3_env(...)")
        self.low, self.high = env.get_attr("bounds")[0]
        self.policy = type(model.policy)(**model.policy._get_constructor_parameters())  # a copy on the CPU
        self.policy.load_state_dict(model.policy.state_dict())
        self.mean, self.scale, self.clip = torch.zeros(1), torch.ones(1), torch.inf
        if normal is not None and normal.norm_obs:
            known: Any = normal.obs_rms
            self.mean, self.scale = (torch.tensor(x).float() for x in (known.mean, (known.var + normal.epsilon) ** 0.5))
            self.clip = normal.clip_obs

    def forward(self, observation: Tensor) -> Tensor:
        seen = ((observation - self.mean) / self.scale).clamp(-self.clip, self.clip)
        return in_units(self.policy._predict(seen, deterministic=True), self.low, self.high)
