"""What the losses of the baselines see besides a plan: the scene as it is at a replan,
and the ego's known motion.

Several joint samples of the same scenes: S of them along the batch, and back to [S, B,
...].
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context, Prior
from e2rl.prior.routes import RoutedScene
from e2rl.sim.world import World
from e2rl.traffic.grouping import mapped
from e2rl.traffic.potentials import SAMPLED_STEPS


@dataclass(frozen=True)
class View:
    """B scenes at a replan: states [B, V, 4] now, valid and active [B, V] (active:
    moved by the prior), size [B, V, 2], ego [B, T, 4]: its known motion at
    SAMPLED_STEPS; lane [B, V]: states on the routes of `routed`."""

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
        now = (
            world.states[:, :vehicles],
            world.valid[:, :vehicles],
            context.active,
            world.scene["size"][:, :vehicles],
        )
        return cls(
            world.scene,
            *now,
            ego_plan[:, SAMPLED_STEPS].detach(),
            context.routed,
            context.state,
        )

    def with_ego(self, motion: LaneState) -> Tensor:
        """States [S, B, V, T, 4] of a motion, fields [S, B, V, T], with the ego's known
        motion in row 0."""
        states = motion.states()
        ego = self.ego[:, None].expand(states.shape[0], -1, -1, -1, -1)
        return torch.cat([ego, states[:, :, 1:]], 2)

    def distance_to_ego(self) -> Tensor:
        """Metres [B, V] between each active vehicle and the ego now, centre to centre;
        inf for others."""
        distance = (self.states[..., :2] - self.states[:, :1, :2]).norm(dim=-1)
        return distance.masked_fill(~self.active, torch.inf)


def tiled(context: Context, count: int) -> Context:
    """The Context of scenes [B] `count` times along the batch, [count * B]."""
    return (
        context
        if count == 1
        else mapped(context, lambda value: value.repeat(count, *[1] * (value.ndim - 1)))
    )


def folded(noise: Tensor) -> Tensor:
    """Noise [K, B, V, S, SIZE] of S samples as [K, S * B, V, SIZE], the order of
    `tiled`."""
    return noise.permute(0, 3, 1, 2, 4).flatten(1, 2)


def motion_of(
    prior: Prior, x0: Tensor, context: Context, count: int, steps: slice = SAMPLED_STEPS
) -> LaneState:
    """Planned motion of x0 [count * B, V, SIZE], fields [count, B, V, T] at `steps` of
    the plan."""
    return prior.decode(x0, context, steps=steps).map(
        lambda value: value.unflatten(0, (count, -1))
    )


def pick(values: Tensor, index: Tensor) -> Tensor:
    """values [S, B, V, ...] at sample index [B] of each scene or [B, V] of each vehicle
    -> [B, V, ...]."""
    index = index[:, None].expand(values.shape[1:3]) if index.ndim == 1 else index
    index = index.reshape(1, *index.shape, *[1] * (values.ndim - 3)).expand(
        1, *values.shape[1:]
    )
    return values.gather(0, index)[0]
