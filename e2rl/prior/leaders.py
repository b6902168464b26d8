"""Who is ahead of whom along the routes."""

import torch
from torch import Tensor

from e2rl.scene.route import project
from e2rl.sim.car_following import desired_gap

SIDE_GAP = 0.3  # m of free space to either side that still makes somebody a leader
FREE = 200.0  # m: the gap of a vehicle with nobody ahead


def leaders(
    s: Tensor, width: Tensor, length: Tensor, points: Tensor, agents: Tensor, size: Tensor, present: Tensor,
    d: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest agent ahead of each vehicle on its route: gap [m] (FREE if none), its speed along the route, index.

    s [B, V]: the vehicles' arc lengths; width, length [B, V]; points [B, V, P, 2]; agents [B, M, 4]: states to look at,
    of which rows 0..V-1 are the vehicles themselves; size [B, M, 2]; present [B, M]. d [B, V]: the vehicles' offsets:
    whoever is in the band between a vehicle's own offset and its route is ahead too (it changes lanes through it).
    """
    vehicles = s.shape[1]
    at, offset, heading = project(agents[:, None, :, :2], points)  # [B, V, M]
    turn = agents[:, None, :, 2] - heading
    cos, sin = torch.cos(turn), torch.sin(turn)
    half_side = (size[:, None, :, 0] * sin.abs() + size[:, None, :, 1] * cos.abs()) / 2
    half_along = (size[:, None, :, 0] * cos.abs() + size[:, None, :, 1] * sin.abs()) / 2
    ahead = at - s[..., None]
    own = torch.zeros_like(s)[..., None] if d is None else d[..., None]
    aside = offset - torch.minimum(torch.maximum(offset, own.clamp(max=0)), own.clamp(min=0))
    inside = aside.abs() < width[..., None] / 2 + half_side + SIDE_GAP
    itself = torch.eye(vehicles, agents.shape[1], dtype=torch.bool, device=s.device)
    candidate = inside & (ahead > 0) & present[:, None, :] & ~itself
    gap = torch.where(candidate, ahead - length[..., None] / 2 - half_along, FREE)
    nearest = gap.min(-1)
    speed = (agents[:, None, :, 3] * cos).gather(-1, nearest.indices[..., None])[..., 0]
    return nearest.values.clamp(max=FREE), speed, nearest.indices


def idm_acceleration(
    v: Tensor, target: Tensor, gap: Tensor, leader: Tensor, headway: float, jam: float, accel: float, brake: float
) -> Tensor:
    """Intelligent Driver Model: v, target [m/s], gap [m] to a leader driving `leader` m/s -> acceleration [m/s^2].

    The original free-road term; planners drive by the improved one of ego.idm.
    """
    wanted = desired_gap(v, leader, headway, jam, accel, brake)
    return accel * (1 - (v / target.clamp(min=1.0)) ** 4 - (wanted / gap.clamp(min=0.1)) ** 2)
