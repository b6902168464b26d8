"""CTG as published: realistic guidance away from collisions, for every vehicle (Zhong et al. 2023).

Dense adversarial guidance: CTG's machinery turned on the ego, by every vehicle at once.
"""

from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Prior
from e2rl.run.settings import check_range
from e2rl.traffic.baselines.baseline import RivalState
from e2rl.traffic.baselines.guidance import Guided, Loss, MeanGuidance, check_noisy_sampler
from e2rl.traffic.baselines.losses import (
    approach_term,
    discounts,
    disk_overlap,
    off_road_term,
    pair_term,
    speeding_term,
)
from e2rl.traffic.baselines.view import View


class CTG(Guided):
    """Posterior-mean guidance by collision, map and speed; the scene's sample of least loss is driven."""

    adversarial = False
    guides_everybody = True

    def __init__(
        self,
        prior: Prior,
        knowledge: str = "plan",
        prediction: str = "prior",
        gain: float = 1.0,
        step_size: float = 0.3,
        iterations: int = 1,
        samples: int = 5,
        collision: float = 50.0,
        margin: float = 0.2,
        off_road: float = 1.0,
        speed: float = 0.1,
    ) -> None:
        """Fields: conf/synthesizer/ctg.yaml."""
        super().__init__(prior, knowledge, prediction, "none", gain, samples)
        check_noisy_sampler(prior, "ctg")
        check_range("synthesizer.iterations", iterations, 1)
        self.responsibility = ""  # no adversary owes anything
        self.step_size, self.iterations = step_size, iterations
        self.weights, self.margin = (collision, off_road, speed), margin

    def strength(self, state: RivalState) -> Tensor:
        """The gain [B], whatever the intensity."""
        return state.eta * 0 + self.gain

    def adversaries(self, state: RivalState, view: View) -> Tensor:
        """Nobody."""
        return view.active & False

    def loss(self, state: RivalState, view: View) -> Loss:
        """Weighted collision, off-road and speeding terms."""
        collision, off_road, speed = self.weights

        def value(motion: LaneState) -> Tensor:
            states = view.with_ego(motion)
            weights = discounts(states)
            total = collision * pair_term(states, view, disk_overlap(self.margin), self.margin, weights)
            return total + off_road * off_road_term(states, view, weights) + speed * speeding_term(motion, view)

        return value

    def guidance(self, loss: Loss, guided: Tensor, strength: Tensor) -> MeanGuidance:
        """Clipped at `gain` standard deviations."""
        return MeanGuidance(self.prior, loss, guided, strength, self.samples, self.step_size, self.iterations)


class CTGAdv(Guided):
    """Posterior-mean guidance of all vehicles towards the ego, on the road; the scene's sample of least loss."""

    def __init__(
        self,
        prior: Prior,
        knowledge: str = "plan",
        prediction: str = "prior",
        responsibility: str = "none",
        gain: float = 0.5,
        step_size: float = 0.3,
        iterations: int = 1,
        samples: int = 5,
        approach: float = 1.0,
        temperature: float = 2.0,
        off_road: float = 1.0,
    ) -> None:
        """Fields: conf/synthesizer/ctg_adv.yaml."""
        super().__init__(prior, knowledge, prediction, responsibility, gain, samples)
        check_noisy_sampler(prior, "ctg_adv")
        check_range("synthesizer.iterations", iterations, 1)
        check_range("synthesizer.temperature", temperature, 1e-3)
        self.step_size, self.iterations = step_size, iterations
        self.approach, self.temperature, self.off_road = approach, temperature, off_road

    def loss(self, state: RivalState, view: View) -> Loss:
        """Soft-min distance to the ego, and metres off the road."""

        def value(motion: LaneState) -> Tensor:
            states = view.with_ego(motion)
            near = approach_term(states, self.temperature)
            return self.approach * near + self.off_road * off_road_term(states, view, discounts(states))

        return value

    def chosen(self, motion: LaneState, state: RivalState, view: View, guided: Tensor) -> Tensor:
        """Sample [B] in which some vehicle comes nearest to the ego."""
        return self.loss(state, view)(motion).masked_fill(~guided, float("inf")).amin(-1).argmin(0)

    def guidance(self, loss: Loss, guided: Tensor, strength: Tensor) -> MeanGuidance:
        """Clipped at `gain` times eta standard deviations."""
        return MeanGuidance(self.prior, loss, guided, strength, self.samples, self.step_size, self.iterations)
