"""What the losses of the rivals see besides a plan: the scene as it is at a replan, and the ego's known motion."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context
from e2rl.prior.routed import RoutedScene
from e2rl.sim.world import World
from e2rl.synthesizer.potentials import SAMPLED_STEPS


@dataclass(frozen=True)
class View:
    """B scenes at a replan: states [B, V, 4] now, valid and active [B, V] (active: moved by the prior), size [B, V, 2],
    ego [B, T, 4]: its known motion at SAMPLED_STEPS; lane [B, V]: states on the routes of `routed`."""

    scene: TensorDictBase
    states: Tensor
    valid: Tensor
    active: Tensor
    size: Tensor
    ego: Tensor
    routed: RoutedScene
    lane: LaneState

    @classmethod
    def of(cls, world: World, context: Context, ego_plan: Tensor) -> "View":
        """The View of a group at a replan."""
        vehicles = context.active.shape[1]
        now = world.states[:, :vehicles], world.valid[:, :vehicles], context.active, world.scene["size"][:, :vehicles]
        return cls(world.scene, *now, ego_plan[:, SAMPLED_STEPS].detach(), context.routed, context.state)

    def with_ego(self, motion: LaneState) -> Tensor:
        """States [S, B, V, T, 4] of a motion, fields [S, B, V, T], with the ego's known motion in row 0."""
        states = motion.states()
        ego = self.ego[:, None].expand(states.shape[0], -1, -1, -1, -1)
        return torch.cat([ego, states[:, :, 1:]], 2)

    def distance_to_ego(self) -> Tensor:
        """Metres [B, V] between each active vehicle and the ego now, centre to centre; inf for others."""
        distance = (self.states[..., :2] - self.states[:, :1, :2]).norm(dim=-1)
        return distance.masked_fill(~self.active, torch.inf)
