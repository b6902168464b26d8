"""AdversarialSynthesizer: the synthesizer as a TorchRL transform over DrivingEnv."""

from collections.abc import Callable
from dataclasses import replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from e2rl.ego.base import Ego
from e2rl.prior.lane_relative import HORIZON
from e2rl.sim.world import World
from e2rl.synthesizer.episode import Episode, put_rows, take_rows
from e2rl.synthesizer.synthesizer import Synthesizer


class AdversarialSynthesizer(Transform):
    """Injects scenes at reset and re-plans their traffic every `replan` steps against the ego's current plan.

    draw(count) -> (scene indices [count], seeds [count], eta [count]) names the scenes of a reset. Executed states are
    the planned ones; a vehicle whose route ends at the map's border is gone from that step on.
    """

    def __init__(
        self, synthesizer: Synthesizer, ego: Ego, draw: Callable[[int], tuple[Tensor, Tensor, Tensor]], replan: int = 5
    ):
        super().__init__()
        self.synthesizer, self.ego, self.draw, self.every = synthesizer, ego, draw, replan
        self.episode: Episode | None = None
        self._pending: tuple[Tensor, Tensor, Tensor] | None = None
        self._plan: tuple[Tensor, Tensor] | None = None  # states [B, H, N, 4] and valid [B, H, N] being executed
        self._planned: Tensor | None = None  # [B] step of the plan

    @property
    def _env(self):
        return self.parent.base_env

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        batch = self._env.batch_size[0]
        tensordict = TensorDict({}, batch_size=[batch]) if tensordict is None else tensordict
        mask = tensordict.get("_reset", None)
        mask = torch.ones(batch, dtype=torch.bool) if mask is None else mask.reshape(batch)
        device = self._env.device
        rows = mask.to(device).nonzero().squeeze(-1)
        index, seed, eta = (value.to(device) for value in self.draw(len(rows)))
        chosen = self._env.scene["scene_index"].clone()  # rows that go on keep their scene
        chosen[rows] = index
        tensordict["scene_index"] = chosen[:, None]
        self._pending = (rows, seed, eta)
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        rows, seed, eta = self._pending
        device = self._env.device
        world = self._env.world()
        fresh = self.synthesizer.begin(world.scene[rows], seed, eta)
        self.episode = fresh if self.episode is None else put_rows(self.episode, rows, fresh)
        self.ego.reset(world)
        if self._plan is None:
            shape = (len(world.step), HORIZON, world.states.shape[1])
            self._plan = (world.states.new_zeros(*shape, 4), torch.zeros(shape, dtype=torch.bool, device=device))
            self._planned = torch.zeros_like(world.step)
        self._replan(rows, world)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        world = self._env.world()
        # An ego that has left truncates its episode; who goes on stepping still needs traffic.
        running = (world.step < self._env.horizon) & ~next_tensordict["terminated"].reshape(-1)
        due = (world.step - self._planned >= self.every) & running
        rows = due.nonzero().squeeze(-1)
        if len(rows):
            self._replan(rows, world)
        return next_tensordict

    def _replan(self, rows: Tensor, world: World) -> None:
        """New plans of environments `rows`, written into the traffic."""
        ego_plan = self.ego.announce(world)
        if len(rows) == len(world.step):  # spares copies of maps
            episode, plan = self.synthesizer.replan(self.episode, world, ego_plan, self.ego)
            self.episode = replace(episode, state=plan.after(self.every))
        else:
            episode, plan = self.synthesizer.replan(
                take_rows(self.episode, rows), take_rows(world, rows), ego_plan[rows], self.ego
            )
            self.episode = put_rows(self.episode, rows, replace(episode, state=plan.after(self.every)))
        states, valid = plan.states().transpose(1, 2), plan.on_map.transpose(1, 2)
        vehicles = states.shape[2]
        self._plan[0][rows, :, :vehicles] = states
        self._plan[1][rows, :, :vehicles] = valid
        self._planned[rows] = world.step[rows]
        self._env.write_traffic(self._planned, *self._plan, self.episode.routed.route)
