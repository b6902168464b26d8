"""One simulation step of B scenes, as a pure function of tensors, and several under one
action.

Only the ego's motion is integrated; the other agents' states are looked up in tracks.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused, is_on, some
from e2rl.scenes.recording import DT, HIDDEN
from e2rl.sim import dynamics
from e2rl.sim.neighbours import own_fault, passed
from e2rl.sim.observation import EGO_STATE, EgoState, features, glance, observe
from e2rl.sim.reward import Conduct, reward_terms, rewarded_progress, weighted_sum
from e2rl.sim.static import STATIC, FrenetPose, StaticScene, follow
from e2rl.sim.world import AGENTS, Agents, Tracks, agents_at

Outcome = dict[str, Tensor]  # see `step`
# With a vehicle, a pedestrian or cyclist, an object.
CONTACTS = ("contact", "contact_vru", "contact_object")
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
    command: Tensor | Tracks,
    *,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    look: bool = True,
    ended: Tensor | None = None,
) -> tuple[EgoState, Outcome]:
    """The egos after a step, and the outcome of the step.

    Args:
        ego: the egos of B scenes before it.
        command: their actions [B, 2] (acceleration m/s^2, yaw rate rad/s), which are
            clamped to the bounds; or the recording, which they follow, and leave the
            scene at its end.
        tracks: what all agents do.
        static: of the scenes.
        config: of the settings.
        look: whether a policy looks at the observation.
        ended: [B] bool, egos that stay where they are.

    Returns:
        The egos, and observation [B, D] ([B, 0] without a look), reward, CONTACTS,
        off_road, terminated, truncated and progress (m along the mission since the
        start), each [B]. Whoever appears within the ego touches it only after they have
        been apart once, as in `metrics.contact.since_birth`.
    """
    horizon = tracks.states.shape[1] - 1
    moment = (ego.step + 1).clamp(max=horizon)
    if ended is not None:
        moment = torch.where(ended, ego.step, moment)
    others = Agents(*(value[:, 1:] for value in agents_at(tracks, moment)))
    if not is_on() or not isinstance(command, Tensor):
        return _step(
            ego,
            command,
            moment=moment,
            others=others,
            tracks=tracks,
            static=static,
            config=config,
            look=look,
            ended=ended,
        )
    stay = torch.zeros_like(ego.present) if ended is None else ended
    driven = drive(ego, command, moment, others, tracks, static, config, stay)
    *flags, present, on_road = (driven.truths > 0).unbind()
    moved = ego._replace(
        step=moment,
        state=driven.state,
        action=driven.action,
        pose=FrenetPose(driven.s, driven.d, driven.heading),
        present=present,
        been_on_road=on_road,
        inside=driven.inside > 0,
    )
    observation = ego.state[:, :0]
    if look:
        observation = features(static, moved, others, moment / horizon)
    return moved, {
        "observation": observation,
        "reward": driven.reward,
        "progress": driven.progress,
        **dict(zip(FLAGS, flags, strict=True)),
    }


@fused(
    EGO_STATE,
    "B 2!",
    "B:int64",
    AGENTS,
    ("B T N 4!", "B T N:bool!"),
    STATIC,
    ("3:bool!", "8", "2", "2"),
    "B:bool",
)
def drive(
    ego: EgoState,
    action: Tensor,
    moment: Tensor,
    others: Agents,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    ended: Tensor,
) -> Driven:
    """`step` of actions without a look.

    Args:
        ego, action, tracks, static, config, ended: of `step`.
        moment: [B], the step that the egos come to.
        others: at that step.
    """
    moved, outcome = _step(
        ego,
        action,
        moment=moment,
        others=others,
        tracks=tracks,
        static=static,
        config=config,
        look=False,
        ended=ended,
    )
    flags = [outcome[name] for name in FLAGS]
    truths = torch.stack([*flags, moved.present, moved.been_on_road])
    return Driven(
        moved.state,
        moved.action,
        *moved.pose,
        reward=outcome["reward"],
        progress=outcome["progress"],
        truths=truths.to(action.dtype),
        inside=moved.inside.to(action.dtype),
    )


def _moved(
    ego: EgoState,
    command: Tensor | Tracks,
    *,
    moment: Tensor,
    static: StaticScene,
    config: StepConfig,
) -> EgoState:
    """The egos at step `moment` [B]: driven by actions or along their recording."""
    present = ego.present
    if isinstance(command, Tensor):
        action = torch.clamp(command, config.low, config.high)
        state = dynamics.step(ego.state, action)
    else:
        row = static.row[:, 0]
        recorded = command.valid[row, moment, 0]
        state = command.states[row, moment, 0]
        state = torch.where(recorded[:, None], state, ego.state)
        present = present & recorded
    hint = ego.pose.s + ego.state[:, 3] * DT
    return ego._replace(
        step=moment,
        state=state,
        action=dynamics.inverse(torch.stack([ego.state, state], 1))[:, 0],
        pose=follow(static, state[:, :2], hint),
        present=present,
    )


def _step(
    ego: EgoState,
    command: Tensor | Tracks,
    *,
    moment: Tensor,
    others: Agents,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    look: bool,
    ended: Tensor | None,
) -> tuple[EgoState, Outcome]:
    """See `step`; moment [B]: the step that the egos come to, others: at that step."""
    horizon = tracks.states.shape[1] - 1
    moved = _moved(
        ego,
        command,
        moment=moment,
        static=static,
        config=config,
    )
    if ended is not None:
        stay = ended
        moved = ego.merged(
            moved,
            lambda old, new: torch.where(
                stay.view(-1, *[1] * (new.ndim - 1)),
                old,
                new,
            ),
        )
    view = (observe if look else glance)(static, moved, others, moment / horizon)

    near = passed(
        view.neighbours,
        ego=moved.state,
        ego_before=ego.state,
        tracks=tracks,
        static=static,
        before=ego.step,
    )
    overlap = (near.gap < 0) & others.present & moved.present[:, None]
    inside = since_birth(
        overlap,
        ego.inside,
        present=others.present,
        valid=tracks.valid,
        row=static.row,
        moment=moment,
    )
    hit = overlap & ~inside
    kinds = (static.vehicle, ~(static.vehicle | static.plain), static.plain)
    contacts = [some(hit & kind) for kind in kinds]
    touched = contacts[0] | contacts[1] | contacts[2]
    off = view.beyond > 0
    off_road = off & ego.been_on_road & moved.present
    gone = ~moved.present | (moved.pose.s >= static.mission.end)

    conduct = Conduct(
        progress=rewarded_progress(
            moved.pose.s - ego.pose.s,
            view.limit,
            static.top_speed,
        ),
        contact=touched,
        fault=own_fault(
            ego.state[:, 3],
            near,
            hit=hit,
            static=static,
            tracks=tracks,
            before=ego.step,
        ),
        off_road=off_road,
        action=moved.action,
        last_action=ego.action,
        speed=moved.state[:, 3],
        limit=view.limit,
        offset=moved.pose.d,
    )
    on_contact, off_the_road, when_gone = config.ends.unbind()
    outcome = {
        "observation": view.features,
        "reward": weighted_sum(reward_terms(conduct), config.weights),
        **dict(zip(CONTACTS, contacts, strict=True)),
        "off_road": off_road,
        "terminated": (touched & on_contact) | (off_road & off_the_road),
        "truncated": (moment >= horizon) | (gone & when_gone),
        "progress": moved.pose.s - ego.start_s,
    }
    on_road = ego.been_on_road | ~off
    return moved._replace(
        present=~gone,
        been_on_road=on_road,
        inside=inside,
    ), outcome


def since_birth(
    overlap: Tensor,
    inside: Tensor,
    *,
    present: Tensor,
    valid: Tensor,
    row: Tensor,
    moment: Tensor,
) -> Tensor:
    """The agents [B, M] bool that have overlapped the ego ever since they appeared.

    Args:
        overlap: [B, M] bool, who overlaps the ego at this step.
        inside: [B, M] bool, this function's result of the step before.
        present: [B, M] bool, who is there at this step.
        valid: [B, T+1, N] bool, presence of all agents, the ego first.
        row: [B, 1], 0 .. B - 1.
        moment: [B], this step.
    """
    eager = not torch.compiler.is_compiling() and not overlap.is_cuda
    if eager and not bool((overlap | inside).any()):
        return inside
    back = torch.arange(1, HIDDEN + 2, device=moment.device)
    steps = (moment[:, None] - back).clamp(min=0)
    agent = torch.arange(1, overlap.shape[1] + 1, device=moment.device)
    absent = ~some(valid[row[..., None], steps[..., None], agent])
    return torch.where(present, overlap & (inside | absent), inside)


def hold_step(
    ego: EgoState,
    command: Tensor | Tracks,
    *,
    hold: int,
    tracks: Tracks,
    static: StaticScene,
    config: StepConfig,
    look: bool,
) -> tuple[EgoState, Outcome]:
    """`hold` times `step` under one action: rewards are summed, flags are of any step;
    a policy looks after the last.

    Egos whose episode ends stay at that moment, which is also the one they observe; the
    others observe the last one.

    Args:
        hold: steps, at least 1.
        ego, command, tracks, static, config, look: of `step`.
    """
    ego, outcome = step(
        ego,
        command,
        tracks=tracks,
        static=static,
        config=config,
        look=look and hold == 1,
    )
    for last in range(2, hold + 1):
        ended = outcome["terminated"] | outcome["truncated"]
        ego, later = step(
            ego,
            command,
            tracks=tracks,
            static=static,
            config=config,
            look=look and last == hold,
            ended=ended,
        )
        reward = outcome["reward"] + later["reward"].masked_fill(ended, 0)
        flags = {name: outcome[name] | (later[name] & ~ended) for name in FLAGS}
        outcome = later | flags | {"reward": reward}
    return ego, outcome
