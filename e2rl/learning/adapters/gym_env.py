"""The environment of `e2rl.make_env` by gymnasium's interfaces: a batch of scenes, or
one (extra `gym`)."""

from collections.abc import Mapping
from typing import Any, TypedDict

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.run.errors import InputError
from e2rl.sim.observation import OBSERVATION_SIZE

Info = dict[str, Any]


class Driving(TypedDict):
    """What actions of -1 and 1 do, which a policy's file needs. Plain values: action
    spaces carry them into a saved model of Stable-Baselines3."""

    low: list[float]  # m/s^2, rad/s
    high: list[float]
    steps: int  # of an episode


def in_units(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions [..., 2] in m/s^2 and rad/s of those in [-1, 1], from low < 0 over 0 to
    high > 0 [2]; 0 is 0."""
    return action.clamp(0.0, 1.0) * high - action.clamp(-1.0, 0.0) * low


AUTORESET = {"same_step": AutoresetMode.SAME_STEP, "next_step": AutoresetMode.NEXT_STEP}


class DrivingVectorEnv(VectorEnv):
    """B scenes as one batch.

    Observations [B, OBSERVATION_SIZE], actions [B, 2] in [-1, 1] of bounds [2, 2] (low,
    high; m/s^2, rad/s). The info has arrays [B]: the metrics of DrivingEnv, scene (its
    id) and eta; of those that end they are in final_info.
    """

    def __init__(
        self,
        env: TransformedEnv,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        self.env = env
        self.num_envs = env.batch_size[0]
        space = env.action_spec_unbatched.space
        self.metadata = {"autoreset_mode": autoreset_mode}
        self.bounds = torch.stack([space.low, space.high])
        self.single_observation_space = Box(
            -np.inf,
            np.inf,
            (OBSERVATION_SIZE,),
            np.float32,
        )
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.driving = Driving(
            low=space.low.tolist(),
            high=space.high.tolist(),
            steps=env.horizon,
        )
        vars(self.single_action_space)["driving"] = self.driving
        self.observation_space = batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """Raises InputError: TorchRL's GymWrapper alone asks for it, and cannot carry
        the scenes' ids of the info."""
        raise InputError(
            "GymWrapper: e2rl.make_env(NUM_ENVS) is this batch as an environment of "
            "TorchRL; use that"
        )

    def reset(
        self,
        *,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[np.ndarray, Info]:
        """New episodes; options: scene: id or position of the scene of all. InputError
        for one that is not there."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        synthesizer = self.env.transform
        scene = (options or {}).get("scene")
        every = synthesizer.draw.probability
        if scene is not None:
            synthesizer.draw.probability = every * (
                synthesizer.pool.scene_index == self.env.scenes.index(scene)
            )
        self._now = self.env.reset()
        self._ended = np.zeros(self.num_envs, dtype=bool)
        synthesizer.draw.probability = every
        return self._shown(self._now)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """A step of all environments."""
        self._now["action"] = in_units(
            torch.as_tensor(actions, dtype=torch.float32), *self.bounds
        )
        stepped, self._now = self.env.step_and_maybe_reset(self._now)
        last = stepped["next"]
        reward, terminated, truncated = (
            last[key][:, 0].numpy() for key in ("reward", "terminated", "truncated")
        )
        if self.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP:
            return self._begun_in_next_step(
                last,
                reward,
                terminated=terminated,
                truncated=truncated,
            )
        observation, info = self._shown(self._now)
        ended = terminated | truncated
        if ended.any():
            info["final_obs"], info["final_info"] = self._shown(last)
            info |= {"_final_obs": ended, "_final_info": ended}
        return observation, reward, terminated, truncated, info

    def _begun_in_next_step(
        self,
        last: TensorDictBase,
        reward: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """What a step returns where an environment that ended begins with the step
        after it.

        The batch, which has no pause, began it at once and drove a step, so it begins
        anew.
        """
        begins = self._ended
        if begins.any():
            self._now["_reset"] = torch.from_numpy(begins)[:, None]
            self._now = self.env.reset(self._now)
        reward, terminated, truncated = (
            np.where(begins, np.zeros_like(values), values)
            for values in (reward, terminated, truncated)
        )
        self._ended = terminated | truncated
        observation, info = self._shown(self._now)
        last_observation, last_info = self._shown(last)
        observation[self._ended] = last_observation[self._ended]
        info = {
            name: np.where(self._ended, last_info[name], values)
            for name, values in info.items()
        }
        return observation, reward, terminated, truncated, info

    def _shown(self, data: TensorDictBase) -> tuple[np.ndarray, Info]:
        """Observation and info."""
        metrics = {name: value[:, 0].numpy() for name, value in data["metrics"].items()}
        ids = [
            self.env.scenes.scene_id[scene]
            for scene in data["scene_index"][:, 0].tolist()
        ]
        eta = self.env.transform.pool.eta[data["traffic", "row"][:, 0]].numpy()
        return data["observation"].numpy().copy(), metrics | {
            "scene": np.array(ids, dtype=object),
            "eta": eta,
        }


class DrivingGymEnv(gymnasium.Env):
    """One scene: a batch of one, whose arrays have no B."""

    def __init__(self, env: TransformedEnv) -> None:
        self._batch = DrivingVectorEnv(env)
        self.bounds = self._batch.bounds
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self.driving = self._batch.driving

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, Info]:
        super().reset(seed=seed)
        observation, info = self._batch.reset(seed=seed, options=options)
        return observation[0], row_of(info, 0)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        observation, reward, terminated, truncated, info = self._batch.step(
            np.asarray(action)[None]
        )
        return (
            info.get("final_obs", observation)[0],
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            row_of(info.get("final_info", info), 0),
        )


def row_of(info: Info, row: int) -> Info:
    """The info of one environment of a batch."""
    return {name: values[row] for name, values in info.items()}
