"""A rival that guides the prior in closed loop: whom, by which loss, and which of its samples it drives."""

from abc import abstractmethod
from dataclasses import replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context, Control
from e2rl.rivals.guidance import Loss
from e2rl.rivals.rival import Rival
from e2rl.rivals.samples import folded, motion_of, pick, tiled
from e2rl.rivals.view import View
from e2rl.sim.world import World
from e2rl.traffic.grouping import Group
from e2rl.traffic.traffic import State


class Guided(Rival):
    """Every replan: guided joint samples, of which the one of least `rating` is driven."""

    def attack(
        self, state: State, world: World, ego_plan: Tensor, noise: Tensor, group: Group, context: Context
    ) -> tuple[State, Tensor]:
        """State and chosen joint sample x0 [G, V, SIZE]; scenes without strength keep the nominal one."""
        view, acts, count = View.of(world, context, ego_plan), self.strength(state) > 0, noise.shape[3]
        adversary = self.adversaries(state, view) & acts[:, None]
        state = replace(state, adversary=adversary)
        guided = (context.active if self.guides_everybody else adversary) & acts[:, None]
        control = self.guidance(self.loss(state, view), guided.repeat(count, 1), self.strength(state).repeat(count))
        many = tiled(context, count)
        sample = self.prior.sample(many, folded(noise), control)
        motion = motion_of(self.prior, sample.x0, many, count)
        index = self.chosen(motion, state, view, guided)
        index = index * acts if index.ndim == 1 else index * acts[:, None]
        x0, kl = (pick(value.unflatten(0, (count, -1)), index) for value in (sample.x0, sample.kl))
        return replace(state, path_kl=state.path_kl + kl), x0

    guides_everybody = False  # or adversaries alone

    def chosen(self, motion: LaneState, state: State, view: View, guided: Tensor) -> Tensor:
        """Sample [B] of each scene that is driven: that of least loss over the guided vehicles."""
        return torch.where(guided, self.loss(state, view)(motion), 0.0).sum(-1).argmin(0)

    def adversaries(self, state: State, view: View) -> Tensor:
        """Bool [B, V]: vehicles under adversarial control, all that the prior moves by default."""
        return view.active

    @abstractmethod
    def loss(self, state: State, view: View) -> Loss:
        """The loss of a replan."""

    @abstractmethod
    def guidance(self, loss: Loss, guided: Tensor, strength: Tensor) -> Control:
        """The control of `Prior.sample`; guided [S * B, V] bool, strength [S * B]."""
