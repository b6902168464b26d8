"""How the ego would react: its real policy rolled forward against a plan of the others (Sec. IV-B2, a black box).

A plan of the ego made now does not know what its adversaries intend; what it would do about them is found by asking it
again, every `period` of the planned time, with everybody where the plan has them by then. Nothing is differentiated.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.prior.lane_relative import HORIZON
from e2rl.scene.recording import DT
from e2rl.sim.world import World
from e2rl.synthesizer.grouping import Group


@dataclass
class Lookahead:
    """The egos of scenes [B] asked about plans of groups of them; period: steps between two of their plans."""

    ego: Ego
    world: World
    period: int = 10

    @torch.no_grad()
    def __call__(self, group: Group, planned: Tensor) -> Tensor:
        """The ego's states [G, HORIZON, 4] against planned states [G, V, HORIZON, 4] of the group's vehicles (the
        ego's row is not read); agents that are not planned keep their velocity."""
        world, vehicles = self._of(group), planned.shape[1]
        states, pieces = world.states, []
        velocity = states[..., 3:] * torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)
        now = world
        for done in range(0, HORIZON, self.period):
            pieces.append(self.ego.plan(now)[:, : self.period])
            after = done + self.period
            moved = torch.cat([states[..., :2] + DT * after * velocity, states[..., 2:]], -1)
            ego, others = pieces[-1][:, -1:], planned[:, 1:, min(after, HORIZON) - 1]
            now = replace(now, step=world.step + after, states=torch.cat([ego, others, moved[:, vehicles:]], 1))
        return torch.cat(pieces, 1)[:, :HORIZON]

    def _of(self, group: Group) -> World:
        """The group's Worlds, all their rows."""
        if len(group.rows) == len(self.world.step) and bool((group.rows.diff() > 0).all()):
            return self.world
        world = self.world
        return World(
            world.scene[group.rows],
            *(getattr(world, name)[group.rows] for name in ("step", "states", "valid", "accel", "route")),
        )
