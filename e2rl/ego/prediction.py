"""Predicted trajectories of the other agents: every matched route at several speeds (STRIVE's planner)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.ego.path import RoutePath
from e2rl.sim.world import World


@dataclass
class Prediction:
    """J predicted trajectories of all scenes: poses [J, T, 3] from now on, size [J, 2], scene [J] int64."""

    poses: Tensor
    size: Tensor
    scene: Tensor


def predict(
    world: World,
    steps: int,
    dt: float,
    speed_factors: tuple[float, ...],
    acceleration: float,
    reach: float,
    match_distance: float,
    match_angle: float,
    see_vrus: bool,
) -> Prediction:
    """Trajectories of `steps` steps of dt of the agents within `reach` m of the ego.

    A vehicle follows each matched route candidate (nearer than match_distance m, heading within match_angle degrees),
    or its heading without a match; other agents keep their heading (omitted without see_vrus). Each agent is predicted
    at each speed factor times its speed, approached at `acceleration` m/s^2.
    """
    states, vehicles = world.states, world.scene["route_log"].shape[1]
    near = (states[..., :2] - states[:, :1, :2]).norm(dim=-1) < reach
    seen = world.valid & near
    seen[:, 0] = False
    if not see_vrus:
        seen[:, vehicles:] = False
    batch, agent, candidate = (seen[:, :vehicles, None] & world.scene["route_valid"]).nonzero(as_tuple=True)
    path = RoutePath(states[batch, agent], world.scene["route_points"][batch, agent, candidate])
    on = (path.d.abs() < match_distance) & (path.turned.abs() < torch.pi * match_angle / 180)
    batch, agent, candidate = batch[on], agent[on], candidate[on]
    straight = seen.clone()
    straight[batch, agent] = False
    lost_batch, lost_agent = straight.nonzero(as_tuple=True)
    path = RoutePath(states[batch, agent], world.scene["route_points"][batch, agent, candidate])
    poses = torch.cat(
        [
            path.at(ahead(states[batch, agent, 3], steps, dt, speed_factors, acceleration).flatten(1)),
            straight_on(
                states[lost_batch, lost_agent],
                ahead(states[lost_batch, lost_agent, 3], steps, dt, speed_factors, acceleration).flatten(1),
            ),
        ]
    )
    batch, agent = torch.cat([batch, lost_batch]), torch.cat([agent, lost_agent])
    count = len(speed_factors)
    return Prediction(
        poses.view(-1, steps + 1, 3),
        world.scene["size"][batch, agent].repeat_interleave(count, 0),
        batch.repeat_interleave(count),
    )


def ahead(speed: Tensor, steps: int, dt: float, factors: tuple[float, ...], acceleration: float) -> Tensor:
    """Metres [J, F, steps + 1] driven from speed [J] while it approaches each factor times speed."""
    aims = speed[:, None, None] * speed.new_tensor(factors)[:, None]
    change = acceleration * dt * torch.arange(1, steps + 1, device=speed.device, dtype=speed.dtype)
    start = speed[:, None, None]
    future = torch.where(aims < start, torch.maximum(aims, start - change), torch.minimum(aims, start + change))
    return torch.nn.functional.pad((future * dt).cumsum(-1), (1, 0))


def straight_on(state: Tensor, distance: Tensor) -> Tensor:
    """Poses [J, K, 3] at distance [J, K] along the heading of state [J, 4]."""
    heading = state[:, 2:3]
    way = torch.stack([heading.cos(), heading.sin()], -1) * distance[..., None]
    return torch.cat([state[:, None, :2] + way, heading[..., None].expand(*distance.shape, 1)], -1)
