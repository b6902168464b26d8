"""What a motion leaves to a competent driver in the ego's place: the law that adversaries keep, and the measure of how
hard they are (docs/adversaries.md).

A motion keeps the law if a careful and competent driver (UN R157, e2rl/verdicts) in the ego's place avoids the contact
by braking. Its margin is the least gap that this driver keeps.
"""

import torch
from torch import Tensor

from e2rl.verdicts.drivers import DRIVERS, Driver
from e2rl.verdicts.redrive import Tracks, along_way, contacts, driven_length, redrive

ASIDE = 0.3  # m between the sides below which a gap counts


def competent_margin(
    ego: Tensor, ego_size: Tensor, motion: Tensor, size: Tensor, driver: Driver = DRIVERS["human"]
) -> Tensor:
    """Least gap [Q] m along its way that a competent driver keeps to motions [Q, H+1, 4] which begin now; at most 0
    where it does not avoid them, inf where it need not brake for them."""
    if not len(motion):
        return motion.new_zeros(0)
    other = Tracks(motion[:, :, None], size[:, None], torch.ones_like(motion[..., :1], dtype=torch.bool))
    along = along_way(ego, ego_size[:, 1], other)
    driven = redrive(driver, ego, ego_size, along)
    gap = along.rear[..., 0].T - driven_length(driven) - ego_size[:, :1] / 2
    beside = (along.lateral_gap[..., 0].T <= ASIDE) & (gap > -ego_size[:, :1] - along.length[..., 0].T)
    least = gap.masked_fill(~beside, torch.inf).amin(1)
    hit = contacts(driven, ego_size, other)[..., 0].any(1)
    return torch.where(hit, least.clamp(max=0.0), least)
