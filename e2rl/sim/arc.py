"""Motion at constant acceleration and path curvature, in closed form: how others are expected to go on."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.sim.dynamics import wrap

HOLD, TURN = 1.0, 2.0  # s for which a seen acceleration and a seen curvature are expected to last
SLOW = 1.0  # m/s below which a turn rate says little of the path's curvature
SHARPEST = 0.12  # 1/m, of a path that is expected of a vehicle


class Arc(NamedTuple):
    """Constant acceleration [...] m/s^2 and path curvature [...] 1/m (left positive)."""

    accel: Tensor
    curvature: Tensor


def curvature_of(turn_rate: Tensor, speed: Tensor) -> Tensor:
    """Path curvature [...] 1/m of vehicles that turn with turn_rate [...] rad/s at speed [...] m/s."""
    return (turn_rate / speed.clamp(min=SLOW)).clamp(-SHARPEST, SHARPEST)


def along_arc(
    states: Tensor, arc: Arc, times: Tensor, hold: float = torch.inf, turn: float = torch.inf
) -> tuple[Tensor, Tensor]:
    """States [..., T, 4] and metres driven [..., T] at times [..., T] s ahead of states [..., 4].

    The acceleration [...] is held for `hold` s, never beyond a halt; the curvature [...] for the way that the present
    speed drives in `turn` s; then speed and heading stay.
    """
    x, y, heading, v = (value[..., None] for value in states.unbind(-1))
    accel, curvature = arc.accel[..., None], arc.curvature[..., None]
    halt = torch.where(accel < 0, v / (-accel).clamp(min=1e-6), torch.inf)
    held = torch.minimum(times.clamp(max=hold), halt)
    speed = (v + accel * held).clamp(min=0)
    driven = (v + speed) / 2 * held + speed * (times - held)
    bent = driven if turn == torch.inf else torch.minimum(driven, turn * v.clamp(min=SLOW))
    angle = curvature * bent
    chord, middle, end = bent * torch.sinc(angle / (2 * torch.pi)), heading + angle / 2, heading + angle
    x, y = x + chord * middle.cos(), y + chord * middle.sin()
    if turn < torch.inf:
        x, y = x + (driven - bent) * end.cos(), y + (driven - bent) * end.sin()
    return torch.stack([x, y, wrap(end), speed.expand_as(x)], -1), driven
