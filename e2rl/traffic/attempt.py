"""Rolling out what can be: where a planner or a traffic method raises, or a state
becomes NaN or infinite, these rollouts end, each with its reason, and the others go on.
"""

import errno
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import torch
from tensordict import TensorDictBase

from e2rl.planners.ego_errors import (
    BY_EGO,
    NotFinite,
    PlannerError,
    RowsError,
    TrafficNotFinite,
    WrongPlan,
)
from e2rl.run.errors import InputError
from e2rl.sim.rollouts import Rollouts

NOT_FINITE = "a state was NaN or infinite"
EGO = "ego"  # by whom a rollout errored
TRAFFIC = "traffic"
# Errors that are no single rollout's.
OF_THE_RUN = (InputError, MemoryError, torch.OutOfMemoryError)
EXHAUSTED = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EIO,
    errno.ENOMEM,
    errno.EMFILE,
    errno.ENFILE,
)  # nor these

Task = TypeVar("Task")
Batch = TypeVar("Batch", Rollouts, TensorDictBase)
Parts = list[tuple[list[Task], Batch]]  # tasks that could be rolled out, and how
Errored = list[tuple[Task, dict]]  # tasks that could not, and why


def attempt(
    roll_out: Callable[[Sequence[Task]], Batch],
    tasks: Sequence[Task],
    begins: bool = False,
) -> tuple[Parts, Errored]:
    """The tasks that could be rolled out, in parts with their rollouts; the others with
    the reasons.

    roll_out(tasks) returns Rollouts, or a TensorDict with states [B, ..., C] and valid
    [B, ...]. What raises for a batch is looked for by halving the batch, where a
    RowsError does not name it. begins: the run begins with these rollouts, so that a
    planner whose first plan is a WrongPlan, which is then raised, has a mistake in its
    code.
    """
    try:
        return _finite(roll_out(tasks), tasks)
    except (Exception, SystemExit) as error:  # outside code raises anything
        if _ends_the_run(error, begins):
            raise
        failure = error
    # Outside of the block, so that no half has the whole batch's error as its context.
    named = failure.rows if isinstance(failure, RowsError) else {}
    details = {row: why for row, why in named.items() if 0 <= row < len(tasks)}
    if len(tasks) > 1 and not details:
        half = len(tasks) // 2
        first = attempt(roll_out, tasks[:half])
        second = attempt(roll_out, tasks[half:])
        return first[0] + second[0], first[1] + second[1]
    why = {
        "reason": f"raised {type(failure).__name__}",
        "detail": str(failure),
        "traceback": "".join(traceback.format_exception(failure)),
        "raised_by": raiser(failure),
    }
    if isinstance(failure, TrafficNotFinite):
        why["reason"] = NOT_FINITE
    details = details or {0: str(failure)}
    errored = [
        (tasks[row], why | {"detail": detail}) for row, detail in details.items()
    ]
    others = [task for row, task in enumerate(tasks) if row not in details]
    parts, further = attempt(roll_out, others) if others else ([], [])
    return parts, errored + further


def _ends_the_run(error: BaseException, begins: bool) -> bool:
    if isinstance(error, WrongPlan):
        return begins and error.begins
    if isinstance(error, OF_THE_RUN):
        return True
    return isinstance(error, OSError) and error.errno in EXHAUSTED


def _finite(rollouts: Batch, tasks: Sequence[Task]) -> tuple[Parts, Errored]:
    """`attempt` of rollouts in which some state may be NaN or infinite."""
    finite = rollouts.get("states").isfinite().all(-1) | ~rollouts.get("valid")
    good = finite.flatten(1).all(1)
    of_traffic = (~finite[..., 1:]).flatten(1).any(1)  # row 0 is the ego
    why = {"reason": NOT_FINITE, "detail": "", "traceback": ""}
    errored = [
        (tasks[row], why | {"raised_by": TRAFFIC if of_traffic[row] else EGO})
        for row in (~good).nonzero()[:, 0].tolist()
    ]
    remaining = [tasks[row] for row in good.nonzero()[:, 0].tolist()]
    rest = rollouts[good.cpu()] if errored else rollouts
    return ([(remaining, rest)] if remaining else []), errored


def raiser(error: BaseException) -> str:
    """Returns by whom something was raised: EGO where its code raised, or had no plan
    that can be driven."""
    noted = BY_EGO in getattr(error, "__notes__", ())
    return EGO if noted or isinstance(error, PlannerError | NotFinite) else TRAFFIC


def summary_of(errored: Iterable[dict]) -> str:
    """The reasons with their counts, and the first one's own words, for a message."""
    entries = list(errored)
    reasons = count_reasons(entries)
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    return f"{counts} ({entries[0]['detail'][:200]})"


def count_reasons(errored: Iterable[dict]) -> dict[str, int]:
    """How many rollouts errored for each reason."""
    return dict(Counter(entry["reason"] for entry in errored))
