"""A broad phase with buckets: which of many items may lie at which of many points, without comparing all of them.

Items cover ranges of integer cells (rows, or a grid), a point lies in one cell; the answer is the list of candidate
(point, item) pairs. All steps are sorts and gathers over flat lists: no loop, no padding to the fullest cell.
"""

import torch
from torch import Tensor


def ragged(counts: Tensor) -> tuple[Tensor, Tensor]:
    """(group, index within it), each [counts.sum()], of groups with counts [n] int64 members."""
    group = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    start = counts.cumsum(0) - counts
    return group, torch.arange(len(group), device=counts.device) - start[group]


def candidates(
    points: Tensor, point_group: Tensor, low: Tensor, high: Tensor, item_group: Tensor, cell: float
) -> tuple[Tensor, Tensor]:
    """Pairs (point index, item index) of the same group that share a cell.

    points [n, D] m, their groups [n] int64 >= 0; items with bounds low, high [m, D] m, their groups [m]; cell size [m].
    Every point inside an item's bounds [low, high] is among the pairs; each pair occurs once.
    """
    empty = points.new_zeros(0, dtype=torch.int64)
    if not len(points) or not len(low):
        return empty, empty
    origin = points.amin(0)
    cells = ((points - origin) / cell).floor().long()
    extent = cells.amax(0) + 1
    first = ((low - origin) / cell).floor().long().clamp(min=0)
    last = torch.minimum(((high - origin) / cell).floor().long(), extent - 1)
    span = (last - first + 1).clamp(min=0)
    item, index = ragged(span.prod(-1))  # an item wholly outside the points' extent covers no cell
    covered = []
    for axis in range(points.shape[1]):
        covered.append(first[item, axis] + index % span[item, axis])
        index = index // span[item, axis]
    item_key, order = cell_key(item_group[item], torch.stack(covered, -1), extent).sort()
    point_key = cell_key(point_group, cells, extent)
    begin = torch.searchsorted(item_key, point_key)
    point, index = ragged(torch.searchsorted(item_key, point_key, right=True) - begin)
    return point, item[order[begin[point] + index]]


def cell_key(group: Tensor, cells: Tensor, extent: Tensor) -> Tensor:
    """One integer [n] per group [n] and cell [n, D] within extent [D]."""
    key = group
    for axis in range(cells.shape[1]):
        key = key * extent[axis] + cells[:, axis]
    return key
