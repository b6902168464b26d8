"""The others as the ego of a scene has them around it, everybody of a batch in one pass; agents along the last axis."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.setting import Setting


class Around(NamedTuple):
    """local [B, 2, M]: x forward and y left of the ego [m]; direction [B, 2, M]: cosine and sine of the turn from its
    heading; gap [B, M]: `boxes.separation` [m]; speed, accel [B, M]; present [B, M] bool."""

    local: Tensor
    direction: Tensor
    gap: Tensor
    speed: Tensor
    accel: Tensor
    present: Tensor


def axes(ego: Tensor) -> Tensor:
    """[B, 2, 2] that turns vectors into the frame of ego [B, 4]."""
    cos, sin = ego[:, 2].cos(), ego[:, 2].sin()
    return torch.stack([cos, sin, -sin, cos], -1).view(-1, 2, 2)


def look_around(ego: Tensor, turn: Tensor, setting: Setting, states: Tensor, present: Tensor, accel: Tensor) -> Around:
    """Others' states [B, M, 4], present [B, M], accel [B, M] seen from ego [B, 4] with turn = axes(ego)."""
    x, y, heading, speed = states.unbind(-1)
    poses = torch.stack([x - ego[:, :1], heading.cos(), y - ego[:, 1:2], heading.sin()], 1)
    seen = turn.bmm(poses.view(len(ego), 2, -1)).view(len(ego), 2, 2, -1)
    local, direction = seen.unbind(2)
    gap = gap_around(local, direction, setting.size[..., None] / 2, setting.half)
    return Around(local, direction, gap, speed, accel, present)


def gap_around(local: Tensor, direction: Tensor, own: Tensor, half: Tensor) -> Tensor:
    """`boxes.separation` [B, M] of a box of half size own [B, 2, 1] from boxes of half sizes half [B, 2, M] at
    local, direction [B, 2, M] in its frame."""
    size = direction.abs()
    size = torch.stack([size, size.flip(1)], 1)  # rows: what of a box's length and width reaches along the other's axes
    from_own = local.abs() - own - (size * half[:, None]).sum(2)
    ahead = (local * direction).sum(1)
    aside = local[:, 1] * direction[:, 0] - local[:, 0] * direction[:, 1]
    from_other = torch.stack([ahead, aside], 1).abs() - half - (size * own[:, None]).sum(2)
    return torch.maximum(from_own, from_other).amax(1)
