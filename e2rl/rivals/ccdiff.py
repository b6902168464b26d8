"""CCDiff (Lin et al. 2025): a clique ranker on the recent past, guidance of those that it finds, all others replay."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Prior
from e2rl.rivals.causal_ranker import ranked
from e2rl.rivals.guidance import Loss, MeanGuidance, check_noisy_sampler
from e2rl.rivals.guided import Guided
from e2rl.rivals.losses import discounts, disk_overlap, off_road_term, pair_term
from e2rl.rivals.replayed import replay_others
from e2rl.rivals.rival import Answer, RivalState
from e2rl.rivals.view import View
from e2rl.settings import check_range
from e2rl.sim.world import World
from e2rl.traffic.rows import noise_of
from e2rl.traffic.traffic import TrafficPlan

TIES = 900  # number of the draw that orders vehicles of equal rank


@dataclass
class CCDiffState(RivalState):
    """top [B, V] bool: the vehicles that the ranker found, which the prior drives; all of a scene without strength."""

    top: Tensor


class CCDiff(Guided):
    """Posterior-mean guidance by attraction to the ego and by the map, of the `controlled` top vehicles only."""

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
        controlled: int = 5,
        collision: float = 50.0,
        margin: float = 10.0,
        off_road: float = 1.0,
    ) -> None:
        """Fields: conf/synthesizer/ccdiff.yaml."""
        super().__init__(prior, knowledge, prediction, responsibility, gain, samples)
        check_noisy_sampler(prior, "ccdiff")
        check_range("synthesizer.iterations", iterations, 1)
        check_range("synthesizer.controlled", controlled, 1)
        self.step_size, self.iterations, self.controlled = step_size, iterations, controlled
        self.collision, self.margin, self.off_road = collision, margin, off_road

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> CCDiffState:
        """States of scenes [B] with their top vehicles, which have routes of the prior; others have the recorded."""
        state = super().reset(scenes, seed, eta)
        draw = noise_of(seed, torch.full_like(seed, TIES), tuple(state.adversary.shape[1:]), uniform=True)
        top = ranked(scenes, self.controlled, draw) | (self.strength(state) <= 0)[:, None]
        logged = scenes["route_log"]
        routed, lane = self.prior.start(scenes, torch.where(top | (logged < 0), state.routed.route, logged))
        return CCDiffState(**(vars(state) | {"routed": routed, "lane": lane, "top": top}))

    def replan(
        self, state: CCDiffState, world: World, ego_plan: Tensor, react: Answer | None = None
    ) -> tuple[CCDiffState, TrafficPlan]:
        """States and plans of the coming HORIZON steps; who is not among the top replays."""
        state, plan = super().replan(state, world, ego_plan, react)
        return replay_others(state, plan, world, state.top)

    def adversaries(self, state: CCDiffState, view: View) -> Tensor:
        """The top vehicles."""
        return state.top & view.active

    def loss(self, state: CCDiffState, view: View) -> Loss:
        """Minus the collision cost with the ego, and metres off the road."""
        others = torch.ones_like(view.routed.conflict)
        others[:, :, 0] = False

        def value(motion: LaneState) -> Tensor:
            states = view.with_ego(motion)
            weights = torch.full_like(discounts(states), 1 / states.shape[-2])
            near = pair_term(states, view, disk_overlap(self.margin), self.margin, weights, others)
            return self.off_road * off_road_term(states, view, discounts(states)) - self.collision * near

        return value

    def guidance(self, loss: Loss, guided: Tensor, strength: Tensor) -> MeanGuidance:
        """Clipped at `gain` times eta standard deviations."""
        return MeanGuidance(self.prior, loss, guided, strength, self.samples, self.step_size, self.iterations)
