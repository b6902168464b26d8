"""The ego's mission, the route candidate that fits its recording, with speed limits and
end; traffic lights."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scenes.recording import LIGHT_RED, LIGHT_UNKNOWN, LIGHT_YELLOW
from e2rl.scenes.route import BEHIND, SPACING, project


def light_state_at(light_state: Tensor, light: Tensor, step: Tensor) -> Tensor:
    """States [B, ...] of the lights with indices light [B, ...] at steps [B];
    LIGHT_UNKNOWN where the index is -1.

    light_state [B, T + 1, S]: recorded states; the last one is held beyond the
    recording.
    """
    if not light_state.shape[-1]:
        return torch.full_like(light, LIGHT_UNKNOWN)
    row = torch.arange(step.shape[0], device=step.device)
    states = light_state[row, step.clamp(0, light_state.shape[1] - 1)]
    state = states.gather(1, light.clamp(min=0).flatten(1)).view(light.shape)
    return state.masked_fill(light < 0, LIGHT_UNKNOWN)


def lights_of(light_state: Tensor, light: Tensor) -> Tensor:
    """`light_state_at` at every step: [B, T + 1, K] of light [B, K]."""
    if not light_state.shape[-1]:
        return light.new_full((*light_state.shape[:2], light.shape[1]), LIGHT_UNKNOWN)
    state = light_state.gather(
        2, light.clamp(min=0)[:, None].expand(-1, light_state.shape[1], -1)
    )
    return state.masked_fill((light < 0)[:, None], LIGHT_UNKNOWN)


def stop_line_distance(
    state: Tensor,
    ahead: Tensor,
    *,
    speed: Tensor,
    red_braking: float,
    yellow_braking: float,
) -> Tensor:
    """Metres [...] to the next stop line that binds, inf for none. A vehicle that
    cannot halt in time continues.

    Args:
        state: [..., K] of K lights.
        ahead: [..., K] m, to their stop lines.
        speed: [...] m/s.
        red_braking, yellow_braking: m/s^2; a light binds if braking at less halts
            before its line.
    """
    needed = speed[..., None] ** 2 / (2 * ahead.clamp(min=1e-3))
    red = (state == LIGHT_RED) & (needed < red_braking)
    yellow = (state == LIGHT_YELLOW) & (needed < yellow_braking)
    return ahead.masked_fill(~((ahead > 0) & (red | yellow)), torch.inf).amin(-1)


def ran_red(
    light_state: Tensor,
    light: Tensor,
    *,
    line: Tensor,
    front: Tensor,
) -> Tensor:
    """Step [Q] int64 at which vehicles last crossed a stop line at red, -1 for never.

    Args:
        light_state: [Q, T + 1, S].
        light: [Q, K], indices of lights, -1 none.
        line: [Q, K] m, arc lengths of their stop lines.
        front: [Q, T + 1] m, arc length of the front bumper, on the same route.
    """
    crossed = (front[:, :-1, None] < line[:, None]) & (
        front[:, 1:, None] >= line[:, None]
    )
    wrong = crossed & (lights_of(light_state, light)[:, 1:] == LIGHT_RED)
    steps = torch.arange(1, front.shape[1], device=front.device)
    return torch.where(wrong.any(-1), steps, -1).amax(1)


class Mission(NamedTuple):
    """Mission routes of B scenes.

    points [B, P, 2]: vertices; limit [B, P]: speed limits [m/s], 0 unknown; end [B]:
    arc length [m] at which the map ends, else inf; light [B, 2]: indices of the lights,
    -1: none; light_s [B, 2]: arc lengths of their stop lines.
    """

    points: Tensor
    limit: Tensor
    end: Tensor
    light: Tensor
    light_s: Tensor


def mission_of(scene: TensorDictBase) -> Mission:
    """The ego's mission in scenes [B]: candidate route_log[0] of vehicle 0."""
    row = torch.arange(len(scene["route_log"]), device=scene["route_log"].device)
    pick = scene["route_log"][:, 0]

    def of(key: str) -> Tensor:
        return scene[key][row, 0, pick]

    end = of("route_length").masked_fill(~of("route_open"), torch.inf)
    return Mission(
        of("route_points"),
        of("route_limit"),
        end=end,
        light=of("route_light"),
        light_s=of("route_light_s"),
    )


def start_place(mission: Mission, state: Tensor) -> Tensor:
    """Arc length [B] m of egos at their start states [B, 4] on their missions, which
    begin at most BEHIND m before."""
    hint = torch.full_like(state[:, :1], BEHIND)
    return project(state[:, None, :2], mission.points, hint=hint)[0][:, 0]


def limit_at(mission: Mission, s: Tensor) -> Tensor:
    """Speed limit [B, ...] m/s at arc lengths s [B, ...], 0 where unknown."""
    index = (s / SPACING).round().long().clamp(0, mission.limit.shape[-1] - 1)
    return mission.limit.gather(1, index.view(s.shape[0], -1)).view(s.shape)
