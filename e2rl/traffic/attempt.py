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
EGO, TRAFFIC = "ego", "traffic"  # by whom a rollout errored
OF_THE_RUN = (
    InputError,
    MemoryError,
    torch.OutOfMemoryError,
)  # errors that are no single rollout's
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


def attempt(
    roll_out: Callable[[Sequence[Task]], Batch],
    tasks: Sequence[Task],
    begins: bool = False,
) -> tuple[list[tuple[list[Task], Batch]], list[tuple[Task, dict]]]:
    """(the tasks that could be rolled out, in parts with their rollouts; the others
    with the reasons).

    roll_out(tasks) returns Rollouts, or a TensorDict with states [B, ..., C] and valid
    [B, ...]. What raises for a batch is looked for by halving the batch, where a
    RowsError does not name it.

    Args:
        begins: the run begins with these rollouts, so that a planner whose first plan
            is a WrongPlan, which is then
            raised, has a mistake in its code.
    """
    try:
        rollouts = roll_out(tasks)
    except (Exception, SystemExit) as error:  # outside code raises anything
        if isinstance(error, WrongPlan):
            if begins and error.begins:
                raise
        elif isinstance(error, OF_THE_RUN):
            raise
        if isinstance(error, OSError) and error.errno in EXHAUSTED:
            raise
        named = error.rows if isinstance(error, RowsError) else {}
        rows = {row: why for row, why in named.items() if 0 <= row < len(tasks)}
        if len(tasks) > 1 and not rows:
            half = len(tasks) // 2
            first = attempt(roll_out, tasks[:half])
            second = attempt(roll_out, tasks[half:])
            return first[0] + second[0], first[1] + second[1]
        reason = (
            NOT_FINITE
            if isinstance(error, TrafficNotFinite)
            else f"raised {type(error).__name__}"
        )
        why = {
            "reason": reason,
            "detail": str(error),
            "traceback": traceback.format_exc(),
            "raised_by": raiser(error),
        }
        rows = rows or {0: str(error)}
        others = [task for row, task in enumerate(tasks) if row not in rows]
        own = [(tasks[row], why | {"detail": detail}) for row, detail in rows.items()]
        parts, further = attempt(roll_out, others) if others else ([], [])
        return parts, own + further
    known = rollouts.get("states").isfinite().all(-1) | ~rollouts.get("valid")
    finite = known.flatten(1).all(1).tolist()
    kept = [task for task, good in zip(tasks, finite, strict=True) if good]
    of_traffic = (~known[..., 1:]).flatten(1).any(1).tolist()  # row 0 is the ego
    why = {"reason": NOT_FINITE, "detail": "", "traceback": ""}
    errored = [
        (task, why | {"raised_by": TRAFFIC if theirs else EGO})
        for task, good, theirs in zip(tasks, finite, of_traffic, strict=True)
        if not good
    ]
    rest = rollouts if all(finite) else rollouts[torch.tensor(finite)]
    return ([(kept, rest)] if kept else []), errored


def raiser(error: BaseException) -> str:
    """Returns by whom something was raised: EGO where its code raised, or had no plan
    that can be driven."""
    noted = BY_EGO in getattr(error, "__notes__", ())
    return EGO if noted or isinstance(error, PlannerError | NotFinite) else TRAFFIC


def summary_of(errored: Iterable[dict]) -> str:
    """The reasons with their counts, and the first one's own words, for a message."""
    entries = list(errored)
    counts = ", ".join(
        f"{count} {reason}" for reason, count in count_reasons(entries).items()
    )
    return f"{counts} ({entries[0]['detail'][:200]})"


def count_reasons(errored: Iterable[dict]) -> dict[str, int]:
    """How many rollouts errored for each reason."""
    return dict(Counter(entry["reason"] for entry in errored))
