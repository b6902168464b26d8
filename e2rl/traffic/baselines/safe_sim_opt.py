"""Safe-Sim's adversarial guidance (Chang et al. 2024), given to several adversaries."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.run.config import configured, setting
from e2rl.scenes.recording import DT
from e2rl.traffic.baselines.baseline import BaselineState
from e2rl.traffic.baselines.guidance import CleanGuidance, Guided, Objective
from e2rl.traffic.baselines.losses import (
    GAUSSIAN_REACH,
    ego_distance,
    even,
    gaussian_overlap,
    off_route_term,
    pair_term,
    ttc_term,
)
from e2rl.traffic.baselines.view import View
from e2rl.traffic.motion import smallest
from e2rl.traffic.potentials import STRIDE

GAUSSIAN_TIME = 2.0  # s of the plan in which collisions cost
MAX_COST = 30.0  # m, of the collision term
CONFLICT_REACH = 100.0  # m within which a conflict counts


@configured("synthesizer/safe_sim_opt")
@dataclass(eq=False, repr=False)
class SafeSimOpt(Guided):
    """Clean guidance to keep to one's route and clear of others, and of adversaries to
    the ego; each vehicle takes the sample that suits it best, as in the source."""

    step_size: float = setting(low=0)
    clip: float = setting(low=0)
    adversaries: int = setting(low=1)
    reach: float = setting(low=0)
    route: float = setting()
    gaussian: float = setting()
    ttc: float = setting()
    collision: float = setting()

    guides_everybody = True
    tuned = {"gain": (0.2, 20.0, "log"), "step_size": (0.2, 20.0, "log")}

    def attackers(self, state: BaselineState, view: View) -> Tensor:
        """Those nearest to the ego, within `reach`."""
        distance = view.distance_to_ego()
        return smallest(
            distance <= self.reach,
            distance,
            count=self.adversaries,
        )

    def loss(self, motion: LaneState, view: View) -> Tensor:
        """Route and Gaussian terms of all; collision and TTC terms of adversaries, by
        the strength."""
        states = view.with_ego(motion)
        calm = self.route * off_route_term(motion, view)
        calm = calm + self.gaussian * gaussian_term(states, view)
        attack = self.collision * collision_term(states) * in_conflict(view)
        attack = attack + self.ttc * ttc_term(states)
        return calm + view.strength[:, None] * view.adversary * attack

    def chosen(
        self,
        motion: LaneState,
        view: View,
        guided: Tensor,
    ) -> Tensor:
        """Sample [B, V] of each vehicle: the least Gaussian term, for adversaries the
        least collision term."""
        states = view.with_ego(motion)
        calm = gaussian_term(states, view)
        return torch.where(view.adversary, collision_term(states), calm).argmin(0)

    def guidance(
        self,
        objective: Objective,
        guided: Tensor,
        strength: Tensor,
    ) -> CleanGuidance:
        """The strength is in the loss."""
        return CleanGuidance(
            objective,
            guided=guided,
            step_size=self.step_size,
            clip=self.clip,
        )


def gaussian_term(states: Tensor, view: View) -> Tensor:
    """Gaussian collision term [S, B, V] over the first GAUSSIAN_TIME; adversaries may
    come near the ego."""
    early = states[..., : round(GAUSSIAN_TIME / (STRIDE * DT)), :]
    ego = torch.arange(states.shape[2], device=states.device) == 0
    return pair_term(
        early,
        view,
        cost=gaussian_overlap,
        reach=GAUSSIAN_REACH,
        weights=even(early),
        left_out=view.adversary[:, :, None] & ego,
    )


def collision_term(states: Tensor) -> Tensor:
    """Least distance to the ego and a tenth of the present one, at most MAX_COST m,
    mean over time [S, B, V]."""
    distance = ego_distance(states)
    cost = distance.amin(-1, keepdim=True) + 0.1 * distance
    return cost.clamp(max=MAX_COST).mean(-1)


def in_conflict(view: View) -> Tensor:
    """Bool [B, V]: the vehicle's route and the ego's meet, they are not both past that
    point, and near enough."""
    routed = view.routed
    s = view.lane.s
    before = (s < routed.conflict_s[:, :, 0]) | (s[:, :1] < routed.conflict_s[:, 0])
    near = view.distance_to_ego() < CONFLICT_REACH
    return routed.conflict[:, :, 0] & before & near
