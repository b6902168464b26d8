"""Oriented boxes: separation, overlap and distance of pairs, batched over leading
dimensions that broadcast.

A box is a pose [..., >= 3] (x, y, heading, further columns ignored) and a size [..., 2]
(length, width).
"""

import torch
from torch import Tensor


def unit_vectors(heading: Tensor) -> Tensor:
    """Unit vectors [..., 2] of headings [...] in rad."""
    return torch.stack([heading.cos(), heading.sin()], -1)


def angle_of(vector: Tensor) -> Tensor:
    """Angles [...] rad of vectors [..., 2]."""
    return torch.atan2(vector[..., 1], vector[..., 0])


def corners(pose: Tensor, size: Tensor) -> Tensor:
    """Corners [..., 4, 2], counter-clockwise from the front left one."""
    cos = pose[..., 2].cos()
    sin = pose[..., 2].sin()
    forward = torch.stack([cos, sin], -1) * size[..., :1] / 2
    left = torch.stack([-sin, cos], -1) * size[..., 1:] / 2
    offsets = torch.stack(
        [forward + left, left - forward, -forward - left, forward - left], -2
    )
    return pose[..., None, :2] + offsets


def to_frame(points: Tensor, pose: Tensor) -> Tensor:
    """Points [..., 2] in the frame of pose [..., >= 3]: x forward, y to the left."""
    delta = points - pose[..., :2]
    cos = pose[..., 2].cos()
    sin = pose[..., 2].sin()
    ahead = cos * delta[..., 0] + sin * delta[..., 1]
    left = cos * delta[..., 1] - sin * delta[..., 0]
    return torch.stack([ahead, left], -1)


def separation(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Returns the largest gap [...] [m] over the four face normals (separating axis
    theorem), differentiable.

    Negative exactly where the interiors overlap (then minus the penetration depth);
    where positive, a lower bound of the distance.

    Args:
        first: poses [..., >= 3].
        first_size: their sizes [..., 2] m.
        second: other poses.
        second_size: their sizes.
    """
    dx = second[..., 0] - first[..., 0]
    dy = second[..., 1] - first[..., 1]
    cos_a = first[..., 2].cos()
    sin_a = first[..., 2].sin()
    cos_b = second[..., 2].cos()
    sin_b = second[..., 2].sin()
    cos = (cos_a * cos_b + sin_a * sin_b).abs()
    sin = (sin_a * cos_b - cos_a * sin_b).abs()
    la, wa = (first_size / 2).unbind(-1)
    lb, wb = (second_size / 2).unbind(-1)
    gap_first = torch.maximum(
        (dx * cos_a + dy * sin_a).abs() - (la + cos * lb + sin * wb),
        (dy * cos_a - dx * sin_a).abs() - (wa + sin * lb + cos * wb),
    )
    gap_second = torch.maximum(
        (dx * cos_b + dy * sin_b).abs() - (lb + cos * la + sin * wa),
        (dy * cos_b - dx * sin_b).abs() - (wb + sin * la + cos * wa),
    )
    return torch.maximum(gap_first, gap_second)


def overlap(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Returns whether the interiors overlap [...]. A broad phase by centre distance
    first, so that only near pairs cost much.

    Picks the near pairs by index, which waits for the device; where that matters use
    `separation(...) < 0`.

    Args:
        first, first_size, second, second_size: see `separation`.
    """
    reach = (first_size.norm(dim=-1) + second_size.norm(dim=-1)) / 2
    offset = first[..., :2] - second[..., :2]
    near = offset.square().sum(-1) < reach.square()
    if torch.compiler.is_compiling():
        gap = separation(
            first,
            first_size,
            second=second,
            second_size=second_size,
        )
        return near & (gap < 0)

    def picked(box: Tensor) -> Tensor:
        return box.expand(*near.shape, box.shape[-1])[near]

    gap = separation(
        picked(first),
        picked(first_size),
        second=picked(second),
        second_size=picked(second_size),
    )
    return near.masked_scatter(near, gap < 0)


def distance(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Returns the distance [...] [m] between two boxes, 0 where they overlap; the
    nearest points include a corner of one.

    Args:
        first, first_size, second, second_size: see `separation`.
    """
    signed = signed_distance(
        first,
        first_size,
        second=second,
        second_size=second_size,
    )
    return signed.clamp(min=0)


def signed_distance(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Returns `distance`, with minus the penetration depth where the boxes overlap.

    Args:
        first, first_size, second, second_size: see `separation`.
    """
    apart = separation(
        first,
        first_size,
        second=second,
        second_size=second_size,
    )
    squared = torch.minimum(
        _corner_gap(first, first_size, corners(second, second_size)),
        _corner_gap(second, second_size, corners(first, first_size)),
    )
    gap = squared.clamp(min=1e-12).sqrt() * (squared > 0)
    return torch.where(apart < 0, apart, gap)


def _corner_gap(
    pose: Tensor,
    size: Tensor,
    points: Tensor,
) -> Tensor:
    """The least squared distance [...] of corners [..., 4, 2] from a box."""
    offset = to_frame(points, pose[..., None, :]).abs() - size[..., None, :] / 2
    return offset.clamp(min=0).square().sum(-1).amin(-1)
