"""Traffic light states: one look-up for planners, observations, features of the prior and metrics."""

import torch
from torch import Tensor

from e2rl.scene.recording import LIGHT_RED, LIGHT_UNKNOWN, LIGHT_YELLOW


def light_state_at(light_state: Tensor, light: Tensor, step: Tensor) -> Tensor:
    """States [B, ...] of the lights with indices light [B, ...] at steps [B]; LIGHT_UNKNOWN where the index is -1.

    light_state [B, T + 1, S]: recorded states; the last one is held beyond the recording.
    """
    if not light_state.shape[-1]:
        return torch.full_like(light, LIGHT_UNKNOWN)
    row = torch.arange(len(step), device=step.device)
    now = light_state[row, step.clamp(0, light_state.shape[1] - 1)]
    state = now.gather(1, light.clamp(min=0).flatten(1)).view(light.shape)
    return state.masked_fill(light < 0, LIGHT_UNKNOWN)


def stop_line_distance(
    state: Tensor, ahead: Tensor, speed: Tensor, red_braking: float, yellow_braking: float
) -> Tensor:
    """Metres [...] to the next stop line that binds, inf for none; state, ahead [..., K]: of K lights.

    A red light binds if braking at less than red_braking m/s^2 from speed [...] m/s halts before its line, a yellow
    light at less than yellow_braking. A vehicle that cannot halt in time continues.
    """
    needed = speed[..., None] ** 2 / (2 * ahead.clamp(min=1e-3))
    red, yellow = (state == LIGHT_RED) & (needed < red_braking), (state == LIGHT_YELLOW) & (needed < yellow_braking)
    return ahead.masked_fill(~((ahead > 0) & (red | yellow)), torch.inf).amin(-1)


def ran_red(light_state: Tensor, light: Tensor, line: Tensor, front: Tensor) -> Tensor:
    """Step [Q] int64 at which vehicles last crossed a stop line at red, -1 for never.

    light_state [Q, T + 1, S]; light, line [Q, K]: indices of lights (-1 none) and arc lengths of their stop lines;
    front [Q, T + 1]: arc length of the front bumper, on the same route.
    """
    if not light_state.shape[-1]:
        return torch.full_like(light[:, 0], -1)
    state = light_state.gather(2, light.clamp(min=0)[:, None].expand(-1, front.shape[1], -1))
    crossed = (front[:, :-1, None] < line[:, None]) & (front[:, 1:, None] >= line[:, None])
    wrong = crossed & (state[:, 1:] == LIGHT_RED) & (light >= 0)[:, None]
    steps = torch.arange(1, front.shape[1], device=front.device)
    return torch.where(wrong.any(-1), steps, -1).amax(1)
