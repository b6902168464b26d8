"""Goals beside a mission: a grid of the places that a vehicle may have reached at the end of its plan.

A goal is a way [m] along the mission from the vehicle's present place and a side [m] beside the mission, left positive.
The grid covers the ways up to `reach`, in cells whose length grows with the vehicle's speed.
"""

import torch
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS
from e2rl.scene.recording import DT

HORIZON = PLAN_STEPS * DT  # s
WAYS, SIDES = 32, 7  # cells along the mission and beside it
CELLS = WAYS * SIDES  # G: cell w * SIDES + s
SIDE = 1.0  # m, width of a cell
FASTEST = 2.5  # m/s^2: acceleration over the horizon that leads to the grid's end


def reach(speed: Tensor) -> Tensor:
    """Ways [...] m to the end of the grid from speeds [...] m/s."""
    return HORIZON * speed + FASTEST * HORIZON**2 / 2


def place(speed: Tensor, cell: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Ways and sides [B, K] m of the goals at `cell` [B, K] with residual [B, K, 2], in cells from the cell's centre;
    speed [B] m/s. No way is negative."""
    along = cell.div(SIDES, rounding_mode="floor") + 0.5 + residual[..., 0]
    aside = cell % SIDES - (SIDES - 1) / 2 + residual[..., 1]
    return (along * reach(speed)[:, None] / WAYS).clamp(min=0), aside * SIDE


def cell_of(speed: Tensor, way: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    """The cells [W] of goals way, side [W] m, and their residuals [W, 2]: the inverse of `place`. A goal off the grid
    counts to the nearest cell."""
    along = way / reach(speed) * WAYS - 0.5
    aside = side / SIDE + (SIDES - 1) / 2
    w, s = along.round().clamp(0, WAYS - 1), aside.round().clamp(0, SIDES - 1)
    return (w * SIDES + s).long(), torch.stack([along - w, aside - s], -1)


def needed_acceleration(speed: Tensor, way: Tensor) -> Tensor:
    """The constant acceleration [...] m/s^2 that drives `way` [...] m within the horizon from speed [...] m/s: to its
    end, or to a halt before it."""
    going = 2 * (way - HORIZON * speed) / HORIZON**2
    halting = -speed.square() / (2 * way.clamp(min=0.1))
    return torch.where(way < HORIZON * speed / 2, halting, going)
