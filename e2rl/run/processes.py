"""Jobs spread over forked processes that share the parent's memory, or over the workers
of a Ray cluster.

The processes end with their parent: on Ctrl-C, on SIGTERM, on an error, and where it is
killed.
"""

import ctypes
import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import torch

from e2rl.run.errors import InputError
from e2rl.run.process_tree import adopting, descendants, kill_descendants
from e2rl.run.ray_workers import RayWorkers

PR_SET_PDEATHSIG = 1  # of prctl(2)

Job = TypeVar("Job")
Result = TypeVar("Result")
Processes = int | RayWorkers  # how many are forked here, or those elsewhere
_work: Callable[[int], bytes]  # of a forked worker, which has it without its being sent


def cores() -> int:
    """Returns how many cores this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


def in_processes(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: Processes,
    cost: Callable[[Job], float],
    ended: Callable[[Job], object] = lambda job: None,
) -> Iterator[Result]:
    """Returns function(job) of each job, in their order, computed by several processes.

    Forks share the parent's scenes and weights, and Ray workers are sent them, so
    results do not depend on `processes`. Raises InputError where a process was killed.

    Args:
        processes: number of forked processes of one thread each, or Ray workers. With
            one process or one job nothing is
            forked.
        cost: the jobs of greatest cost start first.
        ended: called with each job that has ended, in whatever order they do.
    """
    if isinstance(processes, int) and min(processes, len(jobs)) <= 1:
        for job in jobs:
            result = function(job)
            ended(job)
            yield result
        return
    order = sorted(range(len(jobs)), key=lambda k: -cost(jobs[k]))
    work = partial(_packed, function)
    with (
        _forked(work, jobs, processes=processes)
        if isinstance(processes, int)
        else processes.tasks(work, jobs) as submit
    ):
        with interrupts_held():
            futures = {submit(k): k for k in order}
        early = {}
        coming = 0
        for future in as_completed(futures):
            number = futures.pop(future)  # or all results would stay in memory
            early[number] = future.result()
            ended(jobs[number])
            while coming in early:
                yield torch.load(io.BytesIO(early.pop(coming)), weights_only=True)
                coming += 1


def _packed(function: Callable[[Job], Result], job: Job) -> bytes:
    """The result as bytes: tensors sent directly would each hold a shared-memory file
    open."""
    buffer = io.BytesIO()
    torch.save(function(job), buffer)
    return buffer.getvalue()


@contextmanager
def _forked(
    work: Callable[[Job], bytes], jobs: Sequence[Job], processes: int
) -> Iterator[Callable[[int], Future]]:
    """A function that submits a job by its number to forked workers."""
    try:
        with worker_pool(
            min(processes, len(jobs)), "fork", _adopt, lambda number: work(jobs[number])
        ) as pool:
            yield lambda number: pool.submit(_do, number)
    except BrokenProcessPool as error:
        raise InputError(
            f"processes={processes}: a process was killed, perhaps for lack of memory; use fewer "
            "(a run that is resumed may, too), or a smaller batch"
        ) from error


def _adopt(work: Callable[[int], bytes]) -> None:
    global _work
    _work = work


def _do(number: int) -> bytes:
    return _work(number)


# --- pools


@contextmanager
def worker_pool(
    processes: int,
    method: str,
    begin: Callable[..., object] | None = None,
    *arguments: Any,
) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes of one thread each, started by `method` (fork or spawn),
    which call begin(*arguments) first.

    Left by an exception, KeyboardInterrupt included, it kills its workers instead of
    waiting for them, with what these have started, such as the programs of a planner.
    """
    others = descendants(os.getpid())
    given = (os.getpid(), begin, arguments)
    pool = ProcessPoolExecutor(
        processes, multiprocessing.get_context(method), _begin, given
    )
    with adopting():
        try:
            yield pool
        except BaseException:
            kill_descendants(others)
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown(cancel_futures=True)


def _begin(parent: int, begin: Callable[..., object] | None, arguments: tuple) -> None:
    """Make this process a worker of `parent`."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # sent to all processes of a terminal; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent(parent)
    torch.set_num_threads(1)
    if begin is not None:
        begin(*arguments)


def die_with_parent(parent: int) -> None:
    """On Linux: let the kernel kill this process when `parent` is gone, however it
    went."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it went before
        os._exit(1)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C waits until the end of the block, and forever in the processes that it
    starts: their parent ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def without_main() -> Iterator[None]:
    """Processes that the block spawns do not import the running script, which would run
    again without a main guard."""
    main = sys.modules["__main__"]
    file = vars(main).pop("__file__", None)
    spec = getattr(main, "__spec__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        main.__spec__ = spec
        if file is not None:
            main.__file__ = file
