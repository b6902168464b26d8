"""Look-up of the drivable field: metres beyond the border of the drivable area (design.md section 5)."""

from torch import Tensor

from e2rl.scene.drivable import CELL, FAR


def off_road(points: Tensor, field: Tensor, origin: Tensor) -> Tensor:
    """Metres [B, ...] that points [B, ..., 2] lie beyond the drivable border; negative inside.

    field [B, G, G]: value at cells of CELL m, first index along x; origin [B, 2]: centre of cell (0, 0). Bilinear
    between cell centres, FAR outside the grid. Differentiable in the points; costs the same wherever they are.
    """
    batch, cells = field.shape[0], field.shape[-1]
    place = (points - origin.view(batch, *[1] * (points.ndim - 2), 2)) / CELL
    outside = ((place < 0) | (place > cells - 1)).any(-1)
    low = place.detach().floor().clamp(0, cells - 2)
    share = (place - low).clamp(0, 1)
    index = (low[..., 0] * cells + low[..., 1]).long().view(batch, -1)
    flat = field.flatten(1)
    v00, v01, v10, v11 = (
        flat.gather(1, index + shift).view(outside.shape).to(points.dtype) for shift in (0, 1, cells, cells + 1)
    )
    sx, sy = share[..., 0], share[..., 1]
    value = (1 - sx) * ((1 - sy) * v00 + sy * v01) + sx * ((1 - sy) * v10 + sy * v11)
    return value.masked_fill(outside, FAR)
