"""The ego's mission: the route candidate that fits its recording, with speed limits, lights and end."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.route import SPACING
from e2rl.sim.traffic_light import light_state_at, stop_line_distance


class Mission(NamedTuple):
    """Mission routes of B scenes.

    points [B, P, 2]: vertices; limit [B, P]: speed limits [m/s], 0 unknown; end [B]: arc length [m] at which the map
    ends, else inf; light [B, 2]: indices of the lights, -1: none; light_s [B, 2]: arc lengths of their stop
    lines.
    """

    points: Tensor
    limit: Tensor
    end: Tensor
    light: Tensor
    light_s: Tensor


def mission_of(scene: TensorDictBase) -> Mission:
    """The ego's mission in scenes [B]: candidate route_log[0] of vehicle 0."""
    row = torch.arange(scene.batch_size[0], device=scene["route_log"].device)
    pick = scene["route_log"][:, 0]

    def of(key: str) -> Tensor:
        return scene[key][row, 0, pick]

    end = of("route_length").masked_fill(~of("route_open"), torch.inf)
    return Mission(of("route_points"), of("route_limit"), end, of("route_light"), of("route_light_s"))


def limit_at(mission: Mission, s: Tensor) -> Tensor:
    """Speed limit [B, ...] m/s at arc lengths s [B, ...], 0 where unknown."""
    index = (s / SPACING).round().long().clamp(0, mission.limit.shape[-1] - 1)
    return mission.limit.gather(1, index.view(len(s), -1)).view(s.shape)


def stop_ahead(
    mission: Mission, scene: TensorDictBase, step: Tensor, s: Tensor, speed: Tensor, braking: float
) -> Tensor:
    """Metres [B] from arc length s [B] to the next stop line that binds, inf for none.

    A yellow light binds if braking at `braking` m/s^2 from speed [B] halts before the line, a red light if braking at
    twice that does.
    """
    state = light_state_at(scene["light_state"], mission.light, step)
    return stop_line_distance(state, mission.light_s - s[:, None], speed, 2 * braking, braking)
