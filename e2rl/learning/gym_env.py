"""The environment for gymnasium: a batch of scenes as a VectorEnv, and one scene as an Env (extra `gym`).

Actions are scaled: (0, 0) holds speed and heading, 1 and -1 are the simulator's bounds of acceleration and yaw rate.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.sim.observation import OBSERVATION_SIZE

Info = dict[str, Any]


def in_units(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Returns actions [..., 2] in m/s^2 and rad/s of scaled ones; low < 0 < high [2]: their bounds."""
    action = action.clamp(-1.0, 1.0)
    return action.clamp(min=0.0) * high - action.clamp(max=0.0) * low


class DrivingVectorEnv(VectorEnv):
    """B scenes as one batch; an environment whose episode ends is reset in the same step (AutoresetMode.SAME_STEP).

    Observations [B, OBSERVATION_SIZE] float32, actions [B, 2] in [-1, 1]. Arrays [B] of the info: contact, contact_vru,
    off_road (at this step), progress (m since the start), scene (its id) and eta. Of episodes that end these are in
    `final_info`, and the last observation is in `final_obs`, both with masks.

    bounds [2, 2]: of (m/s^2, rad/s), low and high.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: TransformedEnv) -> None:
        """env: of `e2rl.learning.environment.training_env`."""
        self.env, self.num_envs = env, env.batch_size[0]
        space = env.action_spec_unbatched.space
        self.bounds = torch.stack([space.low, space.high])
        self.single_observation_space = Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._scenes = env.base_env.scenes
        self._ids = np.array(self._scenes.scene_id, dtype=object)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Begins new episodes. options: scene: an id or position, or one for each environment (None: drawn)."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        scenes = (options or {}).get("scene")
        scenes = [scenes] * self.num_envs if scenes is None or isinstance(scenes, int | str) else scenes
        chosen = [-1 if scene is None else self._scenes.index(scene) for scene in scenes]
        draw = self.env.transform.draw
        draw.chosen = torch.tensor(chosen)
        try:
            self._now = self.env.reset()
        finally:
            draw.chosen = None
        return self._now["observation"].numpy().copy(), self._info(self._now)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Drives a step of every scene."""
        self._now["action"] = in_units(torch.as_tensor(actions, dtype=torch.float32), *self.bounds)
        stepped, self._now = self.env.step_and_maybe_reset(self._now)
        last = stepped["next"]
        reward, terminated, truncated = (last[key][:, 0].numpy() for key in ("reward", "terminated", "truncated"))
        info, done = self._info(self._now), terminated | truncated
        if done.any():
            info |= {"final_obs": last["observation"].numpy(), "final_info": self._info(last)}
            info |= {"_final_obs": done, "_final_info": done}
        return self._now["observation"].numpy().copy(), reward, terminated, truncated, info

    def _info(self, found: TensorDictBase) -> Info:
        told = {name: value[:, 0].numpy() for name, value in found["metrics"].items()}
        scene, row = found["scene_index"][:, 0].numpy(), found["traffic", "row"][:, 0]
        return told | {"scene": self._ids[scene], "eta": self.env.transform.pool.eta[row].numpy()}


class DrivingGymEnv(gymnasium.Env):
    """One scene: a batch of one, whose arrays have no B. It is reset by `reset`; the info is that of the step."""

    def __init__(self, env: TransformedEnv) -> None:
        """env: as that of DrivingVectorEnv, with one environment."""
        self._batch = DrivingVectorEnv(env)
        self.bounds = self._batch.bounds
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Begins a new episode; options as those of DrivingVectorEnv."""
        super().reset(seed=seed)
        observation, info = self._batch.reset(seed=seed, options=options)
        return observation[0], row_of(info, 0)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Drives a step."""
        observation, reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        seen = info.get("final_obs", observation)[0]
        info = row_of(info.get("final_info", info), 0)
        return seen, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def row_of(info: Info, row: int) -> Info:
    """Returns the info of one environment of a batch."""
    return {name: values[row] for name, values in info.items()}
