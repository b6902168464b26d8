"""Log replay: everybody drives as recorded, and is there when recorded."""

import torch

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Plan
from e2rl.sim.world import World
from e2rl.synthesizer.episode import Episode
from e2rl.traffic.traffic import Baseline, steps_ahead


class Replay(Baseline):
    """The recording, smoothed as it is in the scene; after its end a vehicle is gone, in its gaps too."""

    predicts = False

    def plan(self, episode: Episode, world: World) -> Plan:
        """Recorded states and validity of the coming steps; nobody is there after the recording's last step."""
        vehicles = episode.routed.route.shape[1]
        logged, valid = world.scene["logged"], world.scene["logged_valid"]
        step = steps_ahead(world)
        row, at = torch.arange(len(step), device=step.device)[:, None], step.clamp(max=logged.shape[1] - 1)
        known = valid[row, at, :vehicles] & (step < logged.shape[1])[..., None]
        return Plan(LaneState.from_states(logged[row, at, :vehicles].transpose(1, 2)), known.transpose(1, 2))
