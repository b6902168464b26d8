"""One simulation step of B scenes, as a pure function of tensors, and several under one
action.

Only the ego's motion is integrated; the other agents' states are looked up in given
trajectories.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused, is_on, some
from e2rl.scenes.recording import DT, HIDDEN
from e2rl.sim import dynamics
from e2rl.sim.neighbours import own_fault, passed
from e2rl.sim.observation import EGO_STATE, EgoState, features, glance, observe
from e2rl.sim.reward import reward_terms, rewarded_progress, weighted_sum
from e2rl.sim.static import STATIC, FrenetPose, StaticScene, follow
from e2rl.sim.world import AGENTS, Agents, trajectories_at

Tracks = tuple[
    Tensor, Tensor
]  # states [B, T+1, N, 4] and presence [B, T+1, N] of all agents
Outcome = dict[str, Tensor]  # see `step`
CONTACTS = (
    "contact",
    "contact_vru",
    "contact_object",
)  # with a vehicle, a pedestrian or cyclist, an object
FLAGS = (*CONTACTS, "off_road", "terminated", "truncated")


class StepConfig(NamedTuple):
    """What a step needs to know of the settings.

    ends [3] bool: whether contact, leaving the road and leaving the scene end an
    episode; weights [8] of reward.TERMS; low, high [2]: bounds of the action.
    """

    ends: Tensor
    weights: Tensor
    low: Tensor
    high: Tensor


class Driven(NamedTuple):
    """Egos after a step (`EgoState`, whose pose is s, d, heading), and of its outcome
    reward and progress, each [B]; truths [8, B], 0 or 1: FLAGS, and whether the egos
    are still in the scene and have been on the road; inside [B, M], 0 or 1."""

    state: Tensor
    action: Tensor
    s: Tensor
    d: Tensor
    heading: Tensor
    reward: Tensor
    progress: Tensor
    truths: Tensor
    inside: Tensor


def step(
    ego: EgoState,
    given: Tensor | Tracks,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    look: bool = True,
    ended: Tensor | None = None,
) -> tuple[EgoState, Outcome]:
    """The egos after a step, and the outcome of the step.

    Args:
        ego: the egos of B scenes now.
        given: their actions [B, 2] (acceleration m/s^2, yaw rate rad/s), which are
            clamped to the bounds; or the
            recording, which they follow, and leave the scene at its end.
        tracks: what all agents do.
        look: whether a policy looks at the observation.
        ended: [B] bool, egos that stay where they are.

    Returns:
        The egos, and observation [B, D] ([B, 0] without a look), reward, CONTACTS,
        off_road, terminated, truncated and progress (m along the mission since the
        start), each [B]. Whoever appears within the ego touches it only after they have
        been apart once, as in `metrics.contact.since_birth`.
    """
    horizon = tracks[0].shape[1] - 1
    now = (ego.step + 1).clamp(max=horizon)
    if ended is not None:
        now = torch.where(ended, ego.step, now)
    others = Agents(*(value[:, 1:] for value in trajectories_at(*tracks, now)))
    if not isinstance(given, Tensor):
        row = static.row[:, 0]
        given = given[0][row, now, 0], given[1][row, now, 0]
    elif is_on():
        stay = torch.zeros_like(ego.present) if ended is None else ended
        driven = drive(ego, given, now, others, *tracks, static, config, stay)
        *flags, present, on_road = (driven.truths > 0).unbind()
        pose = FrenetPose(driven.s, driven.d, heading=driven.heading)
        moved = EgoState(
            now,
            driven.state,
            action=driven.action,
            pose=pose,
            present=present,
            been_on_road=on_road,
            start_s=ego.start_s,
            inside=driven.inside > 0,
        )
        seen = (
            features(static, moved, others, now / horizon) if look else ego.state[:, :0]
        )
        numbers = {
            "observation": seen,
            "reward": driven.reward,
            "progress": driven.progress,
        }
        return moved, numbers | dict(zip(FLAGS, flags, strict=True))
    return _step(
        ego,
        given,
        now=now,
        others=others,
        tracks=tracks,
        static=static,
        config=config,
        look=look,
        ended=ended,
    )


@fused(
    EGO_STATE,
    "B 2!",
    "B:int64",
    AGENTS,
    "B T N 4!",
    "B T N:bool!",
    STATIC,
    ("3:bool!", "8", "2", "2"),
    "B:bool",
)
def drive(
    ego: EgoState,
    given: Tensor,
    now: Tensor,
    others: Agents,
    states: Tensor,
    known: Tensor,
    static: StaticScene,
    config: StepConfig,
    ended: Tensor,
) -> Driven:
    """`step` of actions without a look; now [B] is the step that the egos come to, at
    which others are met."""
    moved, of = _step(
        ego,
        given,
        now=now,
        others=others,
        tracks=(states, known),
        static=static,
        config=config,
        look=False,
        ended=ended,
    )
    truths = torch.stack(
        [*(of[name] for name in FLAGS), moved.present, moved.been_on_road]
    ).to(given.dtype)
    inside = moved.inside.to(given.dtype)
    return Driven(
        moved.state,
        moved.action,
        *moved.pose,
        of["reward"],
        of["progress"],
        truths,
        inside,
    )


def _step(
    ego: EgoState,
    given: Tensor | Tracks,
    now: Tensor,
    others: Agents,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    look: bool,
    ended: Tensor | None,
) -> tuple[EgoState, Outcome]:
    horizon = tracks[0].shape[1] - 1
    if isinstance(given, Tensor):
        state = dynamics.step(ego.state, torch.clamp(given, config.low, config.high))
        present = ego.present
    else:
        state = torch.where(given[1][:, None], given[0], ego.state)
        present = ego.present & given[1]
    action = dynamics.inverse(torch.stack([ego.state, state], 1))[:, 0]
    pose = follow(static, state[:, :2], hint=ego.pose.s + ego.state[:, 3] * DT)
    moved = EgoState(
        now,
        state,
        action=action,
        pose=pose,
        present=present,
        been_on_road=ego.been_on_road,
        start_s=ego.start_s,
        inside=ego.inside,
    )
    if ended is not None:
        stay = ended
        moved = ego.merged(
            moved,
            lambda old, new: torch.where(
                stay.view(-1, *[1] * (new.ndim - 1)), old, new
            ),
        )
        _, state, action, pose, present, *_ = moved
    seen = (observe if look else glance)(static, moved, others, now / horizon)
    both = ego.state, state
    near = passed(
        seen.neighbours,
        both,
        tracks=tracks,
        row=static.row,
        step=ego.step,
        size=static.size,
        half_size=static.half_size,
    )
    hit = (near.gap < 0) & others.present & present[:, None]
    inside = since_birth(
        hit,
        ego.inside,
        present=others.present,
        valid=tracks[1],
        row=static.row,
        now=now,
    )
    hit = hit & ~inside
    kinds = static.vehicle, ~(static.vehicle | static.plain), static.plain
    contacts = [some(hit & kind) for kind in kinds]
    off = seen.beyond > 0
    off_road = off & ego.been_on_road & present
    gone = ~present | (pose.s >= static.mission.end)
    touched = contacts[0] | contacts[1] | contacts[2]
    fault = own_fault(
        ego.state[:, 3], near, hit=hit, static=static, tracks=tracks, before=ego.step
    )
    progress = rewarded_progress(
        pose.s - ego.pose.s, seen.limit, top_speed=static.top_speed
    )
    terms = reward_terms(
        progress,
        touched,
        fault=fault,
        off_road=off_road,
        action=action,
        last_action=ego.action,
        speed=state[:, 3],
        limit=seen.limit,
        offset=pose.d,
    )
    on_contact, off_the_road, when_gone = config.ends.unbind()
    outcome = {
        "observation": seen.features,
        "reward": weighted_sum(terms, config.weights),
        **dict(zip(CONTACTS, contacts, strict=True)),
        "off_road": off_road,
        "terminated": (touched & on_contact) | (off_road & off_the_road),
        "truncated": (now >= horizon) | (gone & when_gone),
        "progress": pose.s - ego.start_s,
    }
    return moved._replace(
        present=~gone, been_on_road=ego.been_on_road | ~off, inside=inside
    ), outcome


def since_birth(
    overlap: Tensor,
    inside: Tensor,
    present: Tensor,
    valid: Tensor,
    row: Tensor,
    now: Tensor,
) -> Tensor:
    """Returns the agents [B, M] bool that have overlapped the ego ever since they
    appeared.

    Args:
        overlap, present: [B, M] bool, who overlaps the ego and who is there at this
            step.
        inside: [B, M] bool, this function's result of the step before.
        valid: [B, T+1, N] bool, presence of all agents, the ego first; row [B, 1]: 0 ..
            B - 1; now [B]: this step.
    """
    eager = not torch.compiler.is_compiling() and not overlap.is_cuda
    if eager and not bool((overlap | inside).any()):
        return inside
    steps = (now[:, None] - torch.arange(1, HIDDEN + 2, device=now.device)).clamp(min=0)
    agent = torch.arange(1, overlap.shape[1] + 1, device=now.device)
    absent = ~some(valid[row[..., None], steps[..., None], agent])
    return torch.where(present, overlap & (inside | absent), inside)


def hold_step(
    hold: int,
    look: bool,
    ego: EgoState,
    given: Tensor | Tracks,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
) -> tuple[EgoState, Outcome]:
    """`hold` times `step` under one action: rewards are summed, flags are of any step;
    a policy looks after the last.

    Egos whose episode ends stay at that moment, which is also the one they observe; the
    others observe the last one.
    """
    ego, outcome = step(
        ego, given, tracks=tracks, static=static, config=config, look=look and hold == 1
    )
    for last in range(2, hold + 1):
        ended = outcome["terminated"] | outcome["truncated"]
        ego, later = step(
            ego,
            given,
            tracks=tracks,
            static=static,
            config=config,
            look=look and last == hold,
            ended=ended,
        )
        flags = {name: outcome[name] | (later[name] & ~ended) for name in FLAGS}
        outcome = (
            later
            | flags
            | {"reward": outcome["reward"] + later["reward"].masked_fill(ended, 0)}
        )
    return ego, outcome
