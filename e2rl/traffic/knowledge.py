"""What traffic knows of the ego: what other drivers see, or the plan that it announces (docs/adversaries.md).

A black box announces nothing. With `predicted`, the ego's motion is predicted from its state and past alone, so that no
planner can mislead its adversaries by what it writes as its plan.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from e2rl.ego.path import MissionPath
from e2rl.prior.lane_relative import HORIZON
from e2rl.scene.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.world import World

KNOWLEDGE = ("predicted", "plan")
EASING = 0.5  # s in which a seen acceleration fades: of 0.5, 1 and 2 s that of least error


def turn_rate_and_acceleration(world: World) -> Tensor:
    """States [B, HORIZON, 4] of the ego at its present acceleration and yaw rate."""
    assert world.turn_rate is not None
    action = torch.stack([world.accel[:, 0], world.turn_rate[:, 0]], -1)
    return dynamics.rollout(world.states[:, 0], action[:, None].expand(-1, HORIZON, -1))


def along_mission(world: World) -> Tensor:
    """States [B, HORIZON, 4] of the ego along its mission, its acceleration fading over EASING s."""
    time = DT * torch.arange(HORIZON + 1, device=world.states.device)
    gained = EASING * (1 - torch.exp(-time / EASING))
    return MissionPath(world).drive((world.states[:, 0, 3:] + world.accel[:, :1] * gained).clamp(min=0))


# Predictions without a network; `prior` is NominalTraffic's own: the ego's row of the joint estimate.
PREDICTIONS: dict[str, Callable[[World], Tensor] | None] = {
    "prior": None,
    "mission": along_mission,
    "ctra": turn_rate_and_acceleration,
}
