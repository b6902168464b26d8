"""CTG as published: realistic guidance away from collisions, for every vehicle (Zhong
et al. 2023).

Dense adversarial guidance: CTG's machinery turned on the ego, by every vehicle at once.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.run.config import configured, setting
from e2rl.traffic.baselines.baseline import BaselineState
from e2rl.traffic.baselines.guidance import MeanGuided
from e2rl.traffic.baselines.losses import (
    approach_term,
    discounts,
    off_road_term,
    overlap_term,
    speeding_term,
)
from e2rl.traffic.baselines.view import View


@configured("synthesizer/ctg")
@dataclass(eq=False, repr=False)
class CTG(MeanGuided):
    """Posterior-mean guidance by collision, map and speed; the scene's sample of least
    loss is driven."""

    collision: float = setting()
    margin: float = setting(low=0)
    off_road: float = setting()
    speed: float = setting()
    responsibility: str = field(default="", init=False)  # nobody owes anything

    adversarial = False
    guides_everybody = True

    def strength(self, state: BaselineState) -> Tensor:
        """Returns the gain [B], whatever the intensity."""
        return torch.full_like(state.eta, self.gain)

    def loss(self, motion: LaneState, view: View) -> Tensor:
        """Weighted collision, off-road and speeding terms."""
        states = view.with_ego(motion)
        weights = discounts(states)
        collision = overlap_term(
            states,
            view,
            margin=self.margin,
            weights=weights,
        )
        off_road = off_road_term(states, view, weights=weights)
        total = self.collision * collision + self.off_road * off_road
        return total + self.speed * speeding_term(motion, view)


@configured("synthesizer/ctg_adv")
@dataclass(eq=False, repr=False)
class CTGAdv(MeanGuided):
    """Posterior-mean guidance of all vehicles towards the ego, on the road; the scene's
    sample of least loss."""

    approach: float = setting()
    temperature: float = setting(low=1e-3)
    off_road: float = setting()

    tuned = {"gain": (0.05, 4.0, "log"), "step_size": (0.03, 3.0, "log")}

    def loss(self, motion: LaneState, view: View) -> Tensor:
        """Soft-min distance to the ego, and metres off the road."""
        states = view.with_ego(motion)
        approach = approach_term(states, self.temperature)
        off_road = off_road_term(states, view, weights=discounts(states))
        return self.approach * approach + self.off_road * off_road

    def chosen(
        self,
        motion: LaneState,
        view: View,
        guided: Tensor,
    ) -> Tensor:
        """Sample [B] in which some vehicle comes nearest to the ego."""
        loss = self.loss(motion, view).masked_fill(~guided, torch.inf)
        return loss.amin(-1).argmin(0)
