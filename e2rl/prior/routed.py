"""What of a scene stays the same while it runs, once every vehicle has a route: worked out once per scene."""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.route import SPACING
from e2rl.sim.dynamics import wrap

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
    everybody = torch.arange(vehicles, device=points.device)
    pairs = [_conflicts(scene_points, everybody)[0] for scene_points in points]
    conflict, conflict_s, crossing = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    both = valid & ~parked & has_lane
    conflict = conflict & both[:, :, None] & both[:, None, :]
    return RoutedScene(
        scene["size"],
        scene["light_state"],
        route,
        points,
        take_route(scene["route_length"], route),
        take_route(scene["route_open"], route),
        take_route(scene["route_limit"], route),
        take_route(scene["route_light"], route),
        take_route(scene["route_light_s"], route),
        conflict,
        conflict_s,
        crossing,
        valid & ~parked,
        parked,
        has_lane & (not free_space),
        scene["past"][:, :vehicles],
    )


def reroute(
    routed: RoutedScene,
    scene: TensorDictBase,
    route: Tensor,
    who: Tensor,
    leaves: Tensor,
    ways: Tensor,
    free_space: bool = False,
) -> RoutedScene:
    """`routed` with vehicles who [B, V] on other lines: their candidates route [B, V], or, for those that leave their
    lanes [B, V], ways [B, V, P, 2]. On a way there are no lights; its limit is the highest of the candidate's."""
    off = leaves & who
    keys = ("points", "length", "open", "limit", "light", "light_s", "valid")
    lane = {key: take_route(scene[f"route_{key}"], route) for key in keys}

    def change(old: Tensor, lane: Tensor, way: Tensor | float) -> Tensor:
        extra = [1] * (old.dim() - 2)
        new = torch.where(off.view(*off.shape, *extra), torch.as_tensor(way, dtype=old.dtype, device=old.device), lane)
        return torch.where(who.view(*who.shape, *extra), new, old)

    points = change(routed.points, lane["points"], ways)
    pairs = [value.clone() for value in (routed.conflict, routed.conflict_s, routed.crossing)]
    for b in who.any(1).nonzero()[:, 0].tolist():
        rows = who[b].nonzero()[:, 0]
        for old, mine, theirs in zip(pairs, *_conflicts(points[b], rows), strict=True):
            old[b][:, rows], old[b][rows] = theirs.T, mine
    both = routed.modelled & lane["valid"]
    return replace(
        routed,
        route=torch.where(who, route, routed.route),
        points=points,
        length=change(routed.length, lane["length"], SPACING * (points.shape[2] - 1)),
        open=change(routed.open, lane["open"], False),
        limit=change(routed.limit, lane["limit"], lane["limit"].amax(-1, keepdim=True)),
        light=change(routed.light, lane["light"], -1),
        light_s=change(routed.light_s, lane["light_s"], 0.0),
        conflict=pairs[0] & both[:, :, None] & both[:, None],
        conflict_s=pairs[1],
        crossing=pairs[2],
        has_lane=change(routed.has_lane, lane["valid"] & (not free_space), not free_space),
    )


def _conflicts(points: Tensor, rows: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """First meetings of routes rows [C] with every route of points [V, P, 2], a scene at a time (its pairs stay in the
    cache): conflict, conflict_s and crossing (see RoutedScene) of each of rows with each [C, V], and of each [V] with
    each of rows, also as [C, V]."""
    line = points[:, :CONFLICT_RANGE:CONFLICT_STRIDE]
    vehicles, count, _ = line.shape
    flat = line.reshape(-1, 2)
    flat = flat - flat.mean(0)
    near = torch.cdist(flat.view(vehicles, count, 2)[rows].flatten(0, 1), flat) < CONFLICT_GAP
    near = near.view(len(rows), count, vehicles, count)
    meets = near.any(3)  # [C, K, V]: this vertex of a row's route meets the other somewhere
    first, other = meets.float().argmax(1), near.any(1).float().argmax(2)  # the same place unless they share a stretch
    conflict = meets.any(1) & (rows[:, None] != torch.arange(vehicles, device=rows.device))
    tangent = torch.gradient(line, dim=1)[0]
    angle = torch.atan2(tangent[..., 1], tangent[..., 0])
    theirs = angle.gather(1, other.T).T
    crossing = (theirs - angle[rows].gather(1, first) + torch.pi) % (2 * torch.pi) - torch.pi
    way = SPACING * CONFLICT_STRIDE
    return (conflict, first * way, crossing), (conflict, other * way, wrap(-crossing))
