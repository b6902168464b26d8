"""CTG as published: realistic guidance away from collisions, for every vehicle (Zhong
et al. 2023).

Dense adversarial guidance: CTG's machinery turned on the ego, by every vehicle at once.
"""

from dataclasses import dataclass, field

from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.run.settings import configured, setting
from e2rl.traffic.baselines.baseline import BaselineState
from e2rl.traffic.baselines.guidance import MeanGuided
from e2rl.traffic.baselines.losses import (
    approach_term,
    discounts,
    disk_overlap,
    off_road_term,
    pair_term,
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
    responsibility: str = field(
        default="", init=False
    )  # there is no adversary that owes anything

    adversarial = False
    guides_everybody = True

    def strength(self, state: BaselineState) -> Tensor:
        """Returns the gain [B], whatever the intensity."""
        return state.eta * 0 + self.gain

    def attackers(self, state: BaselineState, view: View) -> Tensor:
        """No vehicle."""
        return view.active & False

    def loss(self, motion: LaneState, state: BaselineState, view: View) -> Tensor:
        """Weighted collision, off-road and speeding terms."""
        states = view.with_ego(motion)
        weights = discounts(states)
        total = self.collision * pair_term(
            states,
            view,
            cost=disk_overlap(self.margin),
            reach=self.margin,
            weights=weights,
        )
        total = total + self.off_road * off_road_term(states, view, weights=weights)
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

    def loss(self, motion: LaneState, state: BaselineState, view: View) -> Tensor:
        """Soft-min distance to the ego, and metres off the road."""
        states = view.with_ego(motion)
        near = approach_term(states, self.temperature)
        return self.approach * near + self.off_road * off_road_term(
            states, view, weights=discounts(states)
        )

    def chosen(
        self, motion: LaneState, state: BaselineState, view: View, guided: Tensor
    ) -> Tensor:
        """Sample [B] in which some vehicle comes nearest to the ego."""
        return (
            self.loss(motion, state, view=view)
            .masked_fill(~guided, float("inf"))
            .amin(-1)
            .argmin(0)
        )
