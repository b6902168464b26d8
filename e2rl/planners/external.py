"""A planner in another process or language, behind a socket (docs/how-to/planner.md
describes the protocol)."""

import os
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import (
    JUMPS,
    LARGEST,
    PLAN_STEPS,
    WILD,
    Ego,
    PlannerError,
    drivable,
)
from e2rl.planners.planner_link import (
    BadReply,
    PlannerFailed,
    PlannerLink,
    plan_message,
    read_reply,
    read_scene,
    scene_messages,
)
from e2rl.run.errors import InputError
from e2rl.run.settings import configured, setting
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
                "ego=external: give one of ego.command, which starts the planner, and ego.address of one that runs"
            )
        self._owner = os.getpid()
        self._starts = 0
        self._link: PlannerLink | None = None
        self._asked = torch.zeros(0, dtype=torch.int64)  # [B] step of the last request

    def plan(self, world: World) -> Tensor:
        """The planner's plans [B, PLAN_STEPS, 4], continued at constant velocity.

        Raises PlannerError where there is none for a scene, InputError where the
        planner cannot be started at all.
        """
        begun = self._begun(world)
        content = scene_messages(world, begun) + plan_message(world)
        replies = self._ask(content, len(world.step))
        plans = plans_of(
            world.states[:, 0].cpu().float(), replies, steps=self.replan_every
        )
        return plans.to(world.states)

    def _begun(self, world: World) -> list[int]:
        """Rows of the scenes that begin. A planner may have a memory, so it is asked
        once a step, in their order."""
        step = world.step.cpu()
        if len(step) != len(self._asked):
            self._asked = torch.full_like(step, torch.iinfo(step.dtype).max)
        if bool(((step > 0) & (step <= self._asked)).any()):
            raise InputError(
                "ego=external: asked about a moment that is not the next one of its scene; it drives in closed loop "
                "only, and traffic cannot query it (synthesizer=strive and cat need synthesizer.knowledge=predicted)"
            )
        self._asked = step.clone()
        return (step == 0).nonzero()[:, 0].tolist()

    def _ask(self, content: bytes, count: int) -> list[tuple[int, bytes]]:
        """Kinds and payloads of the planner's replies, one for each of `count` scenes,
        in their order."""
        link = self._connected(count)
        replies: dict[int, tuple[int, bytes]] = {}
        deadline = time.monotonic() + self.timeout * count
        try:
            if link.buffer:
                raise BadReply("more replies came than scenes were asked for")
            link.send(content, deadline)
            while len(replies) < count:
                kind, payload = link.receive(deadline)
                row = read_scene(kind, payload)
                if row >= count or row in replies:
                    raise BadReply(
                        f"a reply for scene {row}, which was not asked for or answered before"
                    )
                replies[row] = kind, payload
        except TimeoutError:
            why = f"no reply within {self.timeout:g} s a scene ({len(replies)} of {count} scenes answered)"
            raise self._dropped(
                PlannerTimedOut, f"{why}; see ego.timeout", replies=replies, count=count
            ) from None
        except (OSError, EOFError):
            raise self._dropped(
                PlannerDied, link.ending(), replies=replies, count=count
            ) from None
        except BadReply as error:
            raise self._dropped(BadReply, str(error), replies={}, count=count) from None
        return [replies[row] for row in range(count)]

    def _connected(self, count: int) -> PlannerLink:
        """The link of this process; opened where there is none, at most 1 + restarts
        times."""
        if self._owner != os.getpid():  # forked: the parent's link is the parent's
            self._owner = os.getpid()
            self._starts = 0
            self._link = None
        if self._link is not None:
            return self._link
        if self._starts > self.restarts:
            raise self._gone(
                f"it was restarted {self.restarts} times; see ego.restarts", count
            )
        self._starts += 1
        try:
            self._link = PlannerLink(
                self.command,
                self.address,
                replan_every=self.replan_every,
                timeout=self.start_timeout,
            )
        except InputError as error:
            if self._starts == 1:
                raise
            self._starts = self.restarts + 1
            raise self._gone(f"cannot be restarted: {error}", count) from error
        return self._link

    @staticmethod
    def _gone(why: str, count: int) -> PlannerDied:
        return PlannerDied(why, dict.fromkeys(range(count), why))

    def _dropped(
        self, kind: type[PlannerError], why: str, replies: dict, count: int
    ) -> PlannerError:
        """The error for a request that was not answered in full; the link is closed. A
        planner that answers scene by scene shows the one at fault: the first that has
        no answer."""
        if self._link is not None:
            self._link.close()
        self._link = None
        missing = next(row for row in range(count) if row not in replies)
        return kind(why, {missing: why} if replies else {})


def plans_of(now: Tensor, replies: list[tuple[int, bytes]], steps: int) -> Tensor:
    """Plans [B, PLAN_STEPS, 4] from states now [B, 4] by replies of at least `steps`
    steps; actions are held for so many. Raises PlannerError with the rows that have
    none."""
    failed: dict[int, str] = {}
    bad: dict[int, str] = {}
    given = torch.zeros(len(now), PLAN_STEPS, 4)
    known = torch.full((len(now),), steps)
    actions = torch.zeros(len(now), 2)
    acts = torch.zeros(len(now), dtype=torch.bool)
    for row, reply in enumerate(replies):
        try:
            found = torch.from_numpy(read_reply(*reply))
        except PlannerFailed as error:
            failed[row] = str(error)
        except BadReply as error:
            bad[row] = str(error)
        else:
            if found.dim() == 1:
                actions[row], acts[row] = found, True
            else:
                given[row, : len(found)], known[row] = found, len(found)
    if failed:
        raise PlannerFailed(next(iter(failed.values())), failed)
    held = dynamics.rollout(now, actions.nan_to_num()[:, None].expand(-1, steps, -1))
    given[:, :steps] = torch.where(acts[:, None, None], held, given[:, :steps])
    for why, wrong in {
        WILD: acts & ~(actions.abs() <= LARGEST).all(1),
        f"a TRAJECTORY of fewer than the {steps} steps until the next plan": known
        < steps,
        JUMPS: ~drivable(now, given, known=known),
    }.items():
        bad = dict.fromkeys(wrong.nonzero()[:, 0].tolist(), why) | bad
    if bad:
        raise BadReply(next(iter(bad.values())), bad)
    return continued(given, known)


def continued(given: Tensor, known: Tensor) -> Tensor:
    """States [B, H, 4] whose first `known` [B] are given, at constant velocity after
    these."""
    ahead = torch.arange(given.shape[1])
    last = given[torch.arange(len(given)), known - 1]
    later = dynamics.constant_velocity(last, DT * (ahead + 1 - known[:, None]))
    return torch.where((ahead < known[:, None])[..., None], given, later)
