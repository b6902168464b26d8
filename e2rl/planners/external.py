"""A planner in another process or language, behind a socket (docs/guide/planner.md
describes the protocol)."""

import os
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.ego_errors import PlannerError
from e2rl.planners.planner_link import PlannerLink
from e2rl.planners.planner_messages import (
    ACTION,
    BadReply,
    PlannerFailed,
    Reply,
    plan_message,
    read_reply,
    read_scene,
    scene_messages,
)
from e2rl.planners.plausibility import JUMPS, LARGEST, WILD, drivable
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.world import World


class PlannerTimedOut(PlannerError):
    """No reply in time."""


class PlannerDied(PlannerError):
    """The planner's process or the connection ended, or it may not be started again."""


@configured("ego/external")
@dataclass(eq=False)
class ExternalEgo(Ego):
    """Asks a planner outside of e2rl for the plans of all scenes of a batch by one
    message.

    Each process that drives scenes starts, or connects to, a planner of its own at its
    first plan.
    """

    command: str | None = setting()
    address: str | None = setting()
    timeout: float = setting(low=1e-3)
    start_timeout: float = setting(low=1e-3)
    restarts: int = setting(low=0)
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    def __post_init__(self) -> None:
        if bool(self.command) == bool(self.address):
            raise InputError(
                "ego=external: give one of ego.command, which starts the planner, and "
                "ego.address of one that runs"
            )
        self._process = os.getpid()
        self._starts = 0
        self._link: PlannerLink | None = None
        self._last_step = torch.zeros(0, dtype=torch.int64)  # [B] of the last request

    def plan(self, world: World) -> Tensor:
        """The planner's plans [B, PLAN_STEPS, 4], continued at constant velocity.

        Raises PlannerError where there is none for a scene, InputError where the
        planner cannot be started at all.
        """
        content = scene_messages(world, self._new_scenes(world)) + plan_message(world)
        replies = self._ask(content, len(world.step))
        state = world.states[:, 0].cpu().float()
        return plans_of(
            state,
            replies,
            steps=self.replan_every,
        ).to(world.states)

    def _new_scenes(self, world: World) -> list[int]:
        """Rows of the scenes that begin. A planner may have a memory, so it is asked
        once a step, in their order."""
        step = world.step.cpu()
        if len(step) != len(self._last_step):
            self._last_step = torch.full_like(step, torch.iinfo(step.dtype).max)
        if bool(((step > 0) & (step <= self._last_step)).any()):
            raise InputError(
                "ego=external: asked about a moment that is not the next one of its "
                "scene; it drives in closed loop only, and traffic cannot query it "
                "(synthesizer=strive and cat need synthesizer.knowledge=predicted)"
            )
        self._last_step = step.clone()
        return (step == 0).nonzero()[:, 0].tolist()

    def _ask(self, content: bytes, count: int) -> list[Reply]:
        """The planner's replies, one for each of `count` scenes, in their order."""
        link = self._connected(count)
        replies: dict[int, Reply] = {}
        deadline = time.monotonic() + self.timeout * count
        try:
            if link.buffer:
                raise BadReply("more replies came than scenes were asked for")
            link.send(content, deadline)
            while len(replies) < count:
                reply = link.receive(deadline)
                row = read_scene(reply)
                if row >= count or row in replies:
                    raise BadReply(
                        f"a reply for scene {row}, which was not asked for or answered "
                        "before"
                    )
                replies[row] = reply
        except TimeoutError:
            error: PlannerError = PlannerTimedOut(
                f"no reply within {self.timeout:g} s a scene ({len(replies)} of {count} "
                "scenes answered); see ego.timeout"
            )
        except (OSError, EOFError):
            error = PlannerDied(link.ending())
        except BadReply as bad_reply:
            error = bad_reply
            replies.clear()
        else:
            return [replies[row] for row in range(count)]
        link.close()
        self._link = None
        if (
            replies
        ):  # a planner that answers scene by scene: the first without an answer
            row = next(row for row in range(count) if row not in replies)
            error.rows = {row: str(error)}
        raise error

    def _connected(self, count: int) -> PlannerLink:
        """The link of this process; opened where there is none, at most 1 + restarts
        times. Raises PlannerDied for all of `count` scenes after these."""
        if self._process != os.getpid():  # forked: the parent's link is the parent's
            self._process = os.getpid()
            self._starts = 0
            self._link = None
        if self._link is not None:
            return self._link
        why = f"it was restarted {self.restarts} times; see ego.restarts"
        if self._starts <= self.restarts:
            self._starts += 1
            try:
                self._link = PlannerLink(
                    self.command,
                    self.address,
                    replan_every=self.replan_every,
                    timeout=self.start_timeout,
                )
                return self._link
            except InputError as error:
                if self._starts == 1:
                    raise
                self._starts = self.restarts + 1
                why = f"cannot be restarted: {error}"
        raise PlannerDied(why, dict.fromkeys(range(count), why))


def plans_of(
    state: Tensor,
    replies: list[Reply],
    steps: int,
) -> Tensor:
    """Plans [B, PLAN_STEPS, 4] from state [B, 4] by replies of at least `steps` steps;
    actions are held for so long. Raises PlannerError with the rows that have none."""
    failed: dict[int, str] = {}
    bad: dict[int, str] = {}
    plans = torch.zeros(len(state), PLAN_STEPS, 4)
    lengths = torch.full((len(state),), steps)
    actions = torch.zeros(len(state), 2)
    acts = torch.tensor([kind == ACTION for kind, _ in replies])
    for row, reply in enumerate(replies):
        try:
            values = torch.from_numpy(read_reply(reply))
        except PlannerFailed as error:
            failed[row] = str(error)
        except BadReply as error:
            bad[row] = str(error)
        else:
            if acts[row]:
                actions[row] = values
            else:
                plans[row, : len(values)] = values
                lengths[row] = len(values)
    if failed:
        raise PlannerFailed(next(iter(failed.values())), failed)
    held = dynamics.rollout(state, actions.nan_to_num()[:, None].expand(-1, steps, -1))
    plans[:, :steps] = torch.where(acts[:, None, None], held, plans[:, :steps])
    faults = {
        WILD: acts & ~(actions.abs() <= LARGEST).all(1),
        f"a TRAJECTORY of fewer than the {steps} steps until the next plan": (
            lengths < steps
        ),
        JUMPS: ~drivable(state, plans, length=lengths),
    }
    for why, wrong in faults.items():
        for row in wrong.nonzero()[:, 0].tolist():
            bad.setdefault(row, why)
    if bad:
        raise BadReply(next(iter(bad.values())), bad)
    return continued(plans, lengths)


def continued(plans: Tensor, length: Tensor) -> Tensor:
    """Plans [B, H, 4], at constant velocity after their first `length` [B] states."""
    step = torch.arange(plans.shape[1])
    last = plans[torch.arange(len(plans)), length - 1]
    later = dynamics.constant_velocity(last, DT * (step + 1 - length[:, None]))
    return torch.where((step < length[:, None])[..., None], plans, later)
