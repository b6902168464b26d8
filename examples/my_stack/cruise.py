"""A planner: it drives along its mission, holding its speed or braking for whoever is
near on its path."""

import torch

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT


class Cruise(Ego):
    """Keeps `time_gap` s to the nearest agent ahead by braking at `braking` m/s^2."""

    def __init__(self, time_gap: float, braking: float, replan_every: int = 5) -> None:
        super().__init__(replan_every)
        self.time_gap = time_gap
        self.braking = braking

    def plan(self, world):
        """[B, 50, 4] x, y, heading, speed."""
        speed = world.states[:, 0, 3:]
        x, y = to_frame(world.states[:, 1:, :2], world.states[:, :1]).unbind(
            -1
        )  # of the others, in the ego's frame
        ahead = world.valid[:, 1:] & (x > 0) & (y.abs() < 1.8)
        near = (
            x.masked_fill(~ahead, torch.inf).amin(1, keepdim=True) - 5.0
            < self.time_gap * speed
        )
        return MissionPath(world).drive(
            (speed - self.braking * near * DT * torch.arange(PLAN_STEPS + 1)).clamp(
                min=0
            )
        )
