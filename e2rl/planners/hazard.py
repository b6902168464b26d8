"""The probability of collision of STRIVE's planner (Rempe et al. 2022): by the distance
between the circles of two boxes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.run.fused import fused

CERTAIN = 1e-6  # 1 - p in contact: p = 1 would make all colliding profiles equal
NEGLIGIBLE = 1e-4  # pairs with a smaller p are omitted
CHUNK = 16384  # pairs of poses at a time, to fit the processor's cache


@dataclass
class Prediction:
    """J predicted trajectories of all scenes: poses [J, T, 3] from now on, size [J, 2],
    scene [J] int64."""

    poses: Tensor
    size: Tensor
    scene: Tensor


def collision_hazard(
    ego: Tensor,
    ego_size: Tensor,
    others: Prediction,
    *,
    slope: float,
    growth: float,
) -> Tensor:
    """Returns -log(1 - P) [B, C] of profiles.

    P = 1 - prod over agents and times of (1 - p), p = 1 - tanh(d w_t) for the smallest
    distance d between the circles of the two boxes, w_t = slope + growth t (t =
    0..T-1), and p = 1 where d < 0.

    Args:
        ego: poses [B, C, T, 3] of the profiles.
        ego_size: [B, 2] m.
        others: at the same times.
        slope: 1/m.
        growth: 1/m a time.
    """
    batch, count, times, _ = ego.shape
    scene = others.scene
    weight = slope + growth * torch.arange(times, device=ego.device, dtype=ego.dtype)
    reach = (ego_size[scene].norm(dim=-1) + others.size.norm(dim=-1))[:, None] / 2
    cut = reach + math.atanh(1 - NEGLIGIBLE) / weight  # [J, T]
    low = ego[..., :2].amin(1)[scene]  # [J, T, 2], of all profiles
    high = ego[..., :2].amax(1)[scene]
    place = others.poses[..., :2]
    beside = torch.maximum(low - place, place - high).clamp(min=0)
    apart = _squared(beside, torch.zeros_like(beside))
    j, t = (apart < cut.square()).nonzero(as_tuple=True)
    near = profiles_near(ego, others.poses, cut, j, t, scene[j])
    pair, profile = near.nonzero(as_tuple=True)
    pairs = torch.stack(
        [
            j[pair],
            t[pair],
            profile,
            scene[j[pair]],
        ]
    )
    hazard = ego.new_zeros(batch * count)
    ego_poses = ego.flatten(0, 2)
    poses = others.poses.flatten(0, 1)
    for j, t, c, b in pairs.split(CHUNK, 1):
        row = b * count + c
        value = hazard_of(
            ego_poses.index_select(0, row * times + t),
            ego_size.index_select(0, b),
            poses.index_select(0, j * times + t),
            others.size.index_select(0, j),
            weight.index_select(0, t),
        )
        hazard.index_add_(0, row, value)
    return hazard.view(batch, count)


@fused("B C T 3!", "J T 3!", "J T", "S:int64", "S:int64", "S:int64")
def profiles_near(
    ego: Tensor,
    other: Tensor,
    cut: Tensor,
    j: Tensor,
    t: Tensor,
    b: Tensor,
) -> Tensor:
    """Returns 1 where profiles [S, C] are within the cut of others, else 0.

    Args:
        ego: [B, C, T, 3].
        other: [J, T, 3].
        cut: [J, T] m.
        j: [S], of the others.
        t: [S], times.
        b: [S], their scenes.
    """
    apart = _squared(ego[..., :2][b, :, t], other[..., :2][j, t][:, None])
    return torch.where(apart < cut[j, t].square()[:, None], 1.0, 0.0)


@fused("Q 3", "Q 2", "Q 3", "Q 2", "Q")
def hazard_of(
    ego: Tensor,
    ego_size: Tensor,
    other: Tensor,
    size: Tensor,
    weight: Tensor,
) -> Tensor:
    """Returns -log(1 - p) [Q] of pairs of boxes.

    Args:
        ego, other: poses [Q, 3].
        ego_size, size: [Q, 2] m.
        weight: [Q], w_t in 1/m.
    """
    gap = circle_gap(
        ego,
        ego_size,
        second=other,
        second_size=size,
    )
    return -torch.tanh(gap.clamp(min=0) * weight).clamp(min=CERTAIN).log()


def _squared(first: Tensor, second: Tensor) -> Tensor:
    """Squared distance [...] of points [..., 2]; per axis, as reducing a last axis of
    two is slow."""
    x = first[..., 0] - second[..., 0]
    y = first[..., 1] - second[..., 1]
    return x.square() + y.square()


def circles(pose: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and radii [5, ...] of five circles in a box: one of radius width / 2 at the
    centre, four of radius width / 4 in the corners."""
    length, width = (value.expand(pose.shape[:-1]) for value in size.unbind(-1))
    along = (length - width) / 2 + width / 4
    across = width / 4
    x = torch.stack(
        [
            torch.zeros_like(along),
            along,
            along,
            -along,
            -along,
        ]
    )
    y = torch.stack(
        [
            torch.zeros_like(across),
            across,
            -across,
            across,
            -across,
        ]
    )
    cos = pose[..., 2].cos()
    sin = pose[..., 2].sin()
    radius = torch.stack([width / 2, *[width / 4] * 4])
    return pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y, radius


def circle_gap(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
) -> Tensor:
    """Returns the smallest distance [...] m between the circles of two boxes; negative
    where circles overlap.

    Args:
        first, second: poses [..., 3].
        first_size, second_size: [..., 2] m.
    """
    first, second = torch.broadcast_tensors(first[..., :3], second[..., :3])
    ax, ay, ar = circles(first, first_size)
    bx, by, br = circles(second, second_size)
    apart = ((ax[:, None] - bx).square() + (ay[:, None] - by).square()).sqrt()
    return (apart - ar[:, None] - br).flatten(0, 1).amin(0)
