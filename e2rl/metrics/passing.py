"""Contacts of vehicles that pass through each other between two steps."""

import torch
from torch import Tensor

from e2rl.metrics.geometry import pair_overlap
from e2rl.scenes.boxes import to_frame
from e2rl.sim.dynamics import wrap
from e2rl.sim.passing import is_fast, time_inside


def with_passing(
    first: Tensor,
    first_size: Tensor,
    *,
    second: Tensor,
    second_size: Tensor,
    possible: Tensor,
    area: Tensor,
) -> tuple[Tensor, Tensor]:
    """Overlap areas [B, T+1, N] with those of pairs that pass through each other in the
    step before, at the middle of their contact; and that moment [B, T+1, N], as a
    fraction of the step, 1 for all others.

    Args:
        first, second: states [B, T+1, N or 1, 4].
        first_size, second_size: that broadcast with them.
        possible: [B, T+1, N] bool, pairs that are there at steps.
        area: [B, T+1, N] m^2, their overlap at steps.
    """
    moment = torch.ones_like(area)
    boxes = [
        value.expand(*area.shape, value.shape[-1])
        for value in (first, first_size, second, second_size)
    ]
    offset = (boxes[2] - boxes[0])[..., :2]
    change = torch.nn.functional.pad(offset.diff(dim=1), (0, 0, 0, 0, 1, 0))
    reach = (boxes[1].norm(dim=-1) + boxes[3].norm(dim=-1)) / 2 + change.norm(dim=-1)
    fast = is_fast(
        change.movedim(-1, 0),
        (boxes[1] / 2).movedim(-1, 0),
        other=(boxes[3] / 2).movedim(-1, 0),
    )
    may_pass = possible & (area == 0) & fast & (offset.norm(dim=-1) < reach)
    may_pass[:, 0] = False
    may_pass[:, 1:] &= possible[:, :-1] & (area[:, :-1] == 0)
    if not may_pass.any():
        return area, moment
    rollout, step, agent = may_pass.nonzero(as_tuple=True)
    one, one_size, two, two_size = (value[rollout, step, agent] for value in boxes)
    one_before = boxes[0][rollout, step - 1, agent]
    two_before = boxes[2][rollout, step - 1, agent]
    half = torch.full_like(one[:, 0], 0.5)
    heading = interpolated(
        one_before,
        one,
        fraction=half,
    )[:, 2]
    turn = (
        interpolated(
            two_before,
            two,
            fraction=half,
        )[:, 2]
        - heading
    )
    frame = torch.nn.functional.pad(heading[:, None], (2, 0))
    begin, end = time_inside(
        to_frame(two_before[:, :2] - one_before[:, :2], frame).T,
        to_frame(change[rollout, step, agent], frame).T,
        direction=torch.stack([turn.cos(), turn.sin()]),
        own=(one_size / 2).T,
        other=(two_size / 2).T,
    )
    middle = (begin + end) / 2
    overlap = pair_overlap(
        interpolated(
            one_before,
            one,
            fraction=middle,
        ),
        one_size,
        second=interpolated(
            two_before,
            two,
            fraction=middle,
        ),
        second_size=two_size,
        possible=begin < end,
    )
    passes = overlap > 0
    index = rollout[passes], step[passes], agent[passes]
    area = area.clone()
    area[index] = overlap[passes]
    moment[index] = middle[passes]
    return area, moment


def interpolated(before: Tensor, after: Tensor, fraction: Tensor) -> Tensor:
    """States [..., 4] at a fraction [...] of the way from `before` to `after` [..., 4]."""
    change = after - before
    change = torch.cat([change[..., :2], wrap(change[..., 2:3]), change[..., 3:]], -1)
    return before + fraction[..., None] * change
