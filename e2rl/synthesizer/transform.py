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
from e2rl.synthesizer.synthesizer import Episode, Synthesizer, put_rows, take_rows


class AdversarialSynthesizer(Transform):
    """Injects scenes at reset and re-plans their traffic every `replan` steps against the ego's current plan.

    draw(count) -> (scene indices [count], seeds [count], eta [count]) names the scenes of a reset. Executed states are
    the planned ones; a vehicle whose route ends at the map's border is gone from that step on.
    """

    def __init__(self, synthesizer: Synthesizer, ego: Ego, draw: Callable[[int], tuple[Tensor, Tensor, Tensor]],
                 replan: int = 5):
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
        mask = torch.ones(batch, dtype=torch.bool) if mask is None else mask.reshape(batch).cpu()
        rows = mask.nonzero().squeeze(-1)
        index, seed, eta = self.draw(len(rows))
        chosen = torch.zeros(batch, 1, dtype=torch.long)
        chosen[rows, 0] = index.cpu()
        tensordict["scene_index"] = chosen.to(self._env.device)
        self._pending = (rows, seed, eta)
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        rows, seed, eta = self._pending
        device = self._env.device
        rows, seed, eta = rows.to(device), seed.to(device), eta.to(device)
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
        due = (world.step - self._planned == self.every) & ~next_tensordict["done"].reshape(-1)
        rows = due.nonzero().squeeze(-1)
        if len(rows):
            self._replan(rows, world)
        return next_tensordict

    def _replan(self, rows: Tensor, world: World) -> None:
        """Plans of environments `rows`, in groups that have been planned equally often."""
        ego_plan = self.ego.plan(world)
        for count in self.episode.replans[rows].unique().tolist():
            group = rows[self.episode.replans[rows] == count]
            episode, plan = self.synthesizer.replan(
                take_rows(self.episode, group), take_rows_of_world(world, group), ego_plan[group])
            self.episode = put_rows(self.episode, group, replace(episode, state=plan.after(self.every)))
            states, valid = plan.states().transpose(1, 2), plan.on_map.transpose(1, 2)
            vehicles = states.shape[2]
            self._plan[0][group, :, :vehicles] = states
            self._plan[1][group, :, :vehicles] = valid & world.valid[group][:, None, :vehicles]
            self._planned[group] = world.step[group]
        self._env.write_traffic(self._planned, *self._plan, self.episode.routed.route)


def take_rows_of_world(world: World, rows: Tensor) -> World:
    """The world of some of its scenes."""
    plan = None if world.plan is None else world.plan[rows]
    return World(world.scene[rows], world.step[rows], world.states[rows], world.valid[rows], world.accel[rows],
                 world.route[rows], plan)
