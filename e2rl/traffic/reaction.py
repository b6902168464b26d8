"""The extension point for vehicles that leave replayed traffic and react to the ego.

The ego's reaction to a plan of the other vehicles: its own policy, a black box, rolled forward against the plan.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.planners.ego import Ego
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity
from e2rl.sim.world import World
from e2rl.traffic.grouping import take_rows


class NewEpisodes(NamedTuple):
    """b episodes that begin in a batch of environments.

    rows [b] int64: their environments; adversarial [b] bool: replayed traffic with an intensity; adversaries [b, V]
    bool: of that traffic; batch: environments in all; horizon: steps of an episode.
    """

    rows: Tensor
    adversarial: Tensor
    adversaries: Tensor
    batch: int
    horizon: int


class Motion(NamedTuple):
    """The coming states [K, H, 4] of vehicles agents [K] of environments rows [K]."""

    rows: Tensor
    agents: Tensor
    states: Tensor


class Reaction(ABC):
    """Vehicles of replayed traffic that react: who, from when on, and how."""

    @property
    @abstractmethod
    def acting(self) -> Tensor:
        """Bool [B, V]: vehicles that react now; valid after the first `begin`."""

    @abstractmethod
    def begin(self, episodes: NewEpisodes) -> None:
        """Draw for every new episode whether, who and when; the former episode's vehicles there stop reacting."""

    @abstractmethod
    def react(self, world: World) -> Motion | None:
        """The reacting vehicles' motion for at least 1 s, asked every 0.5 s; None where nobody reacts."""


@dataclass
class Lookahead:
    """Rolls out the egos of scenes [B] against planned vehicles; period: steps between two ego plans."""

    ego: Ego
    world: World
    period: int = 10

    @torch.no_grad()
    def __call__(self, rows: Tensor, planned: Tensor) -> Tensor:
        """The egos' states [G, HORIZON, 4] in scenes rows [G] against vehicles planned [G, V, HORIZON, 4].

        The ego's row of `planned` is ignored; agents without a plan keep their velocity.
        """
        whole = len(rows) == len(self.world.step) and bool((rows.diff() > 0).all())
        world = self.world if whole else replace(take_rows(self.world, rows), plan=None)
        states, vehicles, pieces = world.states, planned.shape[1], []
        ends = torch.arange(self.period, HORIZON + self.period, self.period, device=states.device)
        moved = constant_velocity(states[:, vehicles:], DT * ends)
        now = world
        for number, after in enumerate(ends.tolist()):
            pieces.append(self.ego.plan(now)[:, : self.period])
            ego, others = pieces[-1][:, -1:], planned[:, 1:, min(after, HORIZON) - 1]
            now = replace(now, step=world.step + after, states=torch.cat([ego, others, moved[:, :, number]], 1))
        return torch.cat(pieces, 1)[:, :HORIZON]
