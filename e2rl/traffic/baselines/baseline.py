"""What the rivals share: the common prior, an intensity, what they know of the ego and what they owe it.

Vehicles that a method leaves alone replay the recording, as in CCDiff and CAT.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import SIZE, locate, select
from e2rl.prior.prior import Context, Prior
from e2rl.run.settings import check_choice, check_range
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.traffic.e2.responsibility import RESPONSIBILITIES, CareSettings, duty_of
from e2rl.traffic.grouping import Group, noise_of
from e2rl.traffic.nominal import NominalTraffic, PriorState
from e2rl.traffic.rule_based import Replay
from e2rl.traffic.traffic import REPLAN_STEPS, State, TrafficPlan

Own = TypeVar("Own", bound=PriorState)
RECORDED = Replay()


def replay_others(state: Own, plan: TrafficPlan, world: World, driven: Tensor) -> tuple[Own, TrafficPlan]:
    """Own and plan with every vehicle that is not driven [B, V] on its recording, from which the prior sees it."""
    logged = RECORDED.replan(None, world, plan.states[:, 0])[1]
    own = driven[..., None]
    states = torch.where(own[..., None], plan.states, logged.states)
    present = torch.where(own, plan.present, logged.present)
    now, before = logged.states[:, :, REPLAN_STEPS - 1], logged.states[:, :, REPLAN_STEPS - 2]
    accel, yaw_rate = (now[..., 3] - before[..., 3]) / DT, wrap(now[..., 2] - before[..., 2]) / DT
    lane = select(driven, state.lane, locate(now, accel, yaw_rate, state.routed.points))
    return replace(state, lane=lane), replace(plan, states=states, present=present)


FURTHER = 1000  # number of the draw that holds the noise of all samples but the first
Answer = Callable[[Tensor, Tensor], Tensor]  # Traffic.replan's `react`


@dataclass
class RivalState(PriorState):
    """B scenes under a rival: eta [B]; adversary [B, V] bool; path_kl [B, V]: of its control since the start."""

    eta: Tensor
    adversary: Tensor
    path_kl: Tensor


class Rival(NominalTraffic):
    """The nominal prior, except where `attack` says otherwise: in scenes with gain and intensity above 0.

    Of the `samples` of a scene the first has the nominal prior's noise.
    """

    adversarial = True

    def __init__(
        self,
        prior: Prior,
        knowledge: str = "plan",
        prediction: str = "prior",
        responsibility: str = "none",
        gain: float = 1.0,
        samples: int = 1,
    ) -> None:
        """knowledge, prediction: see NominalTraffic; responsibility: of RESPONSIBILITIES; gain: of the attack per unit
        of eta, 0: the nominal prior; samples: joint samples a replan of which one is driven."""
        super().__init__(prior, knowledge, prediction)
        check_choice("synthesizer.responsibility", responsibility, RESPONSIBILITIES)
        check_range("synthesizer.gain", gain, 0)
        check_range("synthesizer.samples", samples, 1)
        self.responsibility, self.gain, self.samples, self.care = responsibility, gain, samples, CareSettings()
        self._react: Answer | None = None

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> RivalState:
        """States of scenes [B] with routes drawn from the prior and no adversary."""
        nominal = super().reset(scenes, seed, eta)
        none, zero = torch.zeros_like(nominal.routed.parked), torch.zeros_like(nominal.routed.length)
        return RivalState(**vars(nominal), eta=eta, adversary=none, path_kl=zero)

    def replan(
        self, state: State, world: World, ego_plan: Tensor, react: Answer | None = None
    ) -> tuple[State, TrafficPlan]:
        """States and plans of the coming HORIZON steps; react: see Traffic.queries_ego."""
        self._react = react
        state, plan = super().replan(state, world, ego_plan)
        return state, replace(plan, adversary=state.adversary, path_kl=state.path_kl)

    def noise(self, state: State) -> Tensor:
        """Standard normal noise [K, B, V, samples, SIZE] of the next replan."""
        first = super().noise(state)[:, :, :, None]
        if self.samples == 1:
            return first
        shape = (self.samples - 1, self.prior.sampler.steps, first.shape[2], SIZE)
        further = noise_of(state.seed, FURTHER + state.replans, shape)
        return torch.cat([first, further.permute(2, 0, 3, 1, 4)], 3)

    def strength(self, state: State) -> Tensor:
        """Gain [B] of the attack in each scene."""
        return self.gain * state.eta

    def replan_group(
        self, state: State, world: World, ego_plan: Tensor, noise: Tensor, group: Group
    ) -> tuple[RivalState, Tensor, Context]:
        """State, joint sample x0 [G, V, SIZE] and context of a group; noise [K, G, V, samples, SIZE]."""
        state = replace(state, lane=self.lane_now(state, world, ego_plan))
        context = self.encode(state, world, ego_plan)
        if not bool((self.strength(state) > 0).any()):
            return state, self.prior.sample(context, noise[..., 0, :]).x0, context
        state, x0 = self.attack(state, world, ego_plan, noise, group, context)
        if self.adversarial:
            context.obstacles.duty = duty_of(self.responsibility, self.care, world, state.adversary, state.eta)
        return state, x0, context

    @abstractmethod
    def attack(
        self, state: State, world: World, ego_plan: Tensor, noise: Tensor, group: Group, context: Context
    ) -> tuple[RivalState, Tensor]:
        """State and joint sample x0 [G, V, SIZE] of a group of which some scene has strength above 0."""
