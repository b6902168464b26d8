"""How a few short manoeuvres of the ego would end, if all others keep their motion:
part of its observation.

A network that sees poses and speeds alone has to learn geometry before it can learn to
evade. Here 15 manoeuvres (accelerations x offsets from the mission) are laid on the
mission, and the nearest agents keep their acceleration and path curvature for a while
(`arc`). Boxes are approximated: the ego by a capsule, the others by three circles.
"""

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.dynamics import HOLD, TURN, Arc, arc_places
from e2rl.sim.static import FrenetPose, StaticScene, look_along, seen_from

ACCELERATIONS = (-7.0, -3.5, -1.0, 1.0, 3.5)  # m/s^2, held, never backwards
OFFSETS = (-2.5, 0.0, 2.5)  # m to the left of the mission
TIMES = (0.5, 1.0, 1.5, 2.0, 2.6, 3.2)  # s at which gaps are looked at
MOVED_OVER = 1.5  # s until the offset is reached
WIDEST, TIGHT = 3.0, 0.2  # m: larger gaps are alike; a gap that counts as none
SHORTEST = 0.05  # m, half of a capsule's axis at least
PROSPECTS = 2 * len(ACCELERATIONS) * len(OFFSETS)


class Others(NamedTuple):
    """K agents in the frame of B egos: position, direction, half_size [B, 2, K], speed
    [B, K], arc: how they go on (two [B, K]), present [B, K]."""

    position: Tensor
    direction: Tensor
    half_size: Tensor
    speed: Tensor
    arc: Arc
    present: Tensor


class Manoeuvres(NamedTuple):
    """The manoeuvres as tensors: accelerations m/s^2 and times s [T A], offsets [O, 1]
    m, time [T] s, fraction [T] of the offset that is reached then, ends [3, 1]: circles
    of a box along its length."""

    accel: Tensor
    moment: Tensor
    offset: Tensor
    time: Tensor
    fraction: Tensor
    ends: Tensor


@cache
def manoeuvres_on(device: torch.device) -> Manoeuvres:
    """Returns the manoeuvres on a device (cached)."""
    accel, offset, time, ends = (
        torch.tensor(x, device=device)
        for x in (ACCELERATIONS, OFFSETS, TIMES, (-1.0, 0.0, 1.0))
    )
    fraction = (time / MOVED_OVER).clamp(max=1)
    every = accel.repeat(len(time)), time.repeat_interleave(len(accel))
    return Manoeuvres(
        *every, offset[:, None], time, fraction**2 * (3 - 2 * fraction), ends[:, None]
    )


def travelled(speed: Tensor, accel: Tensor, time: Tensor) -> Tensor:
    """Distance [m] after `time` at constant acceleration, to the halt at most;
    broadcast."""
    moving = torch.where(
        accel < 0, torch.minimum(time, speed / (-accel).clamp(min=1e-3)), time
    )
    return speed * moving + accel * moving**2 / 2


def manoeuvres(
    static: StaticScene, state: Tensor, pose: FrenetPose, rotation: Tensor
) -> Tensor:
    """x, y, cosine and sine of the direction [4, B, T, C] of egos [B, 4] in their own
    frames; C: accelerations x offsets."""
    plan = manoeuvres_on(state.device)
    distance = travelled(
        state[:, 3:].clamp(min=0), plan.accel, time=plan.moment
    )  # [B, T A]
    ahead = look_along(static, pose.s[:, None] + distance)
    turned = ahead.heading - state[:, 2:3]
    place = seen_from(state, rotation, x=ahead.x, y=ahead.y)
    places = (*place, turned.cos(), turned.sin())
    x, y, cos, sin = (
        value.unflatten(1, (len(TIMES), -1))[..., None] for value in places
    )
    across = (
        pose.d[:, None, None] * (1 - plan.fraction) + plan.offset * plan.fraction
    ).transpose(1, 2)[:, :, None]
    found = torch.broadcast_tensors(x - across * sin, y + across * cos, cos, sin)
    return torch.stack(found).flatten(3)


def later(others: Others, time: Tensor) -> Tensor:
    """x, y, cosine and sine of the direction [4, B, T, K] of others at times [T] s, if
    they go on along their arcs."""
    arc = Arc(*(value[:, None] for value in others.arc))
    speed = others.speed[:, None]
    none = torch.zeros_like(speed)
    ahead, across, heading, *_ = arc_places(
        none,
        none,
        heading=none,
        v=speed,
        arc=arc,
        times=time[:, None],
        hold=HOLD,
        turn=TURN,
    )
    cos = heading.cos()
    sin = heading.sin()
    (x, y), (ux, uy) = (
        value[:, :, None].unbind(1) for value in (others.position, others.direction)
    )
    place = x + (ux * ahead - uy * across), y + (uy * ahead + ux * across)
    return torch.stack([*place, ux * cos - uy * sin, uy * cos + ux * sin])


def gaps(ego: Tensor, size: Tensor, others: Others) -> Tensor:
    """Least gap [B, T, C] m between egos of size [B, 2] at x, y, cosine, sine [4, B, T,
    C] and the others then; inf where there are none."""
    x, y, cos, sin = ego
    plan = manoeuvres_on(x.device)
    if not others.present.shape[1]:
        return torch.full_like(x, torch.inf)
    place, direction = later(others, plan.time)[..., None, :].chunk(
        2
    )  # [2, B, T, 1, K]
    length, width = others.half_size.unbind(1)
    shift = (length - width).clamp(min=0)[:, None] * plan.ends  # [B, 3, K]
    own = (size / 2)[:, :, None, None]
    unit = (own[:, 0] - own[:, 1]).clamp(
        min=SHORTEST
    )  # half of the capsule's axis: lengths are in this unit below
    cos = cos / unit
    sin = sin / unit
    centre = place + direction * shift[:, None]  # [2, B, T, 3, K]
    axes = (
        torch.stack([*axis, -(axis[0] * x + axis[1] * y)], 2)
        for axis in ((cos, sin), (-sin, cos))
    )
    ahead, across = (_along(centre, axis) for axis in axes)  # [B, T, 3, K, C]
    if torch.compiler.is_compiling():  # in one pass
        beyond = (ahead.abs() - 1).clamp(min=0)
    else:
        beyond = torch.nn.functional.softshrink(ahead, 1.0)
    apart = (
        across.square_().addcmul_(beyond, beyond).amin(2).sqrt_().mul_(unit[..., None])
    )
    reach = (own[:, 1] + width[:, None]).masked_fill(
        ~others.present[:, None], -torch.inf
    )
    return apart.sub_(reach[..., None]).amin(2)


def _along(points: Tensor, axes: Tensor) -> Tensor:
    """How far points [2, B, T, 3, K] are along axes [B, T, 3, C] (direction, minus what
    the ego's place is): [B, T, 3, K, C]."""
    x, y = points
    if torch.compiler.is_compiling():
        ux, uy, rest = axes[:, :, None, None].unbind(-2)
        return x[..., None] * ux + y[..., None] * uy + rest
    rows = (
        torch.stack([x, y, torch.ones_like(x)], -1).flatten(2, 3).flatten(0, 1)
    )  # [B T, 3 K, 3]
    return rows.bmm(axes.flatten(0, 1)).view(*x.shape, -1)


def prospects(
    static: StaticScene,
    state: Tensor,
    pose: FrenetPose,
    rotation: Tensor,
    others: Others,
) -> Tensor:
    """[B, PROSPECTS] of every manoeuvre: its least gap, then the time of its first gap
    below TIGHT, in [-1/3, 1]."""
    gap = gaps(
        manoeuvres(static, state, pose=pose, rotation=rotation),
        static.size,
        others=others,
    )
    end = TIMES[-1] + TIMES[0]
    first = (
        torch.where(gap < TIGHT, manoeuvres_on(gap.device).time[:, None], end).amin(1)
        / end
    )
    return torch.cat([gap.amin(1).clamp(-1, WIDEST) / WIDEST, first], -1)


def time_to_contact(observation: Tensor) -> Tensor:
    """Seconds [...] until the ego's first gap below TIGHT if it goes on along its
    mission, at no more than 1 m/s^2, by the prospects at the end of observations [...,
    D]; more than TIMES[-1] where there is none."""
    first = observation[..., -PROSPECTS // 2 :].unflatten(
        -1, (len(ACCELERATIONS), len(OFFSETS))
    )
    mild = [index for index, accel in enumerate(ACCELERATIONS) if abs(accel) <= 1]
    return first[..., mild, OFFSETS.index(0.0)].amax(-1) * (TIMES[-1] + TIMES[0])
