"""Log replay: vehicles follow their recording and are present where recorded."""

import torch
from torch import Tensor

from e2rl.sim.world import World
from e2rl.traffic.traffic import State, Traffic, TrafficPlan, steps_ahead


class Replay(Traffic):
    """The smoothed recording; a vehicle is absent in gaps of its track and after its end."""

    stochastic, predicts, replays_log = False, False, True

    def replan(self, state: State, world: World, ego_plan: Tensor) -> tuple[State, TrafficPlan]:
        """Recorded states and presence of the coming steps."""
        logged, valid = world.scene["logged"], world.scene["logged_valid"]
        vehicles, step = world.scene["route_log"].shape[1], steps_ahead(world)
        row, at = torch.arange(len(step), device=step.device)[:, None], step.clamp(max=logged.shape[1] - 1)
        known = valid[row, at, :vehicles] & (step < logged.shape[1])[..., None]
        return state, TrafficPlan(logged[row, at, :vehicles].transpose(1, 2), known.transpose(1, 2))
