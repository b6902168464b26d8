"""Look-up of the drivable field: metres beyond the border of the drivable area (docs/method.md, section 1)."""

import torch
from torch import Tensor

from e2rl.scene.drivable import CELL, FAR


def off_road(points: Tensor, field: Tensor, origin: Tensor) -> Tensor:
    """Metres [B, ...] that points [B, ..., 2] lie beyond the drivable border; negative inside.

    field [B, G, G]: value at cells of CELL m, first index along x; origin [B, 2]: centre of cell (0, 0). Bilinear
    between cell centres, FAR outside the grid. Differentiable in the points; the cost does not depend on them.
    """
    batch, cells = field.shape[0], field.shape[-1]
    cell = (points - origin.view(batch, *[1] * (points.ndim - 2), 2)) / CELL
    outside = ((cell < 0) | (cell > cells - 1)).any(-1)
    low = cell.detach().floor().clamp(0, cells - 2)
    share = (cell - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long()
    four = index[..., None] + torch.arange(2, device=index.device) * cells  # rows x and x + 1 of the cell
    four = four[..., None] + torch.arange(2, device=index.device)
    value = field.flatten(1).gather(1, four.view(batch, -1)).view(four.shape).to(points.dtype)
    sx, sy = share[..., 0], share[..., 1:]
    value = (1 - sy) * value[..., 0] + sy * value[..., 1]
    return ((1 - sx) * value[..., 0] + sx * value[..., 1]).masked_fill(outside, FAR)
