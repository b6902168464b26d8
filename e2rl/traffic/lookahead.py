"""What the ego would do against a plan of the traffic: its own policy, a black box,
rolled out in imagined scenes (`Traffic.queries_ego`)."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.ego_errors import renumbered
from e2rl.planners.ego_policy import answering, ask, from_outside
from e2rl.planners.plausibility import checked_answer
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity
from e2rl.sim.world import World
from e2rl.traffic.grouping import take_rows


@dataclass
class Lookahead:
    """An ego in scenes [B] that answers plans of the other vehicles; period: steps
    between two of its own plans."""

    ego: Ego
    world: World
    period: int = 10

    @torch.no_grad()
    def __call__(self, rows: Tensor, planned: Tensor) -> Tensor:
        """The egos' states [G, HORIZON, 4] in scenes rows [G] against vehicles planned
        [G, V, HORIZON, 4], but for row 0; agents without a plan keep their velocity."""
        world = self._scenes(rows)
        vehicles = planned.shape[1]
        device = planned.device
        ends = torch.arange(self.period, HORIZON + self.period, self.period)
        unplanned = world.states[:, vehicles:]
        unplanned = constant_velocity(unplanned, DT * ends.to(device))
        imagined = world
        pieces = []
        for number, step in enumerate(ends.tolist()):
            with renumbered(rows), answering(imagined):
                answer = ask(self.ego, "plan", world=imagined, scene=imagined.scene)
                plan = checked_answer(
                    answer,
                    self.ego,
                    method="plan",
                    shape=(len(imagined.step), PLAN_STEPS, 4),
                    begins=False,
                )
            driven = plan[:, : self.period]
            pieces.append(driven)
            others = planned[:, 1:, min(step, HORIZON) - 1]
            states = torch.cat([driven[:, -1:], others, unplanned[:, :, number]], 1)
            place = imagined.mission_s
            if place is not None:
                place = place + DT * driven[..., 3].sum(1)
            imagined = replace(
                imagined,
                step=world.step + step,
                states=states,
                mission_s=place,
            )
        return torch.cat(pieces, 1)[:, :HORIZON]

    def _scenes(self, rows: Tensor) -> World:
        """The scenes rows [G]; an ego from outside, which is asked about steps to come,
        sees no more of them than now."""
        world = self.world
        if len(rows) != len(world.step) or not bool((rows.diff() > 0).all()):
            world = replace(take_rows(world, rows), plan=None)
        return world.shown() if from_outside(self.ego) else world
