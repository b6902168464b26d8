"""Baselines that plan a whole horizon once and then drive it whatever happens:
DiffScene, CAT, STRIVE."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import (
    BEND_SCALE,
    HORIZON,
    KNOTS,
    OFFSET_SCALE,
    SIZE,
    LaneState,
    lateral_horizon,
    offset_coefficients,
    polynomial,
    select,
    split,
)
from e2rl.prior.prior import Context
from e2rl.traffic.baselines.baseline import Baseline, BaselineState
from e2rl.traffic.nominal import Replan
from e2rl.traffic.traffic import REPLAN_STEPS

EVERY = HORIZON // REPLAN_STEPS  # replans that a plan lasts


@dataclass
class OpenLoopState(BaselineState):
    """held [B, V] bool: vehicles that drive the plan x [B, V, SIZE] whatever happens;
    released [B, V] bool: those that did before; origin [B, V]: lane states where it
    begins."""

    held: Tensor
    released: Tensor
    x: Tensor
    origin: LaneState


class Scenario(NamedTuple):
    """A whole horizon: x [B, V, SIZE] of all vehicles, those held [B, V], adversaries
    [B, V], path_kl [B, V]."""

    x: Tensor
    held: Tensor
    adversary: Tensor
    path_kl: Tensor


@dataclass(eq=False, repr=False)
class OpenLoop(Baseline):
    """A scenario is generated every EVERY replans, as long as a plan lasts; until then
    it is driven."""

    def reset(
        self,
        scenes: TensorDictBase,
        seed: Tensor,
        eta: Tensor,
    ) -> OpenLoopState:
        """States of scenes [B] in which no vehicle is held."""
        state = super().reset(scenes, seed, eta)
        nobody = torch.zeros_like(state.adversary)
        return OpenLoopState(
            **vars(state),
            held=nobody,
            released=nobody,
            x=torch.zeros(*nobody.shape, SIZE, device=eta.device),
            origin=state.lane,
        )

    def attack(self, replan: Replan, context: Context) -> tuple[OpenLoopState, Tensor]:
        """Returns state and joint sample [G, V, SIZE]: a new scenario's where one is
        due; else nominal, but for those held."""
        state = replan.state
        age = state.replans % EVERY
        due = ((age == 0) & (self.strength(state) > 0))[:, None]
        nominal = self.prior.sample(context, replan.noise[..., 0, :]).x0
        rest = later(
            state.x,
            state.origin,
            lane=state.lane,
            age=age,
            has_lane=context.routed.has_lane,
        )
        x0 = torch.where(state.held[..., None], rest, nominal)
        if not bool(due.any()):
            return state, x0
        scenario = self.scenario(replan, context, nominal)
        held = torch.where(due, scenario.held, state.held)
        state = replace(
            state,
            held=held,
            released=(state.released | state.held) & ~held,
            adversary=torch.where(due, scenario.adversary, state.adversary),
            path_kl=state.path_kl + torch.where(due, scenario.path_kl, 0.0),
            x=torch.where(due[..., None], scenario.x, state.x),
            origin=select(
                due.expand_as(held),
                state.lane,
                other=state.origin,
            ),
        )
        return state, torch.where(due[..., None], scenario.x, x0)

    @abstractmethod
    def scenario(
        self,
        replan: Replan,
        context: Context,
        nominal: Tensor,
    ) -> Scenario:
        """The scenario of a group; nominal [G, V, SIZE]: its nominal joint sample."""


def later(
    x: Tensor,
    origin: LaneState,
    *,
    lane: LaneState,
    age: Tensor,
    has_lane: Tensor,
) -> Tensor:
    """Returns a plan [B, V, SIZE] as seen some replans later.

    Accelerations go on knot by knot, 0 after the last; the path stays the same. In free
    space its last curvature does.

    Args:
        x: [B, V, SIZE], the plan.
        origin: lane states [B, V] where it began.
        lane: lane states [B, V] now.
        age: [B], replans.
        has_lane: [B, V] bool.
    """
    index = torch.arange(KNOTS, device=x.device) + age[:, None, None]
    knot = index.clamp(max=KNOTS - 1).expand(*x.shape[:-1], -1)
    knots = x[..., :KNOTS].gather(-1, knot).masked_fill(index >= KNOTS, 0.0)
    _, half, end = split(x, origin)
    reach = lateral_horizon(lane.v)[..., None]
    ahead = reach * torch.tensor([0.5, 1.0], device=x.device)
    ahead = (lane.s - origin.s)[..., None] + ahead
    fraction = (ahead / lateral_horizon(origin.v)[..., None]).clamp(0, 1)
    path = polynomial(offset_coefficients(origin, half, end=end), fraction)[0]
    bend = (path[..., 0] - 0.5 * (lane.d + path[..., 1])) / BEND_SCALE
    lateral = torch.stack([bend, path[..., 1] / OFFSET_SCALE], -1)
    lateral = torch.where(has_lane[..., None], lateral, x[..., KNOTS + 1 :])
    return torch.cat([knots, lateral], -1)
