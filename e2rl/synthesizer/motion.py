"""Coarse motion along routes, shared by feasibility, skeleton and anchoring: what a vehicle could reach and by when."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.route import interpolate, project
from e2rl.sim.world import World


def compact(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Slots of the true entries of mask [B, V]: index [B, M] int64 (ascending, true ones first), present [B, M] bool.

    M is the largest count of the batch, at least 1.
    """
    count = mask.sum(-1)
    width = max(int(count.max()), 1)
    index = torch.argsort(~mask, dim=-1, stable=True)[:, :width]
    return index, torch.arange(width, device=mask.device) < count[:, None]


def take(values: Tensor, index: Tensor) -> Tensor:
    """Rows index [B, M] of values [B, V, ...] -> [B, M, ...]."""
    shape = (*index.shape, *values.shape[2:])
    return values.gather(1, index.reshape(*index.shape, *[1] * (values.dim() - 2)).expand(shape))


def place(values: Tensor, routes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where states values [B, M, 4] lie on routes [B, M, R, P, 2].

    Returns arc length s [m], lateral offset d [m, left positive] and heading error [rad, in -pi..pi], each [B, M, R].
    """
    s, d, heading = project(values[:, :, None, None, :2], routes)
    error = torch.remainder(values[:, :, None, 2] - heading[..., 0] + torch.pi, 2 * torch.pi) - torch.pi
    return s[..., 0], d[..., 0], error


def fade(travelled: Tensor, speed: Tensor) -> Tensor:
    """Share of a lateral offset that is left after `travelled` m: quintic, done within 4 s of way (10 to 80 m)."""
    u = (travelled / (4 * speed).clamp(10.0, 80.0)).clamp(0, 1)
    return 1 - u**3 * (10 + u * (6 * u - 15))


def ride(route: Tensor, s: Tensor, d: Tensor, speed: Tensor) -> Tensor:
    """States [..., K, 4] at arc lengths s [..., K] of route [..., P, 2], offset d [..., K], with speed [..., K]."""
    xy, heading, _ = interpolate(route, s)
    normal = torch.stack([-heading.sin(), heading.cos()], -1)
    return torch.cat([xy + d[..., None] * normal, heading[..., None], speed.expand(s.shape)[..., None]], -1)


def cruise(scene: TensorDictBase, world: World, times: Tensor) -> Tensor:
    """Every vehicle at its present speed along the route it follows (straight on where it has none) -> [B, V, K, 4].

    times [K] s from now. The offset from the route fades as in the prior.
    """
    vehicles = scene["route_points"].shape[1]
    states = world.states[:, :vehicles]
    choice = world.route.clamp(min=0)[..., None]
    has = scene["route_valid"].gather(2, choice)[..., 0] & (world.route >= 0)
    route = scene["route_points"].gather(2, choice[..., None, None].expand(-1, -1, 1, *scene["route_points"].shape[3:]))
    route = route[:, :, 0]
    s, d, _ = project(states[:, :, None, :2], route)
    speed = states[..., 3:]
    travelled = speed * times
    riding = ride(route, s + travelled, d * fade(travelled, speed), speed)
    forward = torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)[:, :, None]
    rest = states[:, :, None, 2:].expand(*travelled.shape, 2)
    straight = torch.cat([states[:, :, None, :2] + travelled[..., None] * forward, rest], -1)
    return torch.where(has[..., None, None], riding, straight)


def arrival_window(distance: Tensor, speed: Tensor, brake: float, push: float, top: float) -> tuple[Tensor, Tensor]:
    """Earliest and latest time [s] at which a vehicle can be `distance` m further on (<= 0: now); latest is inf if it
    can stop before.

    brake, push > 0: largest deceleration and acceleration [m/s^2]; top: speed [m/s] above which it does not accelerate.
    """
    x = distance.clamp(min=0)
    cap = speed.clamp(min=top)
    ramp = (cap**2 - speed**2) / (2 * push)
    pushing = ((speed**2 + 2 * push * torch.minimum(x, ramp)).sqrt() - speed) / push
    earliest = pushing + (x - ramp).clamp(min=0) / cap
    rest = speed**2 - 2 * brake * x
    latest = torch.where((rest > 0) | (distance <= 0), (speed - rest.clamp(min=0).sqrt()) / brake, torch.inf)
    return earliest, torch.where(distance <= 0, 0.0, latest)


def reach(speed: Tensor, times: Tensor, brake: float, push: float, top: float) -> tuple[Tensor, Tensor]:
    """Least and largest way [m] that a vehicle can have gone after `times` s; arguments as in arrival_window."""
    stop = torch.minimum(times, speed / brake)
    least = speed * stop - 0.5 * brake * stop**2
    cap = speed.clamp(min=top)
    ramp = torch.minimum(times, (cap - speed) / push)
    return least, speed * ramp + 0.5 * push * ramp**2 + cap * (times - ramp)
