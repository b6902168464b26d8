"""How a few short manoeuvres of the ego would end, if everybody else goes on as it does: part of its observation.

A network that sees poses and speeds alone has to learn geometry before it can learn to evade. Here 15 manoeuvres
(accelerations x offsets from the mission) are laid on the mission, and the nearest agents keep their acceleration and
path curvature for a while (`arc`). Boxes are approximated: the ego by a capsule, the others by three circles.
"""

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.dynamics import HOLD, TURN, Arc, along_arc
from e2rl.sim.static import FrenetPose, StaticScene, look_along

ACCELERATIONS = (-7.0, -3.5, -1.0, 1.0, 3.5)  # m/s^2, held, never backwards
OFFSETS = (-2.5, 0.0, 2.5)  # m to the left of the mission
TIMES = (0.5, 1.0, 1.5, 2.0, 2.6, 3.2)  # s at which gaps are looked at
MOVED_OVER = 1.5  # s until the offset is reached
WIDEST, TIGHT = 3.0, 0.2  # m: larger gaps are alike; a gap that counts as none
SHORTEST = 0.05  # m, half of a capsule's axis at least
PROSPECTS = 2 * len(ACCELERATIONS) * len(OFFSETS)


class Others(NamedTuple):
    """K agents in the frame of B egos: position, direction, half_size [B, 2, K], speed [B, K], arc: how they go on
    (two [B, K]), present [B, K]."""

    position: Tensor
    direction: Tensor
    half_size: Tensor
    speed: Tensor
    arc: Arc
    present: Tensor


class Manoeuvres(NamedTuple):
    """The manoeuvres as tensors: accelerations [A] m/s^2, offsets [O, 1] m, times [T] s, fraction [T] of the offset
    that is reached then, ends [3, 1]: circles of a box along its length."""

    accel: Tensor
    offset: Tensor
    time: Tensor
    fraction: Tensor
    ends: Tensor


@cache
def manoeuvres_on(device: torch.device) -> Manoeuvres:
    """Returns the manoeuvres on a device (cached)."""
    accel, offset, time, ends = (
        torch.tensor(x, device=device) for x in (ACCELERATIONS, OFFSETS, TIMES, (-1.0, 0.0, 1.0))
    )
    fraction = (time / MOVED_OVER).clamp(max=1)
    return Manoeuvres(accel, offset[:, None], time, fraction**2 * (3 - 2 * fraction), ends[:, None])


def travelled(speed: Tensor, accel: Tensor, time: Tensor) -> Tensor:
    """Distance [m] after `time` at constant acceleration, to the halt at most; broadcast."""
    moving = torch.where(accel < 0, torch.minimum(time, speed / (-accel).clamp(min=1e-3)), time)
    return speed * moving + accel * moving**2 / 2


def manoeuvres(static: StaticScene, state: Tensor, pose: FrenetPose, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Places and directions [B, C, T, 2] of egos [B, 4] in their own frames; C: accelerations x offsets."""
    plan = manoeuvres_on(state.device)
    distance = travelled(state[:, 3, None, None], plan.accel[:, None], plan.time)
    xy, heading, *_ = look_along(static, pose.s[:, None] + distance.flatten(1))
    local = (xy - state[:, None, :2]).bmm(rotation.transpose(1, 2)).unflatten(1, distance.shape[1:])[:, :, None]
    turned = (heading - state[:, 2:3]).unflatten(1, distance.shape[1:])[:, :, None]
    along = torch.stack([turned.cos(), turned.sin()], -1)
    across = pose.d[:, None, None] * (1 - plan.fraction) + plan.offset * plan.fraction
    left = torch.stack([-along[..., 1], along[..., 0]], -1)
    place = local + across[:, None, ..., None] * left
    return place.flatten(1, 2), along.expand_as(place).flatten(1, 2)


def later(others: Others, time: Tensor) -> tuple[Tensor, Tensor]:
    """Places and directions [B, T, 2, K] of the others at times [T] s, if they go on along their arcs."""
    speed, none = others.speed, torch.zeros_like(others.speed)
    own, _ = along_arc(torch.stack([none, none, none, speed], -1), others.arc, time, HOLD, TURN)  # [B, K, T, 4]
    ahead, across, heading, _ = own.permute(3, 0, 2, 1)
    cos, sin = heading.cos(), heading.sin()
    x, y = others.direction[:, 0, None], others.direction[:, 1, None]
    moved = torch.stack([x * ahead - y * across, y * ahead + x * across], 2)
    return others.position[:, None] + moved, torch.stack([x * cos - y * sin, y * cos + x * sin], 2)


def gaps(place: Tensor, along: Tensor, size: Tensor, others: Others) -> Tensor:
    """Least gap [B, C, T] m between egos of size [B, 2] at `place`, `along` [B, C, T, 2] and the others then; inf where
    there are none."""
    plan, steps = manoeuvres_on(place.device), place.shape[2]
    if not others.present.shape[1]:
        return place.new_full(place.shape[:3], torch.inf)
    position, direction = (x.flatten(0, 1) for x in later(others, plan.time))  # [B T, 2, K]
    length, width = others.half_size.repeat_interleave(steps, 0).unbind(1)
    shift = (length - width).clamp(min=0)[:, None, None] * plan.ends  # [B T, 1, 3, K]
    centre = (position[:, :, None] + direction[:, :, None] * shift).flatten(2)
    centre = torch.cat([centre, torch.ones_like(centre[:, :1])], 1).transpose(1, 2)  # [B T, 3 K, 3]
    own = (size / 2).repeat_interleave(steps, 0)[..., None, None]
    unit = (own[:, 0] - own[:, 1]).clamp(min=SHORTEST)  # half of the capsule's axis: lengths are in this unit below
    place, along = (x.permute(0, 2, 3, 1).flatten(0, 1) for x in (place, along))  # [B T, 2, C]
    along = along / unit
    across = torch.stack([-along[:, 1], along[:, 0]], 1)
    axes = (torch.cat([axis, -(axis * place).sum(1, True)], 1) for axis in (along, across))  # [B T, 3, C]
    ahead, across = (centre.bmm(axis) for axis in axes)  # [B T, 3 K, C]
    beyond = torch.nn.functional.softshrink(ahead, 1.0)
    front, middle, back = across.square_().addcmul_(beyond, beyond).chunk(3, 1)
    apart = torch.minimum(torch.minimum(front, middle), back).sqrt_().mul_(unit)
    absent = ~others.present.repeat_interleave(steps, 0)[..., None]
    reach = (own[:, 1] + width[..., None]).masked_fill(absent, -torch.inf)
    return apart.sub_(reach).amin(1).unflatten(0, (-1, steps)).transpose(1, 2)


def prospects(static: StaticScene, state: Tensor, pose: FrenetPose, rotation: Tensor, others: Others) -> Tensor:
    """[B, PROSPECTS] of every manoeuvre: its least gap, then the time of its first gap below TIGHT, in [-1/3, 1]."""
    gap, end = gaps(*manoeuvres(static, state, pose, rotation), static.size, others), TIMES[-1] + TIMES[0]
    first = torch.where(gap < TIGHT, manoeuvres_on(gap.device).time, end).amin(-1) / end
    return torch.cat([gap.amin(-1).clamp(-1, WIDEST) / WIDEST, first], -1)


def time_to_contact(observation: Tensor) -> Tensor:
    """Seconds [...] until the ego's first gap below TIGHT if it goes on along its mission, at no more than 1 m/s^2, by
    the prospects at the end of observations [..., D]; more than TIMES[-1] where there is none."""
    first = observation[..., -PROSPECTS // 2 :].unflatten(-1, (len(ACCELERATIONS), len(OFFSETS)))
    mild = [index for index, accel in enumerate(ACCELERATIONS) if abs(accel) <= 1]
    return first[..., mild, OFFSETS.index(0.0)].amax(-1) * (TIMES[-1] + TIMES[0])
