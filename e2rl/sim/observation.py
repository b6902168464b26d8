"""What a learned ego sees: an ego-centred vector of OBSERVATION_SIZE numbers of order one.

Blocks: ego (11), mission route ahead (12 x 5), lights (2 x 4), drivable probes (5 x 5), nearest agents (12 x 15).
"""

import torch
from torch import Tensor

from e2rl.scene.recording import VEHICLE
from e2rl.scene.route import interpolate
from e2rl.sim.drivable import off_road
from e2rl.sim.dynamics import wrap
from e2rl.sim.geometry import separation, to_frame
from e2rl.sim.mission import Mission, light_now, limit_at
from e2rl.sim.world import World

LOOK_AHEAD = (2.0, 4.0, 7.0, 10.0, 14.0, 19.0, 25.0, 32.0, 40.0, 50.0, 62.0, 75.0)  # m along the mission
PROBE_X, PROBE_Y = (-3.0, 0.0, 5.0, 11.0, 20.0), (-5.0, -2.5, 0.0, 2.5, 5.0)  # m in the ego's frame
NEAREST = 12  # agents
SPEED, FAR, NEAR = 15.0, 40.0, 10.0  # scales: m/s, m, m
OBSERVATION_SIZE = 11 + 5 * len(LOOK_AHEAD) + 8 + len(PROBE_X) * len(PROBE_Y) + 15 * NEAREST


def observe(world: World, mission: Mission, place: tuple[Tensor, Tensor, Tensor], action: Tensor) -> Tensor:
    """Observation [B, OBSERVATION_SIZE] of a World.

    place: the ego's arc length, offset and route heading, each [B]; action [B, 2]: the last one executed.
    """
    ego = world.states[:, 0]
    return torch.cat([
        ego_features(world, mission, place, action),
        route_features(ego, mission, place[0]),
        light_features(world, mission, place[0]),
        probe_features(world, ego),
        agent_features(world),
    ], -1)


def ego_features(world: World, mission: Mission, place: tuple[Tensor, Tensor, Tensor], action: Tensor) -> Tensor:
    """[B, 11]: speed, last action, lane pose, speed limit, way left before the map ends, size, time."""
    s, d, heading = place
    ego, scene = world.states[:, 0], world.scene
    turned = wrap(ego[:, 2] - heading)
    limit = limit_at(mission, s)
    horizon = scene["logged"].shape[1] - 1
    return torch.stack([
        ego[:, 3] / SPEED, action[:, 0] / 4, action[:, 1], (d / 3).clamp(-2, 2), turned.sin(), turned.cos(),
        limit / SPEED, ((mission.end - s) / 100).clamp(0, 1), scene["size"][:, 0, 0] / 5, scene["size"][:, 0, 1] / 2,
        world.step / horizon,
    ], -1)


def route_features(ego: Tensor, mission: Mission, s: Tensor) -> Tensor:
    """[B, 12 * 5]: mission points ahead in the ego's frame, relative heading, curvature, speed limit."""
    at = s[:, None] + s.new_tensor(LOOK_AHEAD)
    xy, heading, curvature = interpolate(mission.points, at)
    local = to_frame(xy, ego[:, None])
    turned = wrap(heading - ego[:, None, 2])
    return torch.stack([
        local[..., 0] / FAR, local[..., 1] / NEAR, turned.sin(), (10 * curvature).clamp(-2, 2),
        limit_at(mission, at) / SPEED,
    ], -1).clamp(-5, 5).flatten(1)


def light_features(world: World, mission: Mission, s: Tensor) -> Tensor:
    """[B, 2 * 4]: the mission's lights red, yellow, green (one-hot while ahead) and how near (1 at hand, 0 far)."""
    state, ahead = light_now(mission, world.scene, world.step), mission.light_s - s[:, None]
    seen = ((mission.light >= 0) & (ahead > -2)).float()
    colours = torch.nn.functional.one_hot(state, 4)[..., 1:] * seen[..., None]
    near = seen * (-ahead.clamp(min=0) / 30).exp()
    return torch.cat([colours, near[..., None]], -1).flatten(1)


def probe_features(world: World, ego: Tensor) -> Tensor:
    """[B, 25]: drivable field at a grid of points around and ahead of the ego."""
    grid = torch.cartesian_prod(ego.new_tensor(PROBE_X), ego.new_tensor(PROBE_Y))
    cos, sin = ego[:, 2, None].cos(), ego[:, 2, None].sin()
    x, y = grid.unbind(-1)
    points = ego[:, None, :2] + torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
    value = off_road(points, world.scene["field"], world.scene["field_origin"])
    return (value / 4).clamp(-1, 1)


def agent_features(world: World) -> Tensor:
    """[B, 12 * 15]: nearest agents; present, relative pose and velocity, speed, acceleration, size, type, gap and
    closest approach at constant velocities (method_and_baselines.md 8.5, fixed form). Absent agents are zeros."""
    ego, others = world.states[:, :1], world.states[:, 1:]
    valid = world.valid[:, 1:]
    apart = (others[..., :2] - ego[..., :2]).square().sum(-1).masked_fill(~valid, torch.inf)
    count = min(NEAREST, others.shape[1])
    index = apart.topk(count, dim=1, largest=False).indices

    def near(value: Tensor) -> Tensor:
        place = index.view(*index.shape, *[1] * (value.ndim - 2)).expand(*index.shape, *value.shape[2:])
        return value[:, 1:].gather(1, place)

    state, size, kind = near(world.states), near(world.scene["size"]), near(world.scene["agent_type"])
    delta = to_frame(state[..., :2], ego)
    turned = state[..., 2] - ego[..., 2]
    velocity = torch.stack([state[..., 3] * turned.cos() - ego[..., 3], state[..., 3] * turned.sin()], -1)
    time = (-(delta * velocity).sum(-1) / (velocity.square().sum(-1) + 1e-3)).clamp(0, 8)
    miss = (delta + velocity * time[..., None]).norm(dim=-1)
    gap = separation(ego, world.scene["size"][:, :1], state, size)
    vehicle = kind == VEHICLE
    features = torch.stack([
        torch.ones_like(gap), delta[..., 0] / FAR, delta[..., 1] / NEAR, turned.cos(), turned.sin(),
        velocity[..., 0] / SPEED, velocity[..., 1] / SPEED, state[..., 3] / SPEED, near(world.accel) / 4,
        size[..., 0] / 5, size[..., 1] / 2, vehicle.float(), (gap / NEAR).clamp(-1, 2), (-time / 2).exp(),
        (-miss / 5).exp(),
    ], -1).clamp(-5, 5) * near(world.valid)[..., None]
    missing = NEAREST - count
    return torch.nn.functional.pad(features, (0, 0, 0, missing)).flatten(1)
