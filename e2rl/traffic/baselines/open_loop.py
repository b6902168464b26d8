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
    released [B, V] bool: those that did before; begun [B, V]: lane states where it
    begins."""

    held: Tensor
    released: Tensor
    x: Tensor
    begun: LaneState


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

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> OpenLoopState:
        """States of scenes [B] in which no vehicle is held."""
        state = super().reset(scenes, seed, eta)
        x = torch.zeros(*state.adversary.shape, SIZE, device=eta.device)
        nobody = torch.zeros_like(state.adversary)
        return OpenLoopState(
            **vars(state), held=nobody, released=nobody, x=x, begun=state.lane
        )

    def attack(self, now: Replan, context: Context) -> tuple[OpenLoopState, Tensor]:
        """Returns state and joint sample [G, V, SIZE]: a new scenario's where one is
        due; else nominal, but for those held."""
        state = now.state
        age = state.replans % EVERY
        due = (age == 0) & (self.strength(state) > 0)
        nominal = self.prior.sample(context, now.noise[..., 0, :]).x0
        rest = later(
            state.x,
            state.begun,
            lane=state.lane,
            age=age,
            has_lane=context.routed.has_lane,
        )
        x0 = torch.where(state.held[..., None], rest, nominal)
        if not bool(due.any()):
            return state, x0
        made = self.scenario(now, context, nominal=nominal)
        rows = due[:, None]
        held = torch.where(rows, made.held, state.held)
        state = replace(
            state,
            held=held,
            released=(state.released | state.held) & ~held,
            adversary=torch.where(rows, made.adversary, state.adversary),
            path_kl=state.path_kl + torch.where(rows, made.path_kl, 0.0),
            x=torch.where(rows[..., None], made.x, state.x),
            begun=select(rows.expand_as(state.held), state.lane, other=state.begun),
        )
        return state, torch.where(rows[..., None], made.x, x0)

    @abstractmethod
    def scenario(self, now: Replan, context: Context, nominal: Tensor) -> Scenario:
        """The scenario of a group; nominal [G, V, SIZE]: its nominal joint sample."""


def later(
    x: Tensor, begun: LaneState, lane: LaneState, age: Tensor, has_lane: Tensor
) -> Tensor:
    """The plan x [B, V, SIZE] that began in lane states `begun` [B, V], as seen age [B]
    replans later in `lane`.

    Accelerations go on knot by knot, 0 after the last; the path stays the same. In free
    space its last curvature does.
    """
    index = torch.arange(KNOTS, device=x.device) + age[:, None, None]
    knots = x[..., :KNOTS].gather(
        -1, index.clamp(max=KNOTS - 1).expand(*x.shape[:-1], -1)
    )
    _, half, end = split(x, begun)
    reach = lateral_horizon(lane.v)[..., None]
    first_reach = lateral_horizon(begun.v)[..., None]
    ahead = (lane.s - begun.s)[..., None] + reach * torch.tensor(
        [0.5, 1.0], device=x.device
    )
    path = polynomial(
        offset_coefficients(begun, half, end=end), (ahead / first_reach).clamp(0, 1)
    )[0]
    bend = (path[..., 0] - 0.5 * (lane.d + path[..., 1])) / BEND_SCALE
    lateral = torch.stack([bend, path[..., 1] / OFFSET_SCALE], -1)
    lateral = torch.where(has_lane[..., None], lateral, x[..., KNOTS + 1 :])
    return torch.cat([knots.masked_fill(index >= KNOTS, 0.0), lateral], -1)
