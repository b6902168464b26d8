"""The planner that drives the learned ego in danger: what is learned corrects it.

A network of a few layers does not find the evasion that a search among hundreds of
candidates finds (docs/results/training.md). So where its route follower would come too
near to somebody, the actor begins from the sampling planner's action instead.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from e2rl.planners.chunks import take
from e2rl.planners.reference import EVASION, follow
from e2rl.planners.sampling import SamplingEgo
from e2rl.sim import dynamics
from e2rl.sim.world import World


class Evader:
    """Asks a planner in danger alone: where the route follower's room is below `room` m
    (`reference.follow`)."""

    def __init__(self, room: float) -> None:
        self.room = room
        self.planner = SamplingEgo()

    def endangered(self, observation: Tensor) -> Tensor:
        """Rows [b] of observations [B, D] in danger."""
        return (follow(observation)[:, 3] < self.room).nonzero()[:, 0]

    def plans(self, world: World, rows: Tensor) -> Tensor:
        """Planned states [b, PLAN_STEPS, 4] of scenes rows [b]."""
        return self.planner.plan(take(world, rows))

    @torch.no_grad()
    def actions(self, world: World, observation: Tensor, hold: int = 1) -> Tensor:
        """Returns actions [B, 2] (m/s^2, rad/s), the means of `hold` steps of the plan;
        NaN where nobody is in danger."""
        rows = self.endangered(observation)
        actions = torch.full_like(observation[:, :2], torch.nan)
        if len(rows):
            start = world.states[rows, :1]
            driven = torch.cat([start, self.plans(world, rows)[:, :hold]], 1)
            actions[rows] = dynamics.inverse(driven).mean(1)
        return actions


class Evasions(Transform):
    """Writes EVASION [B, 2], `Evader.actions` at every observation, for an actor that
    evades."""

    def __init__(self, evader: Evader, hold: int) -> None:
        """hold: steps of 0.1 s that an action is held."""
        super().__init__()
        self.evader = evader
        self.hold = hold
        self._latest = torch.zeros(0)  # [B, 2], as last written

    def _step(
        self,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
    ) -> TensorDictBase:
        world = self.parent.base_env.world()
        self._latest = self.evader.actions(
            world, next_tensordict["observation"], hold=self.hold
        )
        return next_tensordict.set(EVASION, self._latest)

    def _reset(
        self,
        tensordict: TensorDictBase,
        tensordict_reset: TensorDictBase,
    ) -> TensorDictBase:
        """Asks for the episodes that begin; the others were asked for at their step."""
        observation = tensordict_reset["observation"]
        rows = (tensordict_reset["timestep"][:, 0] == 0).nonzero()[:, 0]
        if len(rows) == len(observation) or not len(self._latest):
            world = self.parent.base_env.world()
            self._latest = self.evader.actions(world, observation, hold=self.hold)
        elif len(rows):
            world = take(self.parent.base_env.world(), rows)
            begun = self.evader.actions(world, observation[rows], hold=self.hold)
            self._latest = self._latest.index_copy(0, rows, begun)
        return tensordict_reset.set(EVASION, self._latest)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declares EVASION."""
        env = self.parent.base_env
        observation_spec[EVASION] = Unbounded((*env.batch_size, 2), device=env.device)
        return observation_spec
