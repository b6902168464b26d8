"""Rolling out what can be: where a planner or a traffic method raises, or a state becomes NaN or infinite, these
rollouts end, each with its reason, and the others go on.
"""

import errno
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import torch
from tensordict import TensorDictBase

from e2rl.planners.ego import PlannerError
from e2rl.run.errors import InputError
from e2rl.sim.rollouts import Rollouts

NOT_FINITE = "a state was NaN or infinite"
OF_THE_RUN = (InputError, MemoryError, torch.OutOfMemoryError)  # errors that are no single rollout's
EXHAUSTED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ENOMEM, errno.EMFILE, errno.ENFILE)  # nor these

Task = TypeVar("Task")
Batch = TypeVar("Batch", Rollouts, TensorDictBase)


def attempt(
    roll_out: Callable[[Sequence[Task]], Batch], tasks: Sequence[Task]
) -> tuple[list[tuple[list[Task], Batch]], list[tuple[Task, dict]]]:
    """(the tasks that could be rolled out, in parts with their rollouts; the others with the reasons).

    roll_out(tasks) returns Rollouts, or a TensorDict with states [B, ..., C] and valid [B, ...]. What raises for a
    batch is looked for by halving the batch, where a PlannerError does not name it.
    """
    try:
        rollouts = roll_out(tasks)
    except OF_THE_RUN:
        raise
    except (Exception, SystemExit) as error:  # outside code raises anything
        if isinstance(error, OSError) and error.errno in EXHAUSTED:
            raise
        named = error.rows if isinstance(error, PlannerError) else {}
        rows = {row: why for row, why in named.items() if 0 <= row < len(tasks)}
        if len(tasks) > 1 and not rows:
            half = len(tasks) // 2
            first, second = attempt(roll_out, tasks[:half]), attempt(roll_out, tasks[half:])
            return first[0] + second[0], first[1] + second[1]
        why = {"reason": f"raised {type(error).__name__}", "detail": str(error), "traceback": traceback.format_exc()}
        rows = rows or {0: str(error)}
        others = [task for row, task in enumerate(tasks) if row not in rows]
        own = [(tasks[row], why | {"detail": detail}) for row, detail in rows.items()]
        parts, further = attempt(roll_out, others) if others else ([], [])
        return parts, own + further
    known = rollouts.get("states").isfinite().all(-1) | ~rollouts.get("valid")
    finite = known.flatten(1).all(1).tolist()
    kept = [task for task, good in zip(tasks, finite, strict=True) if good]
    why = {"reason": NOT_FINITE, "detail": "", "traceback": ""}
    errored = [(task, dict(why)) for task, good in zip(tasks, finite, strict=True) if not good]
    rest = rollouts if all(finite) else rollouts[torch.tensor(finite)]
    return ([(kept, rest)] if kept else []), errored


def summary_of(errored: Iterable[dict]) -> str:
    """The reasons with their counts, and the first one's own words, for a message."""
    entries = list(errored)
    counts = ", ".join(f"{count} {reason}" for reason, count in count_reasons(entries).items())
    return f"{counts} ({entries[0]['detail'][:200]})"


def count_reasons(errored: Iterable[dict]) -> dict[str, int]:
    """How many rollouts errored for each reason."""
    return dict(Counter(entry["reason"] for entry in errored))
