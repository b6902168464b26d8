"""One simulation step of B scenes, as a pure function of tensors, and several under one action.

Only the ego's motion is integrated; the other agents' states are looked up in given trajectories.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.neighbours import own_fault
from e2rl.sim.observation import EgoState, ObservationConfig, Observed, glance, observe
from e2rl.sim.reward import reward_terms, rewarded_progress, weighted_sum
from e2rl.sim.static import StaticScene, follow
from e2rl.sim.world import Agents, trajectories_at

Tracks = tuple[Tensor, Tensor]  # states [B, T+1, N, 4] and presence [B, T+1, N] of all agents
Outcome = dict[str, Tensor]  # see `step`
FLAGS = ("contact", "contact_vru", "off_road", "terminated", "truncated")


class StepConfig(NamedTuple):
    """What a step needs to know of the settings.

    horizon: steps of an episode; end_...: what ends it early; weights [8] of reward.TERMS; low, high [2]: bounds of the
    action.
    """

    horizon: int
    end_on_contact: bool
    end_off_road: bool
    end_when_gone: bool
    weights: Tensor
    low: Tensor
    high: Tensor
    observation: ObservationConfig


def step(
    ego: EgoState,
    given: Tensor | Tracks,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    sense: Callable[..., Observed] = observe,
    ended: Tensor | None = None,
) -> tuple[EgoState, Outcome]:
    """The egos after a step, and the outcome of the step.

    Args:
        ego: the egos of B scenes now.
        given: their actions [B, 2] (acceleration m/s^2, yaw rate rad/s), which are clamped to the bounds; or the
            recording, which they follow, and leave the scene at its end.
        tracks: what all agents do.
        sense: `observe`, or `glance` where no policy looks.
        ended: [B] bool, egos that stay where they are.

    Returns:
        The egos, and observation [B, D] ([B, 0] of a glance), reward, contact (with a vehicle), contact_vru (with
        another agent), off_road, terminated, truncated and progress (m along the mission since the start), each [B].
    """
    now = (ego.step + 1).clamp(max=config.horizon)
    if isinstance(given, Tensor):
        state, present = dynamics.step(ego.state, torch.clamp(given, config.low, config.high)), ego.present
    else:
        row = static.row[:, 0]
        known = given[1][row, now, 0]
        state, present = torch.where(known[:, None], given[0][row, now, 0], ego.state), ego.present & known
    action = dynamics.inverse(torch.stack([ego.state, state], 1))[:, 0]
    pose = follow(static, state[:, :2], ego.pose.s + ego.state[:, 3] * DT)
    moved = EgoState(now, state, action, pose, present, ego.been_on_road, ego.start_s)
    if ended is not None:
        stay = ended
        moved = ego.merged(moved, lambda old, new: torch.where(stay.view(-1, *[1] * (new.ndim - 1)), old, new))
        now, state, action, pose, present, *_ = moved
    others = Agents(*(value[:, 1:] for value in trajectories_at(*tracks, now)))
    seen = sense(config.observation, static, moved, others, config.horizon)
    hit = (seen.neighbours.gap < 0) & others.present & present[:, None]
    contact, contact_vru = (hit & static.vehicle).any(1), (hit & ~static.vehicle).any(1)
    off = seen.beyond > 0
    off_road = off & ego.been_on_road & present
    gone = ~present | (pose.s >= static.mission.end)
    touched = contact | contact_vru
    fault = own_fault(ego.state[:, 3], seen.neighbours, hit, static, tracks, ego.step)
    progress = rewarded_progress(pose.s - ego.pose.s, seen.limit, static.top_speed)
    terms = reward_terms(progress, touched, fault, off_road, action, ego.action, state[:, 3], seen.limit, pose.d)
    outcome = {
        "observation": seen.features,
        "reward": weighted_sum(terms, config.weights),
        "contact": contact,
        "contact_vru": contact_vru,
        "off_road": off_road,
        "terminated": (touched & config.end_on_contact) | (off_road & config.end_off_road),
        "truncated": (now >= config.horizon) | (gone & config.end_when_gone),
        "progress": pose.s - ego.start_s,
    }
    return moved._replace(present=~gone, been_on_road=ego.been_on_road | ~off), outcome


def hold_step(
    function: Callable[..., tuple[EgoState, Outcome]], hold: int, sense: Callable[..., Observed], ego: EgoState, *given
) -> tuple[EgoState, Outcome]:
    """`hold` steps of function (`step`) under one action: rewards are summed, flags are of any step; `sense` is for the
    last.

    Egos whose episode ends stay at that moment, which is also the one they observe; the others observe the last one.
    """
    ego, outcome = function(ego, *given, sense if hold == 1 else glance)
    for last in range(2, hold + 1):
        ended = outcome["terminated"] | outcome["truncated"]
        ego, later = function(ego, *given, sense if last == hold else glance, ended)
        flags = {name: outcome[name] | (later[name] & ~ended) for name in FLAGS}
        outcome = later | flags | {"reward": outcome["reward"] + later["reward"].masked_fill(ended, 0)}
    return ego, outcome
