"""Whether the ego is at fault in a contact: a rule on the last second before it (docs/method.md, section 10).

The ego is at fault if it moves and either its partner stands still, or the ego's front hits a partner that did not cut
in. A partner cuts in if it enters the ego's path less than one second before the contact. An ego that stands still, or
that a moving vehicle hits at its rear or side, is not at fault.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch
from e2rl.metrics.contact import FRONT
from e2rl.scenes.boxes import separation
from e2rl.sim.neighbours import STANDING

CUT_IN_STEPS = 10  # 1 s at 10 Hz
AHEAD = 30.0  # m, straight on from the contact, that count as the ego's path


def at_fault(batch: Batch) -> Tensor:
    """1 or 0 [B], NaN without contact."""
    row = torch.arange(len(batch["states"]))
    speed = batch["states"][row, batch["before"], :, 3].abs()
    moving, partner_stands = speed[:, 0] > STANDING, speed[row, batch["partner"].clamp(min=0)] <= STANDING
    fault = moving & (partner_stands | ((batch["kind"] == FRONT) & ~cuts_in(batch)))
    return fault.to(speed.dtype).masked_fill(~batch["hit"], torch.nan)


def cuts_in(batch: Batch) -> Tensor:
    """Bool [B]: at some step of the last second the partner touches no part of the ego's path from that step on.

    The path is the ego's own boxes until the contact, and a straight strip of its width ahead of the last of them.
    """
    states, size, stop, partner = batch["states"], batch["size"], batch["stop"], batch["partner"].clamp(min=0)[:, None]
    row = torch.arange(len(states), device=states.device)[:, None]
    window = stop[:, None] + torch.arange(-CUT_IN_STEPS, 1, device=states.device)
    known, window = (window >= 0) & (window < stop[:, None]), window.clamp(min=0)
    other, other_size = states[row, window, partner], size[row, partner]
    known = known & batch["valid"][row, window, partner]
    path, path_size = ego_path_boxes(states[row, window, 0], size[:, 0])
    meet = separation(other[:, :, None], other_size[:, :, None], path[:, None], path_size[:, None]) <= 0
    later = torch.ones(meet.shape[-2:], dtype=torch.bool, device=meet.device).triu()
    return (known & ~(meet & later).any(-1)).any(-1)


def ego_path_boxes(states: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Boxes [B, W+1, 4] and sizes [B, W+1, 2] of an ego at states [B, W, 4] and of the strip ahead of the last one."""
    last = states[:, -1:]
    direction = torch.stack([last[..., 2].cos(), last[..., 2].sin()], -1)
    shift = (size[:, :1] + AHEAD)[..., None] / 2
    strip = torch.cat([last[..., :2] + shift * direction, last[..., 2:]], -1)
    strip_size = torch.stack([torch.full_like(size[:, 0], AHEAD), size[:, 1]], -1)[:, None]
    sizes = torch.cat([size[:, None].expand(-1, states.shape[1], -1), strip_size], 1)
    return torch.cat([states, strip], 1), sizes
