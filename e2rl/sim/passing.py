"""Boxes that pass through each other between two steps, neither of which shows the
contact: fast and short ones."""

import torch
from torch import Tensor

PARALLEL = 1e-6  # m: a smaller displacement along an axis is none


def time_inside(
    offset: Tensor,
    change: Tensor,
    direction: Tensor,
    own: Tensor,
    other: Tensor,
) -> tuple[Tensor, Tensor]:
    """Fractions of a step at which two boxes of fixed headings begin and end to
    overlap; where they do not, the end is not after the begin. The separating axis
    theorem: the overlap on each axis is an interval of time.

    Args:
        offset: [2, ...] m, the other's centre in the frame of the own box at the step's
            beginning.
        change: [2, ...] m, by which it moves there during the step.
        direction: [2, ...], cosine and sine of its heading there.
        own, other: [2, ...] m, half lengths and half widths.

    Returns:
        Begin and end [...], in [0, 1].
    """
    cos, sin = direction
    along = cos.abs()
    across = sin.abs()
    turned_offset = offset[0] * cos + offset[1] * sin, offset[1] * cos - offset[0] * sin
    turned_change = change[0] * cos + change[1] * sin, change[1] * cos - change[0] * sin
    axes = (
        (offset[0], change[0], own[0] + along * other[0] + across * other[1]),
        (offset[1], change[1], own[1] + across * other[0] + along * other[1]),
        (
            turned_offset[0],
            turned_change[0],
            other[0] + along * own[0] + across * own[1],
        ),
        (
            turned_offset[1],
            turned_change[1],
            other[1] + across * own[0] + along * own[1],
        ),
    )
    begin = torch.zeros_like(cos)
    end = torch.ones_like(cos)
    for place, motion, reach in axes:
        pace = motion.abs().clamp(min=PARALLEL)
        middle = -place * torch.where(motion < 0, -1.0, 1.0) / pace
        begin = torch.maximum(begin, middle - reach / pace)
        end = torch.minimum(end, middle + reach / pace)
    return begin, end


def is_fast(change: Tensor, own: Tensor, other: Tensor) -> Tensor:
    """Bool [...]: a displacement change [2, ...] m is longer than half of the smallest
    extent of two boxes, of half sizes own, other [2, ...] m. A shorter one cannot take
    them through each other unseen but at their corners."""
    least = torch.minimum(
        torch.minimum(own[0], own[1]), torch.minimum(other[0], other[1])
    )
    return change[0].square() + change[1].square() > least.square()
