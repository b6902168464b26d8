"""Jobs spread over processes that share the parent's memory.

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
from heapq import heappop, heappush
from multiprocessing.queues import SimpleQueue
from typing import Any, Generic, TypeVar

import torch

from e2rl.run.cpu import configure_cpu, release_memory
from e2rl.run.errors import InputError
from e2rl.run.guard import STARTED, kill_workers

PR_SET_PDEATHSIG = 1  # of prctl(2)

Job = TypeVar("Job")
Result = TypeVar("Result")
_work: Callable[[Any], bytes]  # of a forked worker, which has it without its being sent


def cores() -> int:
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_processes(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    processes: int,
    cost: Callable[[Job], float],
    ended: Callable[[Job], object] = lambda job: None,
) -> Iterator[Result]:
    """Yields function(job) of each job, in their order, computed by several processes.

    Forks share the parent's scenes and weights, so results do not depend on
    `processes`.

    Args:
        function: returns tensors and plain values.
        jobs: its arguments.
        processes: forked ones of one thread each. With one process or one job nothing
            is forked.
        cost: the jobs of greatest cost start first.
        ended: called with each job that has ended, in whatever order they do.

    Raises:
        InputError: where a process was killed.
    """
    early: dict[int, Result] = {}
    coming = 0

    def numbered(number: int) -> Result:
        return function(jobs[number])

    with workers(numbered, min(processes, len(jobs))) as crew:
        for number, job in enumerate(jobs):
            crew.submit(number, cost(job))
        for _ in jobs:
            number, result = crew.result()
            ended(jobs[number])
            early[number] = result
            while coming in early:
                yield early.pop(coming)
                coming += 1


class Workers(Generic[Job, Result]):
    """Do jobs beside each other, and hand out results as they come.

    Args:
        function: of a job.
        pool: of processes that have the function; None: jobs are done here, in their
            order.
        processes: of the pool.
    """

    def __init__(
        self,
        function: Callable[[Job], Result],
        pool: ProcessPoolExecutor | None,
        processes: int,
    ) -> None:
        self._function = function
        self._pool = pool
        self._processes = processes
        self._waiting: list[tuple[float, int, Job]] = []
        self._running: dict[Future[bytes], int] = {}
        self._count = 0

    def submit(self, job: Job, cost: float) -> int:
        """Returns the number of a job, which waits for those of greater cost."""
        number = self._count
        self._count += 1
        heappush(self._waiting, (0.0 if self._pool is None else -cost, number, job))
        self._start()
        return number

    def result(self) -> tuple[int, Result]:
        """Returns the number and the result of the next job that ends."""
        if self._pool is None:
            _, number, job = heappop(self._waiting)
            return number, self._function(job)
        future = next(as_completed(self._running))
        number = self._running.pop(future)
        self._start()
        return number, torch.load(io.BytesIO(future.result()), weights_only=True)

    def _start(self) -> None:
        """Give the pool jobs while it has a process to spare: of those that still
        wait, a later one may cost more."""
        if self._pool is None:
            return
        while self._waiting and len(self._running) < self._processes:
            _, number, job = heappop(self._waiting)
            with interrupts_held():
                self._running[self._pool.submit(_do, job)] = number


@contextmanager
def workers(
    function: Callable[[Job], Result], processes: int
) -> Iterator[Workers[Job, Result]]:
    """Gives Workers: several forks of one thread each, which share what this process
    has at the first job, or with one process this one.

    Args:
        function: returns tensors and plain values; its jobs are sent to the forks.
        processes: that do jobs.

    Raises:
        InputError: where a process was killed.
    """
    if processes <= 1:
        yield Workers(function, None, processes=1)
        return

    def packed(job: Job) -> bytes:
        # tensors sent directly would each hold a shared-memory file open
        buffer = io.BytesIO()
        torch.save(function(job), buffer)
        release_memory()
        return buffer.getvalue()

    try:
        with worker_pool(processes, "fork", _adopt, packed) as pool:
            yield Workers(function, pool, processes)
    except BrokenProcessPool as error:
        raise InputError(
            f"processes={processes}: a process was killed, perhaps for lack of memory; "
            "use fewer (a run that is resumed may, too), or a smaller batch"
        ) from error


def _adopt(work: Callable[[Any], bytes]) -> None:
    global _work
    _work = work


def _do(job: Any) -> bytes:
    return _work(job)


# --- pools


@contextmanager
def worker_pool(
    processes: int,
    method: str,
    begin: Callable[..., object] | None = None,
    *arguments: Any,
) -> Iterator[ProcessPoolExecutor]:
    """Gives a pool of processes of one thread each.

    Left by an exception, KeyboardInterrupt included, it kills its workers instead of
    waiting for them, with what these have started, such as the programs of a planner.

    Args:
        processes: number of workers.
        method: that starts them, fork or spawn.
        begin: called with the arguments in each worker first.
        arguments: of `begin`.
    """
    context = multiprocessing.get_context(method)
    started = context.SimpleQueue()
    pool = ProcessPoolExecutor(
        processes,
        context,
        initializer=_begin,
        initargs=(started, os.getpid(), begin, arguments),
    )
    STARTED.append(started)
    try:
        yield pool
    except BaseException:
        kill_workers()
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    else:
        pool.shutdown(cancel_futures=True)
    finally:
        STARTED.remove(started)


def _begin(
    started: SimpleQueue,
    parent: int,
    begin: Callable[..., object] | None,
    arguments: tuple,
) -> None:
    """Make this process a worker of `parent`, in a process group of its own, which a
    terminal's Ctrl-C does not reach."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent(parent)
    started.put(os.getpid())
    configure_cpu(1)
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
