"""A TorchRL Transform that gives every new episode its scene and traffic, drawn from the round's pool."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from e2rl.learning.pool import TrafficPool


class SceneSampler(Transform):
    """Draws a pool row for each environment that resets and tags its frames with it: "traffic_row" [B, 1] int64.

    Until `load` is called, episodes replay the recordings of all scenes with equal probability.
    """

    def __init__(self, num_scenes: int, batch_size: int, seed: int = 0) -> None:
        """num_scenes: of the environment's SceneSet; batch_size B: environments."""
        super().__init__()
        self._generator = torch.Generator().manual_seed(seed)
        self._row = torch.zeros(batch_size, 1, dtype=torch.int64)
        self.pool = TrafficPool.recorded(torch.arange(num_scenes))
        self.probability = torch.full((num_scenes,), 1 / num_scenes, dtype=torch.float64)

    def load(self, pool: TrafficPool, priority: Tensor, share: float) -> None:
        """Draw from `pool` at coming resets: adversarial rows with probability `share`, scenes by priority [S]."""
        self.pool, self.probability = pool, pool.probabilities(priority, share)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        env = self.parent.base_env
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=env.batch_size, device=env.device)
        mask = tensordict.get("_reset", None)
        mask = torch.ones(env.batch_size, dtype=torch.bool) if mask is None else mask.view(env.batch_size).cpu()
        places = mask.nonzero()[:, 0]
        rows = torch.multinomial(self.probability, len(places), replacement=True, generator=self._generator)
        self._row = self._row.cpu().index_put((places,), rows[:, None])
        self.pool.inject(env, places.to(env.device), rows)
        tensordict["scene_index"] = self.pool.scene_index[self._row].to(env.device)
        self._row = self._row.to(env.device)
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict["traffic_row"] = self._row.clone()
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declares "traffic_row"."""
        observation_spec["traffic_row"] = Unbounded(
            tuple(self._row.shape), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec

    def get_extra_state(self) -> dict[str, Tensor]:
        """Part of the state_dict: the generator (the pool comes anew in each round)."""
        return {"generator": self._generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Go on drawing where the state_dict was taken."""
        self._generator.set_state(state["generator"].cpu())
