"""Egos that choose among candidates by their cost, and how the candidates rank: soft labels for an imitator."""

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.ego.base import Ego, EgoPolicy
from e2rl.sim import dynamics
from e2rl.sim.world import World


class RankingEgo(Ego):
    """An ego that plans its cheapest candidate and can tell the others' costs."""

    @abstractmethod
    def ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        """Planned states [B, C, PLAN_STEPS, 4] and costs [B, C] of the C = `count` cheapest candidates, the cheapest
        first; inf where there are no more."""


class RankingPolicy(EgoPolicy):
    """A RankingEgo as a TorchRL policy that plans at every decision. Writes "choices" [B, C, 2], the actions of its C
    cheapest candidates in the mean over the decision, their "costs" [B, C], and as "action" [B, 2] the first one."""

    out_keys = ["action", "choices", "costs"]

    def __init__(self, ego: RankingEgo, env, count: int) -> None:
        """env: as of EgoPlanner; count: C."""
        super().__init__(ego, env)
        self.ranking, self.count, self.hold = ego, count, getattr(env, "base_env", env).hold

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = World.of(tensordict, self.scene)
        if bool((world.step == 0).any()):
            self.ego.reset(world)
        states, tensordict["costs"] = self.ranking.ranked(world, self.count)
        now, then = world.states[:, :1].expand_as(states[:, :, 0]), states[:, :, : self.hold]
        choices = dynamics.inverse(torch.cat([now[:, :, None], then], 2)).mean(2)
        tensordict["choices"] = choices.clamp(self.bounds.low[:, None], self.bounds.high[:, None])
        tensordict["action"] = tensordict["choices"][:, 0]
        return tensordict
