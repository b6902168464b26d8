"""What scoring asks of oriented boxes beside `scene.boxes`: exact overlap area, the parts of edges inside another box.

A box is a state (x, y, heading, speed) and a size (length, width); leading dimensions broadcast. float64 is advised
where an overlap of 1e-6 m2 decides.
"""

import torch
from torch import Tensor

from e2rl.scene.boxes import corners, to_frame

EDGES = ("left", "rear", "right", "front")  # edge i runs from corner i to corner i + 1 of scene.boxes.corners


def velocity(states: Tensor) -> Tensor:
    """Velocity vectors [..., 2] [m/s] of states [..., 4]: the speed along the heading."""
    return states[..., 3:4] * torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)


def overlap_area(first: Tensor, first_size: Tensor, second: Tensor, second_size: Tensor) -> Tensor:
    """Exact area [...] [m2] of two boxes' intersection.

    By Green's theorem in the second box's frame: the boundary of the first box, every point of it clamped into the
    second box, encloses exactly the intersection, so area = sum over edges of the integral of clamp(x) d clamp(y).
    The integrand is continuous in the boxes, hence shared or collinear edges need no special case.
    """
    start = to_frame(corners(first, first_size), second[..., None, :])
    change = start.roll(-1, -2) - start
    half = (second_size / 2)[..., None, :]
    safe = torch.where(change == 0, torch.ones_like(change), change)
    bounds = torch.stack([(-half - start) / safe, (half - start) / safe]).sort(0).values
    begin, end = bounds[..., 1].clamp(0, 1)  # where y is inside the second box's width
    knots = torch.stack([begin, *(bounds[..., 0].maximum(begin).minimum(end)), end], -1)
    x = start[..., 0, None] + knots * change[..., 0, None]
    x = x.maximum(-half[..., 0, None]).minimum(half[..., 0, None])
    integral = ((knots[..., 1:] - knots[..., :-1]) * (x[..., 1:] + x[..., :-1]) / 2).sum(-1)
    return (integral * change[..., 1]).sum(-1).clamp(min=0)


def edge_parts_inside(box: Tensor, size: Tensor, other: Tensor, other_size: Tensor) -> Tensor:
    """Length [..., 4] [m] of each of the box's edges (order `EDGES`) that lies inside the other box."""
    start = to_frame(corners(box, size), other[..., None, :])
    change = start.roll(-1, -2) - start
    half = (other_size / 2)[..., None, :]
    safe = torch.where(change == 0, torch.full_like(change, torch.finfo(change.dtype).tiny), change)
    enter, leave = torch.stack([(-half - start) / safe, (half - start) / safe]).sort(0).values
    part = (leave.amin(-1).clamp(0, 1) - enter.amax(-1).clamp(0, 1)).clamp(min=0)
    return part * change.norm(dim=-1)


def edge_distances(box: Tensor, size: Tensor, point: Tensor) -> Tensor:
    """Distance [..., 4] [m] from each of the box's edges (order `EDGES`) to a point [..., 2]."""
    corner = corners(box, size)
    along = corner.roll(-1, -2) - corner
    offset = point[..., None, :] - corner
    share = ((offset * along).sum(-1) / (along * along).sum(-1).clamp(min=1e-12)).clamp(0, 1)
    return (offset - share[..., None] * along).norm(dim=-1)
