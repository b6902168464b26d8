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

from e2rl.sim.dynamics import SLOW, wrap
from e2rl.sim.static import FrenetPose, StaticScene, look_along, seen_from

ACCELERATIONS = (-7.0, -3.5, -1.0, 1.0, 3.5)  # m/s^2, held, never backwards
OFFSETS = (-2.5, 0.0, 2.5)  # m to the left of the mission
TIMES = (0.5, 1.0, 1.5, 2.0, 2.6, 3.2)  # s at which gaps are looked at
MOVED_OVER = 1.5  # s until the offset is reached
HOLD = 1.0  # s for which a seen acceleration is expected to last
TURN = 2.0  # s for which a seen curvature is expected to last
WIDEST = 3.0  # m: larger gaps are alike
TIGHT = 0.2  # m: a gap that counts as none
SHORTEST = 0.05  # m, half of a capsule's axis at least
PROSPECTS = 2 * len(ACCELERATIONS) * len(OFFSETS)


class Arc(NamedTuple):
    """Constant acceleration [...] m/s^2 and path curvature [...] 1/m (left positive):
    how others may go on."""

    accel: Tensor
    curvature: Tensor


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
    numbers = (ACCELERATIONS, OFFSETS, TIMES, (-1.0, 0.0, 1.0))
    accel, offset, time, ends = (torch.tensor(x, device=device) for x in numbers)
    fraction = (time / MOVED_OVER).clamp(max=1)
    return Manoeuvres(
        accel=accel.repeat(len(time)),
        moment=time.repeat_interleave(len(accel)),
        offset=offset[:, None],
        time=time,
        fraction=fraction**2 * (3 - 2 * fraction),
        ends=ends[:, None],
    )


def travelled(speed: Tensor, accel: Tensor, time: Tensor) -> Tensor:
    """Distance [m] after `time` at constant acceleration, to the halt at most;
    broadcast."""
    moving = torch.where(
        accel < 0,
        torch.minimum(time, speed / (-accel).clamp(min=1e-3)),
        time,
    )
    return speed * moving + accel * moving**2 / 2


def manoeuvres(
    static: StaticScene,
    state: Tensor,
    *,
    pose: FrenetPose,
    rotation: Tensor,
) -> Tensor:
    """x, y, cosine and sine of the direction [4, B, T, C] of egos in their own frames;
    C: accelerations x offsets.

    Args:
        static: of the scenes.
        state: [B, 4], of the egos.
        pose: on their missions.
        rotation: [B, 2, 2], into their frames.
    """
    plan = manoeuvres_on(state.device)
    speed = state[:, 3:].clamp(min=0)
    distance = travelled(speed, plan.accel, plan.moment)  # [B, T A]
    ahead = look_along(static, pose.s[:, None] + distance)
    turned = ahead.heading - state[:, 2:3]
    place = seen_from(
        state,
        rotation,
        x=ahead.x,
        y=ahead.y,
    )
    x, y, cos, sin = (
        value.unflatten(1, (len(TIMES), -1))[..., None]
        for value in (*place, turned.cos(), turned.sin())
    )
    lateral = pose.d[:, None, None] * (1 - plan.fraction) + plan.offset * plan.fraction
    across = lateral.transpose(1, 2)[:, :, None]
    places = torch.broadcast_tensors(x - across * sin, y + across * cos, cos, sin)
    return torch.stack(places).flatten(3)


def arc_places(speed: Tensor, arc: Arc, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Metres ahead and to the left, and turn [rad], at `times` s, of who drives on with
    `speed` m/s along an arc; all broadcast.

    The acceleration is held for HOLD s, never beyond a halt; the curvature for the
    distance that the present speed drives in TURN s; then speed and heading stay.
    """
    sign = torch.where(speed < 0, -1.0, 1.0)
    v = speed * sign
    accel = arc.accel * sign
    halt = torch.where(accel < 0, v / (-accel).clamp(min=1e-6), torch.inf)
    held = torch.minimum(times.clamp(max=HOLD), halt)
    end_speed = (v + accel * held).clamp(min=0)
    driven = (v + end_speed) / 2 * held + end_speed * (times - held)
    bent = torch.minimum(driven, TURN * v.clamp(min=SLOW)) * sign
    driven = driven * sign
    turn = arc.curvature * bent
    chord = bent * torch.sinc(turn / (2 * torch.pi))
    middle = turn / 2
    rest = driven - bent
    ahead = chord * middle.cos() + rest * turn.cos()
    left = chord * middle.sin() + rest * turn.sin()
    return ahead, left, wrap(turn)


def later(others: Others, time: Tensor) -> Tensor:
    """x, y, cosine and sine of the direction [4, B, T, K] of others at times [T] s, if
    they go on along their arcs."""
    arc = Arc(*(value[:, None] for value in others.arc))
    ahead, left, turn = arc_places(others.speed[:, None], arc, time[:, None])
    cos = turn.cos()
    sin = turn.sin()
    x, y = others.position[:, :, None].unbind(1)
    ux, uy = others.direction[:, :, None].unbind(1)
    return torch.stack(
        [
            x + (ux * ahead - uy * left),
            y + (uy * ahead + ux * left),
            ux * cos - uy * sin,
            uy * cos + ux * sin,
        ]
    )


def gaps(ego: Tensor, size: Tensor, others: Others) -> Tensor:
    """Least gap [B, T, C] m between egos of size [B, 2] at x, y, cosine, sine [4, B, T,
    C] and the others at the same times."""
    x, y, cos, sin = ego
    plan = manoeuvres_on(x.device)
    place, direction = later(others, plan.time)[..., None, :].chunk(
        2
    )  # [2, B, T, 1, K]
    length, width = others.half_size.unbind(1)
    shift = (length - width).clamp(min=0)[:, None] * plan.ends  # [B, 3, K]
    centre = place + direction * shift[:, None]  # [2, B, T, 3, K]
    half = (size / 2)[:, :, None, None]
    # Half of the capsule's axis: lengths are in this unit below.
    unit = (half[:, 0] - half[:, 1]).clamp(min=SHORTEST)
    cos = cos / unit
    sin = sin / unit
    ahead, across = (
        _along(centre, torch.stack([ux, uy, -(ux * x + uy * y)], 2))
        for ux, uy in ((cos, sin), (-sin, cos))
    )  # [B, T, 3, K, C]
    if torch.compiler.is_compiling():  # in one pass
        beyond = (ahead.abs() - 1).clamp(min=0)
    else:
        beyond = torch.nn.functional.softshrink(ahead, 1.0)
    apart = across.square_().addcmul_(beyond, beyond).amin(2).sqrt_()
    reach = half[:, 1] + width[:, None]
    reach = reach.masked_fill(~others.present[:, None], -torch.inf)
    return apart.mul_(unit[..., None]).sub_(reach[..., None]).amin(2)


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
    *,
    pose: FrenetPose,
    rotation: Tensor,
    others: Others,
) -> Tensor:
    """[B, PROSPECTS] of every manoeuvre: its least gap, then the time of its first gap
    below TIGHT, in [-1/3, 1].

    Args:
        static, state, pose, rotation: of `manoeuvres`.
        others: in the egos' frames.
    """
    ego = manoeuvres(
        static,
        state,
        pose=pose,
        rotation=rotation,
    )
    gap = gaps(ego, static.size, others)
    end = TIMES[-1] + TIMES[0]
    time = manoeuvres_on(gap.device).time[:, None]
    first = torch.where(gap < TIGHT, time, end).amin(1) / end
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
