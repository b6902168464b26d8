"""What feasibility, skeleton and anchoring have in common: picking vehicles, and coarse
motion along routes.

The red light that a proposal keeps (docs/reference/attack.md).
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import lateral_horizon
from e2rl.prior.routes import take_route
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.route import interpolate, project
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import light_state_at, stop_line_distance
from e2rl.sim.world import World

# What any vehicle is assumed to be able to do: the braking and acceleration of a
# passenger car, urban speeds.
MAX_BRAKING = 5.0  # m/s^2
MAX_ACCELERATION = 4.0  # m/s^2
TOP_SPEED = 25.0  # m/s up to which vehicles accelerate; a faster one keeps its speed


def compact(mask: Tensor) -> tuple[Tensor, Tensor]:
    """The true entries of mask [B, V] as slots: index [B, M] int64 (ascending, true
    ones first), present [B, M] bool; M is the largest count, at least 1."""
    count = mask.sum(-1)
    width = max(int(count.max()), 1)
    index = torch.argsort(~mask, dim=-1, stable=True)[:, :width]
    return index, torch.arange(width, device=mask.device) < count[:, None]


def take(values: Tensor, index: Tensor) -> Tensor:
    """Rows index [B, M] of values [B, V, ...] -> [B, M, ...]."""
    return values.gather(1, _wide(index, values).expand(-1, -1, *values.shape[2:]))


def put(values: Tensor, index: Tensor, mask: Tensor, rows: Tensor) -> Tensor:
    """Returns values with some rows replaced.

    Args:
        values: [B, V, ...].
        index: [B, M] int64, of the rows.
        mask: [B, M] bool, which of them are replaced.
        rows: [B, M, ...], the new ones.
    """
    place = _wide(index, values).expand(-1, -1, *values.shape[2:])
    new = torch.where(_wide(mask, values), rows, values.gather(1, place))
    return values.scatter(1, place, new)


def _wide(rows: Tensor, values: Tensor) -> Tensor:
    """rows [B, M] with as many axes as values [B, V, ...]."""
    return rows.reshape(*rows.shape, *[1] * (values.dim() - 2))


def smallest(mask: Tensor, key: Tensor, count: Tensor | int) -> Tensor:
    """The `count` [...] (or one for all) members of mask [..., V] of smallest key [...,
    V]; ties by index."""
    order = key.masked_fill(~mask, torch.inf).argsort(dim=-1, stable=True)
    return mask & (
        order.argsort(-1) < torch.as_tensor(count, device=key.device)[..., None]
    )


def frenet_pose(states: Tensor, routes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """s, offset [m] and heading error [rad], each [B, M, R], of states [B, M, 4] on
    routes [B, M, R, P, 2]."""
    s, d, heading = project(states[:, :, None, None, :2], routes)
    return s[..., 0], d[..., 0], wrap(states[:, :, None, 2] - heading[..., 0])


def remaining_offset(travelled: Tensor, speed: Tensor) -> Tensor:
    """Fraction of a lateral offset that is left after `travelled` m: a quintic over the
    prior's lateral horizon."""
    u = (travelled / lateral_horizon(speed)).clamp(0, 1)
    return 1 - u**3 * (10 + u * (6 * u - 15))


def states_on_route(route: Tensor, s: Tensor, d: Tensor, speed: Tensor) -> Tensor:
    """Returns the states [..., K, 4] of vehicles on routes.

    Args:
        route: [..., P, 2] m.
        s: [..., K] m, arc length.
        d: [..., K] m, lateral offset.
        speed: m/s, of the shape of s or broadcast to it.
    """
    xy, heading, _ = interpolate(route, s)
    normal = torch.stack([-heading.sin(), heading.cos()], -1)
    speed = speed.expand(s.shape)[..., None]
    return torch.cat([xy + d[..., None] * normal, heading[..., None], speed], -1)


def constant_speed_states(scene: TensorDictBase, world: World, times: Tensor) -> Tensor:
    """States [B, V, K, 4] of vehicles after `times` [K] s at present speed, along their
    routes, else straight on; lateral offsets vanish as in the prior's plans."""
    states = world.states[:, : scene["route_points"].shape[1]]
    assert world.route is not None
    chosen = world.route.clamp(min=0)
    has_route = take_route(scene["route_valid"], chosen) & (world.route >= 0)
    route = take_route(scene["route_points"], chosen)
    s, d, _ = project(states[:, :, None, :2], route)
    speed = states[..., 3:]
    travelled = speed * times
    along = states_on_route(
        route,
        s + travelled,
        d=d * remaining_offset(travelled, speed),
        speed=speed,
    )
    xy = (
        states[:, :, None, :2]
        + travelled[..., None] * unit_vectors(states[..., 2])[:, :, None]
    )
    straight = torch.cat([xy, states[:, :, None, 2:].expand(*travelled.shape, 2)], -1)
    return torch.where(has_route[..., None, None], along, straight)


def arrival_window(
    distance: Tensor,
    speed: Tensor,
    acceleration: float = MAX_ACCELERATION,
) -> tuple[Tensor, Tensor]:
    """Earliest and latest time [s] at which a vehicle at `speed` can have driven
    `distance` m (0 for distances <= 0).

    The earliest is at full acceleration up to TOP_SPEED; the latest at full braking,
    inf where it can stop before.
    """
    x = distance.clamp(min=0)
    cap = speed.clamp(min=TOP_SPEED)
    ramp = (cap**2 - speed**2) / (2 * acceleration)
    accelerating = (
        (speed**2 + 2 * acceleration * torch.minimum(x, ramp)).sqrt() - speed
    ) / acceleration
    earliest = accelerating + (x - ramp).clamp(min=0) / cap
    rest = speed**2 - 2 * MAX_BRAKING * x
    latest = torch.where(
        (rest > 0) | (distance <= 0),
        (speed - rest.clamp(min=0).sqrt()) / MAX_BRAKING,
        torch.inf,
    )
    return earliest, torch.where(distance <= 0, 0.0, latest)


def reachable_distance(speed: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest distance [m] that a vehicle at `speed` can have driven after
    `times` s."""
    stop = torch.minimum(times, speed / MAX_BRAKING)
    least = speed * stop - 0.5 * MAX_BRAKING * stop**2
    cap = speed.clamp(min=TOP_SPEED)
    ramp = torch.minimum(times, (cap - speed) / MAX_ACCELERATION)
    return least, speed * ramp + 0.5 * MAX_ACCELERATION * ramp**2 + cap * (times - ramp)


# m/s^2 with which a vehicle halts at a yellow light, or else goes on.
YELLOW_BRAKING = 3.0


def distance_to_stop_line(world: World, index: Tensor, number: Tensor) -> Tensor:
    """Metres [B, M, R] that vehicles index [B, M] may drive along candidates number [B,
    M, R] before their front is at a stop line that binds them now, inf for none."""
    scene = world.scene
    states = take(world.states, index)
    at = (
        torch.arange(len(index), device=index.device)[:, None, None],
        index[..., None],
        number,
    )
    light = light_state_at(
        scene["light_state"],
        scene["route_light"][at],
        step=world.step,
    )
    front = project(states[:, :, None, None, :2], scene["route_points"][at])[0][..., 0]
    front = front + take(scene["size"], index)[..., None, 0] / 2
    ahead = scene["route_light_s"][at] - front[..., None]
    speed = states[:, :, None, 3].expand_as(front)
    return stop_line_distance(
        light,
        ahead,
        speed=speed,
        red_braking=MAX_BRAKING,
        yellow_braking=YELLOW_BRAKING,
    )
