"""Vehicles that a method leaves alone replay the recording, as in CCDiff and CAT."""

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from e2rl.prior.lane_relative import locate, select
from e2rl.scene.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.traffic.nominal import PriorState
from e2rl.traffic.replay import Replay
from e2rl.traffic.traffic import REPLAN_STEPS, TrafficPlan

State = TypeVar("State", bound=PriorState)
RECORDED = Replay()


def replay_others(state: State, plan: TrafficPlan, world: World, driven: Tensor) -> tuple[State, TrafficPlan]:
    """State and plan with every vehicle that is not driven [B, V] on its recording, from which the prior sees it."""
    logged = RECORDED.replan(None, world, plan.states[:, 0])[1]
    own = driven[..., None]
    states = torch.where(own[..., None], plan.states, logged.states)
    present = torch.where(own, plan.present, logged.present)
    now, before = logged.states[:, :, REPLAN_STEPS - 1], logged.states[:, :, REPLAN_STEPS - 2]
    accel, yaw_rate = (now[..., 3] - before[..., 3]) / DT, wrap(now[..., 2] - before[..., 2]) / DT
    lane = select(driven, state.lane, locate(now, accel, yaw_rate, state.routed.points))
    return replace(state, lane=lane), replace(plan, states=states, present=present)
