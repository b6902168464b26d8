"""Exact overlap of oriented boxes, in addition to `scenes.boxes`: its area, and the
parts of edges inside another box; and a broad phase with buckets: which of many items
may lie at which of many points.

A box is a state (x, y, heading, speed) and a size (length, width); leading dimensions
broadcast. Use float64 where an overlap of 1e-6 m2 decides.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from e2rl.scenes.boxes import corners, overlap, to_frame, unit_vectors
from e2rl.sim.dynamics import midpoints, wrap
from e2rl.sim.neighbours import STANDING

EDGES = (
    "left",
    "rear",
    "right",
    "front",
)  # edge i runs from corner i to corner i + 1 of scenes.boxes.corners
PART = 1 << 16  # pairs
MIN_AREA = 1e-6  # m2: a smaller overlap is the rounding of float32 positions


def velocity(states: Tensor) -> Tensor:
    """Velocity vectors [..., 2] [m/s] of states [..., 4]: the speed along the heading."""
    return states[..., 3:4] * unit_vectors(states[..., 2])


def travel_heading(states: Tensor) -> Tensor:
    """Direction [...] [rad] in which vehicles of states [..., 4] move: against their
    heading where they reverse."""
    heading = states[..., 2]
    speed = states[..., 3]
    return torch.where(speed < -STANDING, wrap(heading + torch.pi), heading)


def pair_overlap(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
    possible: Tensor,
) -> Tensor:
    """Overlap area [...] [m2] of pairs of boxes; 0 where the area is at most MIN_AREA.

    The exact area is computed only for the pairs that `scenes.boxes.overlap` finds.

    Args:
        first, second: states [..., 4].
        first_size, second_size: [..., 2].
        possible: [...] bool, pairs that count; the area of others is 0.
    """
    meets = possible & overlap(first, first_size, second, second_size)
    boxes = (first, first_size, second, second_size)
    area = overlap_area(
        *(box.expand(meets.shape + box.shape[-1:])[meets] for box in boxes)
    )
    result = torch.zeros(
        meets.shape,
        dtype=first.dtype,
        device=first.device,
    )
    return result.masked_scatter(meets, area.masked_fill(area <= MIN_AREA, 0.0))


def overlap_area(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Exact area [...] [m2] of two boxes' intersection.

    Green's theorem in the second box's frame: the boundary of the first box, every
    point of it clamped into the second box, encloses exactly the intersection, so area
    = sum over edges of the integral of clamp(x) d clamp(y). The integrand is continuous
    in the boxes, hence shared or collinear edges need no special case.

    Args:
        first, second: states [..., 4].
        first_size, second_size: [..., 2].
    """
    start, change, half, bounds = _edges_in_frame(
        first,
        first_size,
        other=second,
        other_size=second_size,
        zero=1.0,
    )
    begin, end = bounds[..., 1].clamp(0, 1)  # where y is inside the second box's width
    knots = torch.stack([begin, *(bounds[..., 0].maximum(begin).minimum(end)), end], -1)
    x = start[..., 0, None] + knots * change[..., 0, None]
    x = x.maximum(-half[..., 0, None]).minimum(half[..., 0, None])
    integral = ((knots[..., 1:] - knots[..., :-1]) * midpoints(x)).sum(-1)
    return (integral * change[..., 1]).sum(-1).clamp(min=0)


def edge_parts_inside(
    box: Tensor,
    size: Tensor,
    other: Tensor,
    other_size: Tensor,
) -> Tensor:
    """Length [..., 4] [m] of each of the box's edges (order `EDGES`) that lies inside
    the other box.

    Args:
        box, other: states [..., 4].
        size, other_size: [..., 2].
    """
    _, change, _, (enter, leave) = _edges_in_frame(
        box,
        size,
        other=other,
        other_size=other_size,
        zero=torch.finfo(box.dtype).tiny,
    )
    part = (leave.amin(-1).clamp(0, 1) - enter.amax(-1).clamp(0, 1)).clamp(min=0)
    return part * change.norm(dim=-1)


def _edges_in_frame(
    box: Tensor,
    size: Tensor,
    other: Tensor,
    other_size: Tensor,
    zero: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Start and change [..., 4, 2] of the box's edges in the frame of the other box,
    that box's half size [..., 1, 2], and the fractions [2, ..., 4, 2] of each edge at
    which its x and y enter and leave that box; a change of 0 counts as `zero` in them.
    """
    start = to_frame(corners(box, size), other[..., None, :])
    change = start.roll(-1, -2) - start
    half = (other_size / 2)[..., None, :]
    divisor = torch.where(change == 0, torch.full_like(change, zero), change)
    return (
        start,
        change,
        half,
        torch.stack([(-half - start) / divisor, (half - start) / divisor])
        .sort(0)
        .values,
    )


def edge_distances(box: Tensor, size: Tensor, point: Tensor) -> Tensor:
    """Distance [..., 4] [m] from each of the box's edges (order `EDGES`) to a point
    [..., 2]."""
    start = corners(box, size)
    return from_segment(
        point[..., None, :],
        start,
        along=start.roll(-1, -2) - start,
    ).norm(dim=-1)


def from_segment(point: Tensor, start: Tensor, along: Tensor) -> Tensor:
    """Vector [..., 2] [m] to a point from the nearest point of the segment from `start`
    to `start + along`."""
    offset = point - start
    fraction = (
        (offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-18)
    ).clamp(0, 1)
    return offset - fraction[..., None] * along


def ragged(counts: Tensor) -> tuple[Tensor, Tensor]:
    """(group, index within it), each [counts.sum()], of groups with counts [n] int64
    members."""
    group = torch.repeat_interleave(
        torch.arange(len(counts), device=counts.device), counts
    )
    start = counts.cumsum(0) - counts
    return group, torch.arange(len(group), device=counts.device) - start[group]


def pairs_where(
    holds: Callable[[Tensor, Tensor], Tensor],
    points: Tensor,
    point_group: Tensor,
    *,
    low: Tensor,
    high: Tensor,
    item_group: Tensor,
    cell: float,
) -> tuple[Tensor, Tensor]:
    """Pairs (point index, item index) of which something holds: of those of the same
    group that share a cell, among which is every point inside an item's bounds. About
    PART pairs are looked at at once.

    Args:
        holds: of indices (point, item), each [k], says whether [k] bool.
        points: [n, D] m.
        point_group: [n] int64 >= 0.
        low, high: [m, D] m, bounds of the items.
        item_group: [m] int64 >= 0.
        cell: m, size of the cells.
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
    item, index = ragged(
        span.prod(-1)
    )  # an item wholly outside the points' extent covers no cell
    covered = []
    for axis in range(points.shape[1]):
        covered.append(first[item, axis] + index % span[item, axis])
        index = index // span[item, axis]
    item_key, order = cell_key(
        item_group[item],
        torch.stack(covered, -1),
        extent=extent,
    ).sort()
    item = item[order]
    point_key = cell_key(
        point_group,
        cells,
        extent=extent,
    )
    begin = torch.searchsorted(item_key, point_key)
    count = torch.searchsorted(item_key, point_key, right=True) - begin
    part = (count.cumsum(0) // PART).unique_consecutive(return_counts=True)[1]
    pairs = []
    start = 0
    for size in part.tolist():
        point, index = ragged(count[start : start + size])
        point = point + start
        candidate = item[begin[point] + index]
        is_pair = holds(point, candidate)
        pairs.append((point[is_pair], candidate[is_pair]))
        start += size
    point, item = map(torch.cat, zip(*pairs, strict=True))
    return point, item


def cell_key(group: Tensor, cells: Tensor, extent: Tensor) -> Tensor:
    """One integer [n] per group [n] and cell [n, D] within extent [D]."""
    key = group
    for axis in range(cells.shape[1]):
        key = key * extent[axis] + cells[:, axis]
    return key
