"""How a few short manoeuvres of the ego would end, if everybody else goes on as it does: part of its observation.

A network that sees poses and speeds alone has to learn geometry before it can learn to evade. Here 15 manoeuvres
(accelerations x offsets from the mission) are laid on the mission, and the nearest agents keep their heading and, for a
second, their acceleration. Boxes are approximated: the ego by a capsule, the others by three circles.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.static import FrenetPose, StaticScene, look_along

ACCELERATIONS = (-7.0, -3.5, -1.0, 1.0, 3.5)  # m/s^2, held, never backwards
OFFSETS = (-2.5, 0.0, 2.5)  # m to the left of the mission
TIMES = (0.5, 1.0, 1.5, 2.0, 2.6, 3.2)  # s at which gaps are looked at
MOVED_OVER = 1.5  # s until the offset is reached
STEADY = 1.0  # s for which others keep their acceleration
WIDEST, TIGHT = 3.0, 0.2  # m: larger gaps are alike; a gap that counts as none
PROSPECTS = 2 * len(ACCELERATIONS) * len(OFFSETS)


class Others(NamedTuple):
    """K agents in the frame of B egos: position, direction, half_size [B, 2, K], speed, accel, present [B, K]."""

    position: Tensor
    direction: Tensor
    half_size: Tensor
    speed: Tensor
    accel: Tensor
    present: Tensor


def travelled(speed: Tensor, accel: Tensor, time: Tensor) -> Tensor:
    """Way [m] after `time` at constant acceleration, to the halt at most; broadcast."""
    moving = torch.where(accel < 0, torch.minimum(time, speed / (-accel).clamp(min=1e-3)), time)
    return speed * moving + accel * moving**2 / 2


def manoeuvres(static: StaticScene, state: Tensor, pose: FrenetPose, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Places and directions [B, C, T, 2] of egos [B, 4] in their own frames; C: accelerations x offsets."""
    accel, offset, time = (torch.tensor(x, device=state.device) for x in (ACCELERATIONS, OFFSETS, TIMES))
    way = travelled(state[:, 3, None, None], accel[:, None], time)
    xy, heading, *_ = look_along(static, pose.s[:, None] + way.flatten(1))
    local = (xy - state[:, None, :2]).bmm(rotation.transpose(1, 2)).unflatten(1, way.shape[1:])[:, :, None]
    turned = (heading - state[:, 2:3]).unflatten(1, way.shape[1:])[:, :, None]
    along = torch.stack([turned.cos(), turned.sin()], -1)
    share = (time / MOVED_OVER).clamp(max=1)
    share = share**2 * (3 - 2 * share)
    aside = pose.d[:, None, None] * (1 - share) + offset[:, None] * share
    left = torch.stack([-along[..., 1], along[..., 0]], -1)
    return (local + aside[:, None, ..., None] * left).flatten(1, 2), along.expand(-1, -1, len(OFFSETS), -1, -1).flatten(
        1, 2
    )


def gaps(place: Tensor, along: Tensor, size: Tensor, others: Others) -> Tensor:
    """Least gap [B, C, T] m between egos of size [B, 2] at `place`, `along` [B, C, T, 2] and the others then; inf where
    there are none."""
    time = torch.tensor(TIMES, device=place.device)[:, None]
    first = time.clamp(max=STEADY)
    speed, accel = others.speed[:, None], others.accel[:, None]
    later = (speed + accel * first).clamp(min=0)
    way = travelled(speed, accel, first) + later * (time - first)  # [B, T, K]
    length, width = others.half_size.unbind(1)
    ends = (length - width).clamp(min=0)[:, None, :, None] * torch.tensor([-1.0, 0.0, 1.0], device=time.device)
    shift = (way[..., None] + ends).flatten(2)  # [B, T, 3 K], along the others' headings
    position, direction = (x.repeat_interleave(3, 2)[:, :, None] for x in (others.position, others.direction))
    centre = (position + direction * shift[:, None]).transpose(1, 2).flatten(0, 1)  # [B T, 2, 3 K]
    place, along = place.transpose(1, 2).flatten(0, 1), along.transpose(1, 2).flatten(0, 1)  # [B T, C, 2]
    across = torch.stack([-along[..., 1], along[..., 0]], -1)
    frame = torch.cat([along, across], 1)
    seen = torch.baddbmm(-(frame * place.repeat(1, 2, 1)).sum(-1, keepdim=True), frame, centre)
    ahead, aside = seen.chunk(2, 1)  # [B T, C, 3 K] m, from the egos
    half = (size / 2).repeat_interleave(len(TIMES), 0)[..., None, None]
    beyond = ahead.abs_().sub_(half[:, 0] - half[:, 1]).clamp_(min=0)
    apart = aside.square_().addcmul_(beyond, beyond).sqrt_()
    reach = width.masked_fill(~others.present, -torch.inf).repeat_interleave(3, 1).repeat_interleave(len(TIMES), 0)
    apart = torch.nn.functional.pad(apart.sub_(reach[:, None]), (0, 1), value=torch.inf).amin(-1) - half[:, 1, 0]
    return apart.unflatten(0, (-1, len(TIMES))).transpose(1, 2)


def prospects(static: StaticScene, state: Tensor, pose: FrenetPose, rotation: Tensor, others: Others) -> Tensor:
    """[B, PROSPECTS] of every manoeuvre: its least gap, then the time of its first gap below TIGHT, in [-1/3, 1]."""
    gap = gaps(*manoeuvres(static, state, pose, rotation), static.size, others)
    time = torch.tensor(TIMES, device=gap.device)
    first = torch.where(gap < TIGHT, time, TIMES[-1] + TIMES[0]).amin(-1) / (TIMES[-1] + TIMES[0])
    return torch.cat([gap.amin(-1).clamp(-1, WIDEST) / WIDEST, first], -1)
