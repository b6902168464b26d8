"""Dense adversarial guidance: CTG's machinery turned on the ego, by every vehicle at once."""

from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Prior
from e2rl.rivals.guidance import Loss, MeanGuidance, check_noisy_sampler
from e2rl.rivals.guided import Guided
from e2rl.rivals.losses import approach_term, discounts, off_road_term
from e2rl.rivals.rival import RivalState
from e2rl.rivals.view import View
from e2rl.settings import check_range


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
