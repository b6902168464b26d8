"""The ego's mission: the route candidate that fits its recording, with limits, lights and its end."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.recording import LIGHT_RED, LIGHT_UNKNOWN, LIGHT_YELLOW
from e2rl.scene.route import SPACING


@dataclass
class Mission:
    """points [B, P, 2]; limit [B, P] m/s, 0 unknown; end [B]: arc length at which the map ends, inf where it does not;
    light [B, 2]: indices of its lights, -1 none; light_s [B, 2]: arc length of their stop lines."""

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


def light_now(mission: Mission, scene: TensorDictBase, step: Tensor) -> Tensor:
    """State [B, 2] of the mission's lights at step [B]; unknown where there is none."""
    states = scene["light_state"]
    if not states.shape[-1]:
        return torch.full_like(mission.light, LIGHT_UNKNOWN)
    step = step.clamp(0, states.shape[1] - 1)
    now = states[torch.arange(len(step), device=step.device), step]
    return now.gather(1, mission.light.clamp(min=0)).masked_fill(mission.light < 0, LIGHT_UNKNOWN)


def stop_ahead(
    mission: Mission, scene: TensorDictBase, step: Tensor, s: Tensor, speed: Tensor, braking: float
) -> Tensor:
    """Metres [B] from arc length s [B] to the next stop line to halt at, inf for none.

    Yellow binds where braking at `braking` m/s^2 from speed [B] still halts before the line, red where twice that does:
    who cannot halt goes on rather than stand in the junction.
    """
    state, ahead = light_now(mission, scene, step), mission.light_s - s[:, None]
    needed = speed[:, None] ** 2 / (2 * ahead.clamp(min=1e-3))
    red, yellow = (state == LIGHT_RED) & (needed < 2 * braking), (state == LIGHT_YELLOW) & (needed < braking)
    binds = (ahead > 0) & (red | yellow)
    return ahead.masked_fill(~binds, torch.inf).amin(1)
