"""The red light that a proposal keeps (docs/adversaries.md)."""

import torch
from torch import Tensor

from e2rl.scene.route import project
from e2rl.sim.traffic_light import light_state_at, stop_line_distance
from e2rl.sim.world import World
from e2rl.synthesizer.motion import MAX_BRAKING, take

YELLOW_BRAKING = 3.0  # m/s^2 with which a vehicle halts at a yellow light, or else goes on


def way_to_stop_line(world: World, index: Tensor, number: Tensor) -> Tensor:
    """Metres [B, M, R] that vehicles index [B, M] may drive along candidates number [B, M, R] before their front is at
    a stop line that binds them now, inf for none."""
    scene, states = world.scene, take(world.states, index)
    at = (torch.arange(len(index), device=index.device)[:, None, None], index[..., None], number)
    light = light_state_at(scene["light_state"], scene["route_light"][at], world.step)
    front = project(states[:, :, None, None, :2], scene["route_points"][at])[0][..., 0]
    front = front + take(scene["size"], index)[..., None, 0] / 2
    ahead, speed = scene["route_light_s"][at] - front[..., None], states[:, :, None, 3].expand_as(front)
    return stop_line_distance(light, ahead, speed, MAX_BRAKING, YELLOW_BRAKING)
