"""The ego's reaction to a plan of the other vehicles: its own policy, a black box, rolled forward against the plan."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.planners.ego import Ego, ask, from_outside
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity
from e2rl.sim.world import World
from e2rl.traffic.grouping import take_rows


@dataclass
class Lookahead:
    """Rolls out the egos of scenes [B] against planned vehicles; period: steps between two ego plans."""

    ego: Ego
    world: World
    period: int = 10

    @torch.no_grad()
    def __call__(self, rows: Tensor, planned: Tensor) -> Tensor:
        """The egos' states [G, HORIZON, 4] in scenes rows [G] against vehicles planned [G, V, HORIZON, 4], but for
        row 0; agents without a plan keep their velocity."""
        whole = len(rows) == len(self.world.step) and bool((rows.diff() > 0).all())
        world = self.world if whole else replace(take_rows(self.world, rows), plan=None)
        world = world.shown() if from_outside(self.ego) else world  # of now: it is asked about steps to come
        states, vehicles, pieces = world.states, planned.shape[1], []
        ends = torch.arange(self.period, HORIZON + self.period, self.period, device=states.device)
        moved = constant_velocity(states[:, vehicles:], DT * ends)
        now = world
        for number, after in enumerate(ends.tolist()):
            pieces.append(ask(self.ego, "plan", now, scene=world.scene)[:, : self.period])
            ego, others = pieces[-1][:, -1:], planned[:, 1:, min(after, HORIZON) - 1]
            now = replace(now, step=world.step + after, states=torch.cat([ego, others, moved[:, :, number]], 1))
        return torch.cat(pieces, 1)[:, :HORIZON]
