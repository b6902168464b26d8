"""Probability of collision of ego profiles with predicted traffic, by five-circle boxes (STRIVE's planner)."""

import torch
from torch import Tensor

from e2rl.ego.prediction import Prediction

CERTAIN = 1e-6  # 1 - p of a pair in contact: p = 1 would make all colliding profiles equal
CHUNK = 16384  # pairs of poses at a time, to fit the processor's cache
NEGLIGIBLE = 1e-4  # pairs with a smaller p are omitted


def collision_hazard(ego: Tensor, ego_size: Tensor, others: Prediction, slope: float, growth: float) -> Tensor:
    """-log(1 - P) [B, C] of profiles ego [B, C, T, 3]; ego_size [B, 2].

    P = 1 - prod over agents and times of (1 - p), p = 1 - tanh(d w_t) for the smallest distance d between the circles
    of the two boxes, w_t = slope + growth t (t = 0..T-1), and p = 1 where d < 0.
    """
    batch, count, times, _ = ego.shape
    weight = slope + growth * torch.arange(times, device=ego.device, dtype=ego.dtype)
    hazard = ego.new_zeros(batch * count)
    centre = ego[others.scene, :, :, :2].transpose(1, 2)  # [J, T, C, 2]
    apart = _squared(centre, others.poses[:, :, None, :2])
    reach = (ego_size[others.scene].norm(dim=-1) + others.size.norm(dim=-1))[:, None] / 2
    cut = reach + _distance_of(NEGLIGIBLE) / weight  # [J, T]
    other, time, profile = (apart < cut.square()[..., None]).nonzero(as_tuple=True)
    scene = others.scene[other]
    for part in torch.arange(len(other), device=ego.device).split(CHUNK):
        j, t, c, b = other[part], time[part], profile[part], scene[part]
        gap = circle_gap(ego[b, c, t], ego_size[b], others.poses[j, t], others.size[j])
        safe = torch.tanh(gap.clamp(min=0) * weight[t]).clamp(min=CERTAIN)
        hazard.index_add_(0, b * count + c, -safe.log())
    return hazard.view(batch, count)


def _squared(first: Tensor, second: Tensor) -> Tensor:
    """Squared distance [...] of points [..., 2]; per axis, as reducing a last axis of two is slow."""
    return (first[..., 0] - second[..., 0]).square() + (first[..., 1] - second[..., 1]).square()


def _distance_of(probability: float) -> float:
    """The d w at which 1 - tanh(d w) = `probability`."""
    return torch.atanh(torch.tensor(1 - probability, dtype=torch.float64)).item()


def circles(pose: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Centres [..., 5, 2] and radii [..., 5] of five circles in a box: one of radius width / 2 at the centre, four of
    radius width / 4 in the corners."""
    length, width = size.unbind(-1)
    along, across = (length - width) / 2 + width / 4, width / 4
    x = torch.stack([torch.zeros_like(along), along, along, -along, -along], -1)
    y = torch.stack([torch.zeros_like(across), across, -across, across, -across], -1)
    cos, sin = pose[..., 2:3].cos(), pose[..., 2:3].sin()
    centre = torch.stack([pose[..., 0:1] + cos * x - sin * y, pose[..., 1:2] + sin * x + cos * y], -1)
    return centre, torch.stack([width / 2, *[width / 4] * 4], -1)


def circle_gap(first: Tensor, first_size: Tensor, second: Tensor, second_size: Tensor) -> Tensor:
    """Smallest distance [...] m between the circles of two boxes; negative where circles overlap."""
    a, ra = circles(first, first_size)
    b, rb = circles(second, second_size)
    apart = _squared(a[..., :, None, :], b[..., None, :, :]).sqrt()
    return (apart - ra[..., :, None] - rb[..., None, :]).flatten(-2).amin(-1)
