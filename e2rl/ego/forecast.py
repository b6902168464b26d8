"""Forecasts of the agents nearest to the ego: their present acceleration and turn, each held for a while."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.sim.dynamics import MAX_CURVATURE, constant_velocity
from e2rl.sim.world import World

LOOK = (0.0, 1.0, 2.0, 3.0)  # s at which the nearest are looked for
SLOW = 1.0  # m/s below which a turn rate says little of the path's curvature


@dataclass
class Forecast:
    """M agents of each of B scenes: poses [B, M, T, 3], speed [B, M, T], size [B, M, 2], seen [B, M]: the row holds an
    agent."""

    poses: Tensor
    speed: Tensor
    size: Tensor
    seen: Tensor


def nearest(world: World, count: int, see_vrus: bool = True) -> tuple[Tensor, Tensor]:
    """Agents [B, M] that come nearest to the ego within 3 s if everybody keeps its velocity, and whether they are there
    [B, M]; M: count, or fewer where a scene has no more rows."""
    times = torch.tensor(LOOK, device=world.states.device)
    xy = constant_velocity(world.states, times)[..., :2]
    gap = (xy - xy[:, :1]).square().sum(-1).amin(-1)
    there = world.valid.clone()
    there[:, 0] = False
    if not see_vrus:
        there[:, world.scene["route_log"].shape[1] :] = False
    found = gap.masked_fill(~there, torch.inf).topk(min(count, gap.shape[1]), largest=False)
    return found.indices, found.values < torch.inf


def forecast(world: World, agents: Tensor, seen: Tensor, times: Tensor, hold: float, turn: float) -> Forecast:
    """The Forecast of agents [B, M] at times [T] s, evenly spaced from one spacing on.

    The acceleration is held for `hold` s (never beyond a halt), the path's curvature for `turn` s; then the speed and
    the heading stay.
    """
    row = torch.arange(len(agents), device=agents.device)[:, None]
    state, accel = world.states[row, agents], world.accel[row, agents]
    rate = torch.zeros_like(accel) if world.turn_rate is None else world.turn_rate[row, agents]
    step = times[0]
    nodes = torch.nn.functional.pad(times, (1, 0))
    speed = (state[..., 3:] + accel[..., None] * nodes.clamp(max=hold)).clamp(min=0)
    moved = (speed[..., 1:] + speed[..., :-1]) / 2 * step
    driven = torch.nn.functional.pad(moved.cumsum(-1), (1, 0))
    curvature = (rate / state[..., 3].clamp(min=SLOW)).clamp(-MAX_CURVATURE, MAX_CURVATURE)[..., None]
    most = torch.maximum(state[..., 3:], speed) * turn
    heading = state[..., 2:3] + curvature * torch.minimum(driven, most)
    middle = (heading[..., 1:] + heading[..., :-1]) / 2
    x = state[..., 0:1] + (moved * middle.cos()).cumsum(-1)
    y = state[..., 1:2] + (moved * middle.sin()).cumsum(-1)
    return Forecast(torch.stack([x, y, heading[..., 1:]], -1), speed[..., 1:], world.scene["size"][row, agents], seen)
