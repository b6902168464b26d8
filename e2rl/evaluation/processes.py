"""Jobs spread over forked processes that share the parent's memory."""

import io
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import torch

from e2rl.errors import InputError
from e2rl.workers import interrupts_held, worker_pool

Job = TypeVar("Job")
Result = TypeVar("Result")
_function: Callable  # the function of a worker's pool


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    cost: Callable[[Job], float],
    ended: Callable[[Job], object] = lambda job: None,
) -> Iterator[Result]:
    """function(job) of each job, in their order, by `processes` forked processes of one thread each; the jobs of
    greatest cost start first. With one process or one job, no process is forked. ended(job): called when a job has
    ended, in whatever order they do.

    Forks share the parent's scenes and weights, so results do not depend on `processes`.
    """
    processes = min(processes, len(jobs))
    if processes <= 1:
        for job in jobs:
            result = function(job)
            ended(job)
            yield result
        return
    order = sorted(range(len(jobs)), key=lambda k: -cost(jobs[k]))
    try:
        with worker_pool(processes, "fork", _adopt, function) as pool:
            with interrupts_held():
                futures = {pool.submit(_call, jobs[k]): k for k in order}
            early, coming = {}, 0
            for future in as_completed(futures):
                early[futures[future]] = future.result()
                ended(jobs[futures[future]])
                while coming in early:
                    yield torch.load(io.BytesIO(early.pop(coming)), weights_only=True)
                    coming += 1
    except BrokenProcessPool as error:
        raise InputError(
            f"processes={processes}: a process was killed, perhaps for lack of memory; use fewer "
            "(a run that is resumed may, too), or a smaller batch"
        ) from error


def _adopt(function: Callable) -> None:
    global _function
    _function = function


def _call(job) -> bytes:
    """The result as bytes: tensors sent directly would each hold a shared-memory file open."""
    buffer = io.BytesIO()
    torch.save(_function(job), buffer)
    return buffer.getvalue()
