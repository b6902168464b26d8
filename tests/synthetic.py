"""Scenes with known answers: a straight two-lane road along +x, every key of the scene
contract present."""

import math

import torch
from tensordict import TensorDict

from e2rl.scenes.recording import DT, LIGHT_UNKNOWN, PEDESTRIAN, VEHICLE
from e2rl.scenes.route import SPACING
from e2rl.scenes.scene import SceneSet

LANE_WIDTH = (
    3.5  # m; lane 0 at y = 0, lane 1 (its left neighbour) at y = 3.5, both towards +x
)
MARGIN = 1.0  # m beyond a lane's half width that still counts as on the road (docs/reference/scenes.md)
BACK = 20.0  # m of route behind each vehicle


def make_scenes(
    num_scenes: int = 2,
    num_vehicles: int = 3,
    num_vrus: int = 1,
    speed: float = 10.0,
    gap: float = 20.0,
    steps: int = 80,
    limit: float = 15.0,
    vehicles: list[tuple[float, int, float]] | None = None,
    red_light_x: float | None = None,
    road: tuple[float, float] = (-60.0, 400.0),
    max_vehicles: int = 32,
    max_agents: int = 48,
    num_routes: int = 6,
    num_points: int = 150,
) -> SceneSet:
    """Scenes at constant logged velocity; scene k starts k metres further on, so scenes
    can be told apart.

    Vehicle i starts at x = gap * i in lane i % 2 at `speed` unless `vehicles` lists (x
    [m], lane, speed [m/s]) of each, ego first; a speed of 0 makes it parked (the ego
    excepted). VRU j walks along the road at y = -6 m, off it. red_light_x: stop line on
    both lanes, red throughout. road: x at which the map begins and ends.
    """
    if vehicles is None:
        vehicles = [(gap * i, i % 2, speed) for i in range(num_vehicles)]
    x, lane, v = (
        torch.tensor(column, dtype=torch.float32)
        for column in zip(*vehicles, strict=True)
    )
    if len(vehicles) > max_vehicles or num_vrus > max_agents - max_vehicles:
        raise ValueError(
            f"{len(vehicles)} vehicles, {num_vrus} VRUs exceed {max_vehicles}, {max_agents} rows"
        )
    shift = torch.arange(num_scenes, dtype=torch.float32)[:, None]
    start = torch.zeros(num_scenes, max_agents, 4)
    n = len(vehicles)
    u = max_vehicles + num_vrus
    start[:, :n, 0], start[:, :n, 1], start[:, :n, 3] = x + shift, lane * LANE_WIDTH, v
    start[:, max_vehicles:u, 0] = 15.0 * torch.arange(1, num_vrus + 1) + shift
    start[:, max_vehicles:u, 1], start[:, max_vehicles:u, 3] = -6.0, 1.0
    valid = torch.zeros(num_scenes, max_agents, dtype=torch.bool)
    valid[:, :n] = valid[:, max_vehicles:u] = True
    logged = start[:, None].repeat(1, steps + 1, 1, 1)
    logged[..., 0] += start[:, None, :, 3] * DT * torch.arange(steps + 1)[:, None]
    size = torch.tensor([4.5, 2.0]).repeat(num_scenes, max_agents, 1)
    size[:, max_vehicles:] = 0.7
    kind = torch.full((num_scenes, max_agents), VEHICLE)
    kind[:, max_vehicles:] = PEDESTRIAN
    parked = valid & (start[..., 3] == 0) & (kind == VEHICLE)
    parked[:, 0] = False
    zeros = torch.zeros(num_scenes, max_agents)
    scenes = {
        "start": start,
        "start_accel": zeros,
        "start_yaw_rate": zeros.clone(),
        "past": _past(start[:, :max_vehicles]),
        "valid": valid,
        "size": size,
        "agent_type": kind,
        "parked": parked,
        "logged": logged,
        "logged_valid": valid[:, None].repeat(1, steps + 1, 1),
        "scene_index": torch.arange(num_scenes),
    }
    cars = start[:, :max_vehicles], valid[:, :max_vehicles]
    scenes |= _routes(*cars, num_routes, num_points, limit, red_light_x, road)
    scenes |= {
        key: value.expand(num_scenes, *value.shape).clone()
        for key, value in _map(road).items()
    }
    scenes |= _lights(num_scenes, steps, red_light_x=red_light_x)
    return SceneSet(
        scenes=TensorDict(scenes, [num_scenes]),
        scene_id=[f"synthetic-{k}" for k in range(num_scenes)],
        location=["straight"] * num_scenes,
        dataset="synthetic",
        split="test",
        dropped={},
    )


def _past(start):
    """Everybody came straight on."""
    past = torch.zeros(*start.shape[:2], 10, 3)
    past[..., 0] = -start[..., 3:] * DT * torch.arange(1, 11)
    return past


def _routes(start, valid, num_routes, num_points, limit, red_light_x, road):
    """One candidate per vehicle, its own lane; the map ends where the road does."""
    shape = (*valid.shape, num_routes)
    arc = SPACING * torch.arange(num_points)
    begin = (start[..., 0] - BACK).clamp(min=road[0])
    x = begin[..., None] + arc
    points = torch.stack([x, start[..., 1, None].expand_as(x)], -1)
    first = torch.zeros(shape, dtype=torch.bool)
    first[..., 0] = valid
    length = (road[1] - begin).clamp(0, arc[-1].item())
    light = torch.full((*shape, 2), -1)
    light_s = torch.zeros((*shape, 2))
    if red_light_x is not None:
        light_s[..., 0] = (red_light_x - begin)[..., None]
        light[..., 0] = torch.where(
            first & (light_s[..., 0] > 0) & (light_s[..., 0] < length[..., None]), 0, -1
        )
    return {
        "route_points": points[:, :, None].repeat(1, 1, num_routes, 1, 1),
        "route_length": length[..., None].repeat(1, 1, num_routes),
        "route_open": first & (length < arc[-1].item())[..., None],
        "route_valid": first,
        "route_recorded": torch.zeros_like(first),
        "route_limit": torch.full((*shape, num_points), limit),
        "route_light": light,
        "route_light_s": light_s,
        "route_log": torch.where(valid, 0, -1),
    }


def _lights(num_scenes, steps, red_light_x):
    x, state = (0.0, LIGHT_UNKNOWN) if red_light_x is None else (red_light_x, 1)
    return {
        "light_state": torch.full((num_scenes, steps + 1, 1), state),
        "light_points": torch.tensor([[x, 0.0]]).repeat(num_scenes, 1, 1),
    }


def _map(road):
    """Two lanes, the rectangle they cover, and its exact distance field of
    docs/reference/scenes.md."""
    x = torch.arange(road[0], road[1] + 1e-6, SPACING)
    y = torch.tensor([0.0, LANE_WIDTH])
    lane = torch.stack([x.repeat(2), y.repeat_interleave(len(x))], -1)
    low = -LANE_WIDTH / 2
    high = 1.5 * LANE_WIDTH
    polygon = torch.tensor(
        [[road[0], low], [road[1], low], [road[1], high], [road[0], high]]
    )
    cells = math.ceil(road[1] - road[0]) + 41
    origin = torch.tensor([road[0] - 20.0, -cells // 2])
    centre = torch.arange(cells, dtype=torch.float32)
    gx, gy = torch.meshgrid(centre + origin[0], centre + origin[1], indexing="ij")
    along = torch.maximum(road[0] - gx, gx - road[1])
    across = torch.maximum(low - gy, gy - high)
    polygon_gap = torch.hypot(along.clamp(min=0), across.clamp(min=0)) + torch.maximum(
        along, across
    ).clamp(max=0)
    lane_gap = torch.hypot(along.clamp(min=0)[..., None], gy[..., None] - y).amin(
        -1
    ) - (LANE_WIDTH / 2 + MARGIN)
    field = torch.minimum(polygon_gap, lane_gap)
    return {
        "lane_points": lane,
        "lane_index": torch.arange(2).repeat_interleave(len(x)),
        "lane_width": torch.full((2,), LANE_WIDTH),
        "lane_exits": torch.full((2, 6), -1),
        "lane_left": torch.tensor([1, -1]),
        "lane_right": torch.tensor([-1, 0]),
        "drivable_points": polygon,
        "drivable_index": torch.zeros(4, dtype=torch.long),
        "field": field.clamp(max=10.0).half(),
        "field_origin": origin,
    }
