"""Which contacts are of the ego's own making, by their step alone; metrics/fault.py judges whole rollouts."""

import torch
from torch import Tensor

from e2rl.sim.neighbours import Neighbours

STANDING = 0.1  # m/s


def own_fault(speed: Tensor, near: Neighbours, hit: Tensor, size: Tensor, half_size: Tensor) -> Tensor:
    """Bool [B]: the ego overlaps an agent while it moves, and that agent stands or lies across the ego's front edge.

    speed [B] m/s: of the ego before the contact. hit [B, M]: the neighbours that each ego overlaps; the one with the
    deepest overlap is judged. The edge is that of the least overlap along the ego's axes, which near its corners
    may differ from the one that touched first. size [B, 2]: length and width of the egos; half_size [B, 2, M]: of the
    others.
    """
    if hit.shape[1] == 0:
        return hit.any(1)
    deepest = near.gap.masked_fill(~hit, torch.inf).argmin(1, keepdim=True)
    pick = deepest[:, None].expand(-1, 2, -1)
    position, turn, half = (value.gather(2, pick)[..., 0] for value in (near.position, near.direction, half_size))
    turn = turn.abs()
    extent = torch.stack([(turn * half).sum(1), (turn.flip(1) * half).sum(1)], 1)
    ahead, aside = (position.abs() - size / 2 - extent).unbind(1)
    front = (position[:, 0] > 0) & (ahead > aside)
    stands = near.agents.states[..., 3].gather(1, deepest)[:, 0].abs() <= STANDING
    return hit.any(1) & (speed.abs() > STANDING) & (front | stands)
