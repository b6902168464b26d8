"""What the baselines share: the common prior, an intensity, what they know of the ego
and what they owe it."""

from abc import abstractmethod
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import SIZE, locate, select
from e2rl.prior.prior import Context
from e2rl.run.config import setting
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.traffic.grouping import no_vehicles, noise_of
from e2rl.traffic.nominal import NominalTraffic, Own, PriorState, React, Replan
from e2rl.traffic.responsibility import RESPONSIBILITIES, YieldingSettings, duty_of
from e2rl.traffic.rule_based import LogReplay
from e2rl.traffic.traffic import REPLAN_STEPS, State, TrafficPlan

RECORDED = LogReplay()
FURTHER = 1000  # number of the draw that holds the noise of all samples but the first


@dataclass
class BaselineState(PriorState):
    """B scenes under a baseline: eta [B]; adversary [B, V] bool; path_kl [B, V]: of its
    control since the start."""

    eta: Tensor = no_vehicles()
    adversary: Tensor
    path_kl: Tensor


@dataclass(eq=False, repr=False)
class Baseline(NominalTraffic):
    """The nominal prior, except where `attack` says otherwise: in scenes with gain and
    intensity above 0.

    gain: of the attack per unit of eta, 0: the nominal prior. samples: joint samples a
    replan; the first has the nominal prior's noise.
    """

    responsibility: str = setting(choices=RESPONSIBILITIES)
    gain: float = setting(low=0)

    adversarial = True
    samples = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.yielding = YieldingSettings()

    def reset(
        self,
        scenes: TensorDictBase,
        seed: Tensor,
        eta: Tensor,
    ) -> BaselineState:
        """Returns the states of scenes [B] with routes drawn from the prior and no
        adversary."""
        nominal = super().reset(scenes, seed, eta)
        nobody = torch.zeros_like(nominal.routed.parked)
        zero = torch.zeros_like(nominal.routed.length)
        return BaselineState(
            **vars(nominal),
            eta=eta,
            adversary=nobody,
            path_kl=zero,
        )

    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[State, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps (`Traffic.replan`)."""
        state, plan = super().replan(state, world, ego_plan, react)
        return state, replace(
            plan,
            adversary=state.adversary,
            path_kl=state.path_kl,
        )

    def noise(self, state: State) -> Tensor:
        """Returns standard normal noise [K, B, V, samples, SIZE] of the next replan."""
        first = super().noise(state)[:, :, :, None]
        if self.samples == 1:
            return first
        shape = (self.samples - 1, self.prior.sampler.steps, first.shape[2], SIZE)
        further = noise_of(
            state.seed,
            FURTHER + state.replans,
            shape=shape,
        )
        return torch.cat([first, further.permute(2, 0, 3, 1, 4)], 3)

    def strength(self, state: State) -> Tensor:
        """Returns the gain [B] of the attack in each scene."""
        return self.gain * state.eta

    def replan_group(self, now: Replan) -> tuple[BaselineState, Tensor, Context]:
        """Returns state, joint sample x0 [G, V, SIZE] and context of a group."""
        context = self.encode(
            now.state,
            now.world,
            ego_plan=now.ego_plan,
            known=now.before,
        )
        if not bool((self.strength(now.state) > 0).any()):
            sample = self.prior.sample(context, now.noise[..., 0, :])
            return now.state, sample.x0, context
        state, x0 = self.attack(now, context)
        if self.adversarial:
            context.obstacles.duty = duty_of(
                self.responsibility,
                self.yielding,
                world=now.world,
                coalition=state.adversary,
                eta=state.eta,
            )
        return state, x0, context

    @abstractmethod
    def attack(self, replan: Replan, context: Context) -> tuple[BaselineState, Tensor]:
        """Returns state and joint sample x0 [G, V, SIZE] of a group of which some scene
        has strength above 0."""


def replay_others(
    state: Own,
    plan: TrafficPlan,
    *,
    world: World,
    driven: Tensor,
) -> tuple[Own, TrafficPlan]:
    """Returns state and plan with every vehicle that is not driven on its recording,
    from which the prior sees it.

    Args:
        state: of B scenes, after their replan.
        plan: of that replan.
        world: the scenes now.
        driven: [B, V] bool.
    """
    logged = RECORDED.replan(None, world, plan.states[:, 0])[1]
    last = logged.states[:, :, REPLAN_STEPS - 1]
    change = last - logged.states[:, :, REPLAN_STEPS - 2]
    recorded = locate(
        last,
        change[..., 3] / DT,
        yaw_rate=wrap(change[..., 2]) / DT,
        points=state.routed.points,
    )
    mask = driven[..., None]
    return (
        replace(state, lane=select(driven, state.lane, other=recorded)),
        replace(
            plan,
            states=torch.where(mask[..., None], plan.states, logged.states),
            present=torch.where(mask, plan.present, logged.present),
        ),
    )
