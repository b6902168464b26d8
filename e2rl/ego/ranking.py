"""Egos that choose among candidates by their cost, and how the candidates rank: soft labels for an imitator."""

from abc import abstractmethod

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.sim import dynamics
from e2rl.sim.world import World


class RankingEgo(Ego):
    """An ego that plans its cheapest candidate and can tell the others' costs."""

    @abstractmethod
    def ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        """Planned states [B, C, PLAN_STEPS, 4] and costs [B, C] of the C = `count` cheapest candidates, the cheapest
        first; inf where there are no more."""

    @abstractmethod
    def rated(self, world: World, states: Tensor) -> Tensor:
        """Costs [B, C], in the same units, of driving along states [B, C, PLAN_STEPS, 4] that somebody else plans."""


def ranked_actions(ego: RankingEgo, world: World, count: int, hold: int) -> tuple[Tensor, Tensor]:
    """Actions [B, C, 2] (m/s^2, rad/s) of the C = `count` cheapest candidates, in the mean over the coming `hold`
    steps, and their costs [B, C]."""
    states, costs = ego.ranked(world, count)
    now = world.states[:, None, :1].expand_as(states[:, :, :1])
    return dynamics.inverse(torch.cat([now, states[:, :, :hold]], 2)).mean(2), costs
