"""The prior's noise as a vector of standard normals: a rollout of nominal traffic is a
function of it.

Each vehicle has a row of D numbers: one that draws its route (as a uniform number, by
the normal distribution function), and steps x SIZE for each replan.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from e2rl.prior.lane_relative import SIZE
from e2rl.prior.prior import Prior
from e2rl.traffic.nominal import NominalTraffic, PriorState
from e2rl.traffic.traffic import REPLAN_STEPS


@dataclass(frozen=True)
class NoiseLayout:
    """The numbers that one rollout of the prior takes.

    Args:
        vehicles: V, rows.
        replans: of a rollout.
        steps: denoising steps of a replan.
    """

    vehicles: int
    replans: int
    steps: int

    @classmethod
    def of(cls, prior: Prior, *, vehicles: int, horizon: int) -> "NoiseLayout":
        """Returns the layout of rollouts of `horizon` steps with `vehicles` rows."""
        replans = -(-horizon // REPLAN_STEPS)
        return cls(vehicles, replans, steps=prior.sampler.steps)

    @property
    def numbers(self) -> int:
        """D, of a vehicle."""
        return 1 + self.replans * self.steps * SIZE

    def replan_of(self) -> Tensor:
        """Returns the replan [D] int64 in which each number of a vehicle acts; the
        route's acts from the first on."""
        replan = torch.arange(self.replans).repeat_interleave(self.steps * SIZE)
        return torch.cat([replan.new_zeros(1), replan])


class ChosenNoise(NominalTraffic):
    """Nominal traffic with noise that is chosen: seeds are rows of `normals`."""

    layout: NoiseLayout
    normals: Tensor  # [P, V, D]

    def __init__(self, prior: Prior, layout: NoiseLayout, **settings: Any) -> None:
        """layout: of `normals`; settings: of nominal traffic."""
        super().__init__(prior, **settings)
        self.layout = layout

    def route_noise(self, seed: Tensor, vehicles: int) -> Tensor:
        """Returns uniform numbers [B, V] that draw the routes."""
        return torch.special.ndtr(self.normals[seed, :vehicles, 0])

    def noise(self, state: PriorState) -> Tensor:
        """Returns standard normal noise [steps, B, V, SIZE] of the next replan."""
        layout = self.layout
        whole = self.normals[..., 1:].unflatten(
            -1, (layout.replans, layout.steps, SIZE)
        )
        vehicles = state.routed.route.shape[1]
        return whole[state.seed, :vehicles, state.replans].permute(2, 0, 1, 3)
