"""The other agents in the ego's frame, for a batch of scenes in one pass; agents are on the last axis."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.trajectories import Agents


class Neighbours(NamedTuple):
    """M other agents of B egos.

    position [B, 2, M]: m forward and left of the ego; direction [B, 2, M]: cosine and sine of the heading relative to
    the ego's; gap [B, M]: box separation [m] (`separation` of two boxes); agents: what they are in the world.
    """

    position: Tensor
    direction: Tensor
    gap: Tensor
    agents: Agents


def rotation_into(ego: Tensor) -> Tensor:
    """Rotation [B, 2, 2] that turns world vectors into the frame of the ego states [B, 4]."""
    cos, sin = ego[:, 2].cos(), ego[:, 2].sin()
    return torch.stack([cos, sin, -sin, cos], -1).view(-1, 2, 2)


def neighbours_of(ego: Tensor, rotation: Tensor, size: Tensor, half_size: Tensor, agents: Agents) -> Neighbours:
    """Neighbours of egos [B, 4] among M agents.

    rotation: `rotation_into(ego)`; size [B, 2]: length and width of the egos; half_size [B, 2, M]: of the agents.
    """
    x, y, heading, _ = agents.states.unbind(-1)
    poses = torch.stack([x - ego[:, :1], heading.cos(), y - ego[:, 1:2], heading.sin()], 1)
    seen = rotation.bmm(poses.view(len(ego), 2, -1)).view(len(ego), 2, 2, -1)
    position, direction = seen.unbind(2)
    gap = separation_in_frame(position, direction, size[..., None] / 2, half_size)
    return Neighbours(position, direction, gap, agents)


def separation_in_frame(position: Tensor, direction: Tensor, own: Tensor, half_size: Tensor) -> Tensor:
    """Box separation [B, M] of a box at the origin from boxes at `position`, `direction` [B, 2, M] in its frame.

    own [B, 2, 1], half_size [B, 2, M]: half lengths and widths. The separating axis theorem, as in `separation`.
    """
    size = direction.abs()
    size = torch.stack([size, size.flip(1)], 1)  # rows: extent of a box's length and width along the other's axes
    from_own = position.abs() - own - (size * half_size[:, None]).sum(2)
    ahead = (position * direction).sum(1)
    aside = position[:, 1] * direction[:, 0] - position[:, 0] * direction[:, 1]
    from_other = torch.stack([ahead, aside], 1).abs() - half_size - (size * own[:, None]).sum(2)
    return torch.maximum(from_own, from_other).amax(1)
