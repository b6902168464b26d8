"""Jobs spread over forked processes that share the parent's memory, or over the workers of a Ray cluster."""

import io
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import TypeVar

import torch

from e2rl.errors import InputError
from e2rl.ray_workers import RayWorkers, Submit
from e2rl.workers import interrupts_held, worker_pool

Job = TypeVar("Job")
Result = TypeVar("Result")
Processes = int | RayWorkers  # how many are forked here, or those elsewhere
_function: Callable  # the function of a worker's pool, and its jobs, which a fork has without being sent
_jobs: Sequence


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: Processes,
    cost: Callable[[Job], float],
    ended: Callable[[Job], object] = lambda job: None,
) -> Iterator[Result]:
    """function(job) of each job, in their order, by `processes` forked processes of one thread each, or by Ray workers;
    the jobs of greatest cost start first. With one process or one job, no process is forked. ended(job): called when a
    job has ended, in whatever order they do.

    Forks share the parent's scenes and weights, and Ray workers are sent them, so results do not depend on `processes`.
    """
    if isinstance(processes, int) and min(processes, len(jobs)) <= 1:
        for job in jobs:
            result = function(job)
            ended(job)
            yield result
        return
    order = sorted(range(len(jobs)), key=lambda k: -cost(jobs[k]))
    with _pool(function, jobs, processes) as submit:
        with interrupts_held():
            futures = {submit(k): k for k in order}
        early, coming = {}, 0
        for future in as_completed(futures):
            number = futures.pop(future)  # or all results would stay in memory
            early[number] = future.result()
            ended(jobs[number])
            while coming in early:
                yield torch.load(io.BytesIO(early.pop(coming)), weights_only=True)
                coming += 1


def _pool(function: Callable, jobs: Sequence, processes: Processes) -> AbstractContextManager[Submit]:
    """Submits jobs by their number."""
    if isinstance(processes, RayWorkers):
        return processes.tasks(partial(_packed, function), jobs)
    return _forked(function, jobs, processes)


@contextmanager
def _forked(function: Callable, jobs: Sequence, processes: int) -> Iterator[Submit]:
    try:
        with worker_pool(min(processes, len(jobs)), "fork", _adopt, function, jobs) as pool:
            yield lambda number: pool.submit(_call, number)
    except BrokenProcessPool as error:
        raise InputError(
            f"processes={processes}: a process was killed, perhaps for lack of memory; use fewer "
            "(a run that is resumed may, too), or a smaller batch"
        ) from error


def _adopt(function: Callable, jobs: Sequence) -> None:
    global _function, _jobs
    _function, _jobs = function, jobs


def _call(number: int) -> bytes:
    return _packed(_function, _jobs[number])


def _packed(function: Callable[[Job], Result], job: Job) -> bytes:
    """The result as bytes: tensors sent directly would each hold a shared-memory file open."""
    buffer = io.BytesIO()
    torch.save(function(job), buffer)
    return buffer.getvalue()
