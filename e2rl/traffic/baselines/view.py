"""What the losses of the baselines see besides a plan: the scene as it is at a replan,
the ego's known motion and the attack.

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
from e2rl.traffic.grouping import mapped
from e2rl.traffic.nominal import Replan
from e2rl.traffic.potentials import SAMPLED_STEPS


@dataclass(frozen=True)
class View:
    """B scenes at a replan: states [B, V, 4] now, valid and active [B, V] (active:
    moved by the prior), size [B, V, 2], ego [B, T, 4]: its known motion at
    SAMPLED_STEPS; lane [B, V]: states on the routes of `routed`; strength [B]: of the
    attack, by adversary [B, V]."""

    scene: TensorDictBase
    states: Tensor
    valid: Tensor
    active: Tensor
    size: Tensor
    ego: Tensor
    routed: RoutedScene
    lane: LaneState
    strength: Tensor
    adversary: Tensor

    @classmethod
    def of(
        cls,
        replan: Replan,
        context: Context,
        strength: Tensor,
    ) -> "View":
        """The View of a group at a replan, without an adversary."""
        world = replan.world
        vehicles = context.active.shape[1]
        return cls(
            scene=world.scene,
            states=world.states[:, :vehicles],
            valid=world.valid[:, :vehicles],
            active=context.active,
            size=world.scene["size"][:, :vehicles],
            ego=replan.ego_plan[:, SAMPLED_STEPS].detach(),
            routed=context.routed,
            lane=context.state,
            strength=strength,
            adversary=torch.zeros_like(context.active),
        )

    def with_ego(self, motion: LaneState) -> Tensor:
        """States [S, B, V, T, 4] of a motion, fields [S, B, V, T], with the ego's known
        motion in row 0."""
        states = motion.states()
        ego = self.ego[:, None].expand(len(states), -1, -1, -1, -1)
        return torch.cat([ego, states[:, :, 1:]], 2)

    def distance_to_ego(self) -> Tensor:
        """Metres [B, V] between each active vehicle and the ego now, centre to centre;
        inf for others."""
        distance = (self.states[..., :2] - self.states[:, :1, :2]).norm(dim=-1)
        return distance.masked_fill(~self.active, torch.inf)


def tiled(context: Context, count: int) -> Context:
    """The Context of scenes [B] `count` times along the batch, [count * B]."""
    if count == 1:
        return context
    return mapped(context, lambda value: value.repeat(count, *[1] * (value.ndim - 1)))


def folded(noise: Tensor) -> Tensor:
    """Noise [K, B, V, S, SIZE] of S samples as [K, S * B, V, SIZE], the order of
    `tiled`."""
    return noise.permute(0, 3, 1, 2, 4).flatten(1, 2)


def motion_of(
    prior: Prior,
    x0: Tensor,
    *,
    context: Context,
    batch: int,
    steps: slice = SAMPLED_STEPS,
) -> LaneState:
    """Returns a planned motion, fields [S, B, V, T].

    Args:
        prior: decodes it.
        x0: [S * B, V, SIZE].
        context: of S * B scenes.
        batch: B.
        steps: of the plan.
    """
    motion = prior.decode(x0, context, steps=steps)
    return motion.map(lambda value: value.unflatten(0, (-1, batch)))


def pick(values: Tensor, index: Tensor) -> Tensor:
    """values [S * B, V, ...] at sample index [B] of each scene or [B, V] of each
    vehicle -> [B, V, ...]."""
    values = values.unflatten(0, (-1, len(index)))
    scene = torch.arange(len(index), device=index.device)
    if index.ndim == 1:
        return values[index, scene]
    vehicle = torch.arange(index.shape[1], device=index.device)
    return values[index, scene[:, None], vehicle]
