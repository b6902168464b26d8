"""The recorded ego as a planner. With `sim.replay_ego=true` the environment follows the
log exactly instead."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.recording import DT
from e2rl.sim.world import World


@configured("ego/replay")
@dataclass(eq=False)
class ReplayEgo(Ego):
    """Plans the recording; unless the environment replays it, the unicycle tracks this
    plan.

    After the recording's end the last speed and heading are held.
    """

    replays_log = True
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    def plan(self, world: World) -> Tensor:
        """Recorded states [B, PLAN_STEPS, 4] of the coming steps."""
        track = world.scene["logged"][:, :, 0]
        recorded = world.scene["logged_valid"][:, :, 0]
        device = track.device
        steps = torch.arange(track.shape[1], device=device)
        last = torch.where(recorded, steps, 0).amax(1, keepdim=True)
        step = world.step[:, None] + torch.arange(1, PLAN_STEPS + 1, device=device)
        index = step.minimum(last)
        state = track[torch.arange(len(track), device=device)[:, None], index]
        distance = (step - index)[..., None] * DT * state[..., 3:]
        direction = unit_vectors(state[..., 2])
        xy = state[..., :2] + distance * direction
        return torch.cat([xy, state[..., 2:]], -1)
