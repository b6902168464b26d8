"""Look-up of the drivable field: metres beyond the border of the drivable area (docs/method.md, section 1)."""

import torch
from torch import Tensor

from e2rl.scene.drivable import CELL, FAR


def off_road(points: Tensor, field: Tensor, origin: Tensor, row: Tensor | None = None) -> Tensor:
    """Metres [B, ...] that points [B, ..., 2] lie beyond the drivable border; negative inside.

    field [B, G, G]: value at cells of CELL m, first index along x; origin [B, 2]: centre of cell (0, 0). Bilinear
    between cell centres, FAR outside the grid. row [B] int64: which rows of larger field and origin the points are on;
    default: each its own. Differentiable in the points; the cost does not depend on them.
    """
    batch, cells = len(points), field.shape[-1]
    origin = origin if row is None else origin[row]
    cell = (points - origin.view(batch, *[1] * (points.ndim - 2), 2)) / CELL
    outside = ((cell < 0) | (cell > cells - 1)).any(-1)
    low = cell.detach().floor().clamp(0, cells - 2)
    share = (cell - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long()
    four = index[..., None] + torch.arange(2, device=index.device) * cells  # rows x and x + 1 of the cell
    four = four[..., None] + torch.arange(2, device=index.device)
    if row is None:
        value = field.flatten(1).gather(1, four.view(batch, -1))
    else:  # without a copy of the fields
        value = field.flatten().take(four.view(batch, -1) + row[:, None] * cells**2)
    value = value.view(four.shape).to(points.dtype)
    sx, sy = share[..., 0], share[..., 1:]
    value = (1 - sy) * value[..., 0] + sy * value[..., 1]
    return ((1 - sx) * value[..., 0] + sx * value[..., 1]).masked_fill(outside, FAR)
