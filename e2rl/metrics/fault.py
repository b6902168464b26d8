"""Whose fault the ego's contact is: a rule on the last second before it (method_and_baselines.md section 8.4).

The ego is at fault if it moves and either its partner stands still, or the ego's front hits a partner that did not cut
in. A partner that comes onto the ego's way less than one second before contact cuts in. An ego that stands still, or is
hit at its rear or side by a moving vehicle, is not at fault.
"""

import torch
from torch import Tensor

from e2rl.metrics.contact import FRONT, EgoContact
from e2rl.scene.boxes import separation

STANDING = 0.1  # m/s
CUT_IN_STEPS = 10  # 1 s at 10 Hz
WAY_AHEAD = 30.0  # m of the ego's way beyond the place of contact


def ego_at_fault(states: Tensor, valid: Tensor, size: Tensor, contact: EgoContact) -> Tensor:
    """1 or 0 [B], NaN without contact; states [B, T+1, N, 4], valid [B, T+1, N], size [B, N, 2]."""
    rows = torch.arange(len(states), device=states.device)
    partner = contact.partner.clamp(min=0)
    speed = states[rows, contact.before, :, 3].abs()
    moving, partner_stands = speed[:, 0] > STANDING, speed[rows, partner] <= STANDING
    head_on = (contact.kind == FRONT) & ~cuts_in(states, valid, size, partner, contact.stop)
    fault = moving & (partner_stands | head_on)
    return fault.to(states.dtype).masked_fill(~contact.hit, torch.nan)


def cuts_in(states: Tensor, valid: Tensor, size: Tensor, partner: Tensor, stop: Tensor) -> Tensor:
    """Bool [B]: at some step of the last second the partner touched no part of the ego's way from that step on.

    The way is the ego's own boxes until contact and a straight strip of its width ahead of the last of them.
    """
    rows = torch.arange(len(states), device=states.device)[:, None]
    window = stop[:, None] + torch.arange(-CUT_IN_STEPS, 1, device=states.device)
    known, window = (window >= 0) & (window < stop[:, None]), window.clamp(min=0)
    other = states[rows, window, partner[:, None]]
    known = known & valid[rows, window, partner[:, None]]
    way, way_size = ego_way(states[rows, window, 0], size[:, 0])
    other_size = size[rows, partner[:, None]]
    meet = separation(other[:, :, None], other_size[:, :, None], way[:, None], way_size[:, None]) <= 0
    ahead = torch.ones(meet.shape[-2:], dtype=torch.bool, device=meet.device).triu()
    return (known & ~(meet & ahead).any(-1)).any(-1)


def ego_way(path: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Boxes [B, W+1, 4] and sizes [B, W+1, 2] of an ego's path [B, W, 4] and of the strip ahead of its last state."""
    last = path[:, -1:]
    direction = torch.stack([last[..., 2].cos(), last[..., 2].sin()], -1)
    shift = (size[:, :1] + WAY_AHEAD)[..., None] / 2
    strip = torch.cat([last[..., :2] + shift * direction, last[..., 2:]], -1)
    strip_size = torch.stack([torch.full_like(size[:, 0], WAY_AHEAD), size[:, 1]], -1)[:, None]
    sizes = torch.cat([size[:, None].expand(-1, path.shape[1], -1), strip_size], 1)
    return torch.cat([path, strip], 1), sizes
