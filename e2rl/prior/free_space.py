"""Free-space plans, for vehicles without a lane: the same x, read as accelerations and
path curvatures.

The acceleration knots mean what they mean on a route. The two lateral knots are
curvatures of the driven path, half way along and at the end of the lateral horizon:
linear in between, from the current curvature on, and held after the end.
"""

import torch
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import (
    ACCEL_SCALE,
    KNOTS,
    SIZE,
    LaneState,
    lateral_horizon,
    ridge,
    select,
    speeds,
)
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

YAW_RATE_SCALE = 0.1  # rad/s a unit of x, at the current speed or 3 m/s
DAMPING = 1e-3  # ridge on fitted lateral knots
LARGEST = 6.0  # fitted lateral knot


def curvature_scale(v: Tensor) -> Tensor:
    """1/m a unit of x at speed v."""
    return YAW_RATE_SCALE / v.clamp(min=3.0)


def _segments(travelled: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shares of the first and the second half of the lateral horizon that are driven,
    and the metres beyond it."""
    u = (2 * travelled / reach).clamp(max=2.0)
    return u.clamp(max=1.0), (u - 1).clamp(min=0.0), (travelled - reach).clamp(min=0)


def decode(x: Tensor, state: LaneState) -> LaneState:
    """Planned motion (fields [..., V, HORIZON]) of x [..., V, SIZE], by integrating
    curvature over travelled distance.

    Of the Frenet fields, s advances with the travelled distance, d is held, d1 and d2
    are 0.
    """
    v, travelled = speeds(state, ACCEL_SCALE * x[..., :KNOTS])
    begin = state.map(lambda value: value[..., None])
    scale = curvature_scale(begin.v)
    reach = lateral_horizon(begin.v)
    half = scale * x[..., KNOTS, None]
    end = scale * x[..., KNOTS + 1, None]
    first, second, beyond = _segments(travelled, reach)
    kappa = begin.kappa + (half - begin.kappa) * first + (end - half) * second
    of_first = begin.kappa * first + (half - begin.kappa) * first**2 / 2
    turned = 0.5 * reach * (of_first + half * second + (end - half) * second**2 / 2)
    heading = begin.heading + turned + end * beyond
    before = torch.cat([begin.heading, heading[..., :-1]], -1)
    step = torch.diff(
        travelled,
        dim=-1,
        prepend=torch.zeros_like(travelled[..., :1]),
    )
    middle = (heading + before) / 2
    zero = torch.zeros_like(v)
    return LaneState(
        s=begin.s + travelled,
        d=begin.d + zero,
        d1=zero,
        d2=zero,
        v=v,
        a=(v - torch.cat([begin.v, v[..., :-1]], -1)) / DT,
        x=begin.x + (step * torch.cos(middle)).cumsum(-1),
        y=begin.y + (step * torch.sin(middle)).cumsum(-1),
        heading=heading,
        kappa=kappa,
    )


@fused(f"B V {SIZE}", "B V", "B V P 2!", "B V:bool")
def decode_plans(
    x: Tensor,
    state: LaneState,
    points: Tensor,
    on_lane: Tensor,
) -> LaneState:
    """Planned motion, fields [B, V, HORIZON], of every vehicle.

    Args:
        x: [B, V, SIZE].
        state: fields [B, V], where the motion begins.
        points: [B, V, P, 2] m, routes.
        on_lane: [B, V] bool, who drives on its route; the others do in free space.
    """
    return select(on_lane, lane_relative.decode(x, state, points), decode(x, state))


def fit(
    heading: Tensor,
    known: Tensor,
    *,
    state: LaneState,
    knots: Tensor,
) -> Tensor:
    """Lateral knots [..., V, 2] whose path has the recorded headings, by ridge least
    squares.

    The heading is linear in the curvature knots once the travelled distance is known.

    Args:
        heading: [..., V, HORIZON] rad.
        known: [..., V, HORIZON], 1 where it is, else 0.
        state: fields [..., V], where the motion begins.
        knots: [..., V, KNOTS] m/s^2, accelerations.
    """
    _, travelled = speeds(state, knots)
    reach = lateral_horizon(state.v)[..., None]
    first, second, beyond = _segments(travelled, reach)
    scale = curvature_scale(state.v)[..., None]
    half = 0.5 * reach * (first**2 / 2 + second - second**2 / 2)
    end = 0.5 * reach * second**2 / 2 + beyond
    base = 0.5 * reach * state.kappa[..., None] * (first - first**2 / 2)
    turn = wrap(heading - state.heading[..., None])
    unit = torch.stack([scale * half, scale * end], -1) * known[..., None]
    damping = DAMPING * torch.eye(2, device=unit.device)
    return ridge(unit, (turn - base) * known, damping).clamp(-LARGEST, LARGEST)
