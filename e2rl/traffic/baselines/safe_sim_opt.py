"""Safe-Sim's adversarial guidance (Chang et al. 2024), given to several adversaries."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.run.settings import configured, setting
from e2rl.scenes.recording import DT
from e2rl.traffic.baselines.baseline import BaselineState
from e2rl.traffic.baselines.guidance import CleanGuidance, Guided, Loss
from e2rl.traffic.baselines.losses import (
    ego_distance,
    gaussian_overlap,
    off_route_term,
    pair_term,
    ttc_term,
)
from e2rl.traffic.baselines.view import View
from e2rl.traffic.motion import smallest
from e2rl.traffic.potentials import STRIDE

GAUSSIAN_REACH = 3.0  # m beyond which the Gaussian of 1 m is below 0.4
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
        return smallest(distance <= self.reach, distance, count=self.adversaries)

    def loss(self, motion: LaneState, state: BaselineState, view: View) -> Tensor:
        """Route and Gaussian terms of all; collision and TTC terms of adversaries, by
        the strength."""
        states = view.with_ego(motion)
        strength = self.strength(state)[:, None] * state.adversary
        calm = self.route * off_route_term(
            motion, view
        ) + self.gaussian * self._overlap(states, view, state=state)
        attack = self.collision * collision_term(states) * in_conflict(
            view
        ) + self.ttc * ttc_term(states)
        return calm + strength * attack

    def _overlap(self, states: Tensor, view: View, state: BaselineState) -> Tensor:
        """Gaussian collision term [S, B, V] over the first GAUSSIAN_TIME; adversaries
        may come near the ego."""
        early = states[..., : round(GAUSSIAN_TIME / (STRIDE * DT)), :]
        pursued = state.adversary[:, :, None] & (
            torch.arange(states.shape[2], device=states.device) == 0
        )
        weights = early.new_full(early.shape[-2:-1], 1 / early.shape[-2])
        return pair_term(
            early,
            view,
            cost=gaussian_overlap,
            reach=GAUSSIAN_REACH,
            weights=weights,
            left_out=pursued,
        )

    def chosen(
        self, motion: LaneState, state: BaselineState, view: View, guided: Tensor
    ) -> Tensor:
        """Sample [B, V] of each vehicle: the least Gaussian term, for adversaries the
        least collision term."""
        states = view.with_ego(motion)
        calm = self._overlap(states, view, state=state)
        near = collision_term(states)
        return torch.where(state.adversary, near, calm).argmin(0)

    def guidance(self, loss: Loss, guided: Tensor, strength: Tensor) -> CleanGuidance:
        """The strength is in the loss."""
        return CleanGuidance(
            self.prior,
            loss,
            guided=guided,
            samples=self.samples,
            step_size=self.step_size,
            clip=self.clip,
        )


def collision_term(states: Tensor) -> Tensor:
    """Least distance to the ego and a tenth of the present one, at most MAX_COST m,
    mean over time [S, B, V]."""
    distance = ego_distance(states)
    return (
        (distance.amin(-1, keepdim=True) + 0.1 * distance).clamp(max=MAX_COST).mean(-1)
    )


def in_conflict(view: View) -> Tensor:
    """Bool [B, V]: the vehicle's route and the ego's meet, they are not both past that
    point, and near enough."""
    routed = view.routed
    s = view.lane.s
    before = (s < routed.conflict_s[:, :, 0]) | (s[:, :1] < routed.conflict_s[:, 0])
    return routed.conflict[:, :, 0] & before & (view.distance_to_ego() < CONFLICT_REACH)
