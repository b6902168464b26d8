"""What of a scene stays the same while it runs, once every vehicle has a route: worked out once per scene."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.route import SPACING

CONFLICT_STRIDE = 2  # vertices: conflicts are looked for every 4 m
CONFLICT_RANGE = 80  # vertices ahead of the route's begin
CONFLICT_GAP = 2.5  # m between routes that meet


@dataclass
class RoutedScene:
    """The routes of B scenes' vehicles and what follows from them; no maps, so that it is copied cheaply.

    size [B, N, 2]; light_state [B, T+1, L]; route [B, V]; points [B, V, P, 2]; length [B, V]; open [B, V]; limit
    [B, V, P]; light, light_s [B, V, 2]; conflict [B, V, V] bool, conflict_s [B, V, V]: arc length on i's route where it
    first meets j's; crossing [B, V, V]: angle there [rad]; modelled [B, V]: vehicles that the prior moves or conditions
    on; parked [B, V]; has_lane [B, V]: others are represented in free space;
    past [B, V, 10, 3]: before the start frame (see the scene).
    """

    size: Tensor
    light_state: Tensor
    route: Tensor
    points: Tensor
    length: Tensor
    open: Tensor
    limit: Tensor
    light: Tensor
    light_s: Tensor
    conflict: Tensor
    conflict_s: Tensor
    crossing: Tensor
    modelled: Tensor
    parked: Tensor
    has_lane: Tensor
    past: Tensor


def take_route(values: Tensor, route: Tensor) -> Tensor:
    """values [B, V, R, ...] at route [B, V] -> [B, V, ...]."""
    index = route.reshape(*route.shape, *[1] * (values.ndim - 2)).expand(*route.shape, 1, *values.shape[3:])
    return values.gather(2, index).squeeze(2)


def route_scene(scene: TensorDictBase, route: Tensor, free_space: bool = False) -> RoutedScene:
    """The RoutedScene of scenes [B] whose vehicles follow candidates route [B, V].

    free_space: represent every vehicle without its lane (the ablation).
    """
    vehicles = route.shape[1]
    points = take_route(scene["route_points"], route)
    valid, parked = scene["valid"][:, :vehicles], scene["parked"][:, :vehicles]
    has_lane = take_route(scene["route_valid"], route)
    pairs = [_conflicts(points[b:b + 1]) for b in range(len(points))]  # a scene at a time keeps the pairs in the cache
    conflict, conflict_s, crossing = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    both = (valid & ~parked & has_lane)
    conflict = conflict & both[:, :, None] & both[:, None, :]
    return RoutedScene(
        scene["size"], scene["light_state"], route, points, take_route(scene["route_length"], route),
        take_route(scene["route_open"], route), take_route(scene["route_limit"], route),
        take_route(scene["route_light"], route), take_route(scene["route_light_s"], route), conflict, conflict_s,
        crossing, valid & ~parked, parked, has_lane & (not free_space), scene["past"][:, :vehicles])


def _conflicts(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First meeting of every route pair of points [B, V, P, 2] (see RoutedScene)."""
    line = points[:, :, :CONFLICT_RANGE:CONFLICT_STRIDE]
    batch, vehicles, count, _ = line.shape
    flat = line.reshape(batch, vehicles * count, 2)
    center = flat.mean(1, keepdim=True)
    near = torch.cdist(flat - center, flat - center) < CONFLICT_GAP
    near = near.reshape(batch, vehicles, count, vehicles, count)
    meets = near.any(-1)  # [B, V, C, V]: this vertex of i meets j's route somewhere
    first = meets.float().argmax(2)  # [B, V, V]
    conflict = meets.any(2) & ~torch.eye(vehicles, dtype=torch.bool, device=points.device)
    tangent = torch.gradient(line, dim=2)[0]
    angle = torch.atan2(tangent[..., 1], tangent[..., 0])
    mine = angle.gather(2, first)
    at = first.transpose(1, 2)  # where j first meets i, on j's route: the same place unless they share a stretch
    theirs = angle[:, None].expand(-1, vehicles, -1, -1).gather(3, at[..., None])[..., 0]
    crossing = (theirs - mine + torch.pi) % (2 * torch.pi) - torch.pi
    return conflict, first * (SPACING * CONFLICT_STRIDE), crossing
