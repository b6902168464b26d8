"""Jobs spread over forked processes that share the parent's memory, or over the workers of a Ray cluster.

Pools of worker processes that end with this one: on Ctrl-C, on SIGTERM, on an error, and where it is killed.

Work spread over the workers of a Ray cluster, as tasks that are done again where a worker was lost (extra `ray`).

How a command ends that cannot go on: one line on stderr that says why, and how to go on; no process left behind.
"""

import ctypes
import errno
import hashlib
import importlib
import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from pickle import PicklingError
from types import FrameType
from typing import Any, TypeVar

import torch

from e2rl.run.errors import InputError, stop

PR_SET_PDEATHSIG = 1  # of prctl(2)


@contextmanager
def worker_pool(
    processes: int, method: str, begin: Callable[..., object] | None = None, *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes of one thread each, which call begin(*arguments) first; method: fork or spawn.

    Left by an exception, KeyboardInterrupt included, it kills its workers instead of waiting for them.
    """
    others = set(multiprocessing.active_children())
    given = (os.getpid(), begin, arguments)
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context(method), _begin, given)
    try:
        yield pool
    except BaseException:
        kill_workers(others)
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown(cancel_futures=True)


def kill_workers(others: set | None = None) -> None:
    """Kill the worker processes of this process, but for `others`."""
    for child in set(multiprocessing.active_children()) - (others or set()):
        child.kill()


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C waits until the end of the block, and forever in the processes that it starts: their parent ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def without_main() -> Iterator[None]:
    """Processes that the block spawns do not import the running script, which would run again without a main guard."""
    main = sys.modules["__main__"]
    file, spec = vars(main).pop("__file__", None), getattr(main, "__spec__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        main.__spec__ = spec
        if file is not None:
            main.__file__ = file


def _begin(parent: int, begin: Callable[..., object] | None, arguments: tuple) -> None:
    """Make this process a worker of `parent`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # sent to all processes of a terminal; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent(parent)
    torch.set_num_threads(1)
    if begin is not None:
        begin(*arguments)


def die_with_parent(parent: int) -> None:
    """On Linux: let the kernel kill this process when `parent` is gone, however it went."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it went before
        os._exit(1)


RETRIES = 3  # times that a job is done again whose worker was lost
ADDRESS = "RAY_ADDRESS"  # environment variable: the cluster; without it, workers are started on this machine

VARIABLES = {  # of Ray, where the environment has none of its own
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to anybody
    "RAY_worker_niceness": "0",  # of workers started here; else they yield to everything on the machine
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # no warning about it
}

Submit = Callable[[int], Future]  # number of a job -> what will hold its result


@dataclass(frozen=True)
class RayWorkers:
    """Workers of one torch thread each, of the cluster at RAY_ADDRESS, or else started here.

    count: of those started here (None: one a core); modules: that a worker imports first, such as plugins. Raises
    InputError where Ray is not installed.
    """

    count: int | None = None
    modules: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if find_spec("ray") is None:
            raise InputError("launcher=ray: Ray is not installed; install e2rl with its extra: pip install 'e2rl[ray]'")

    @contextmanager
    def tasks(self, function: Callable[[Any], bytes], jobs: Sequence) -> Iterator[Submit]:
        """Submits jobs by their number: a task returns function(job). Function and jobs are sent once, whole.

        Raises what a task raised, and InputError where a job lost its worker RETRIES + 1 times or where what is sent,
        such as an ego of one's own, cannot be pickled. Left by an exception, it cancels the tasks.
        """
        ray, begun = self.connect(), []
        task = ray.remote(num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD")(_work)
        try:
            given = [ray.put((function, jobs))]  # in a list it arrives as a reference, which a worker resolves once
        except (TypeError, AttributeError, PicklingError) as error:
            reason = str(error).strip().splitlines()[0]
            raise InputError(f"launcher=ray: cannot be sent to workers: {reason}; set launcher=processes") from error

        def submit(number: int) -> Future:
            begun.append(task.remote(given, number, self.modules, _code()))
            return begun[-1].future()

        try:
            yield submit
        except BaseException as error:
            for reference in begun:
                ray.cancel(reference, force=True)
            if isinstance(error, ray.exceptions.RayTaskError):
                raise error.cause from error
            if isinstance(error, ray.exceptions.RayError):
                raise InputError(
                    f"launcher=ray: a job lost its worker {RETRIES + 1} times, perhaps for lack of memory; use fewer "
                    f"workers a machine, or a smaller batch ({' '.join(str(error).split())[:300]})"
                ) from error
            raise

    def connect(self) -> Any:
        """The module ray, connected to the cluster; first to be called in the main thread, where signals arrive."""
        for name, value in VARIABLES.items():
            os.environ.setdefault(name, value)
        ray = importlib.import_module("ray")
        if ray.is_initialized():
            return ray
        address, before = os.environ.get(ADDRESS), signal.getsignal(signal.SIGTERM)
        here = {} if address else {"address": "local", "num_cpus": self.count, "include_dashboard": False}
        try:
            ray.init(log_to_driver=False, **here)
        except Exception as error:  # of many types
            reason = " ".join(str(error).split())[:300]
            raise InputError(f"launcher=ray: no cluster at {address or 'this machine'}: {reason}") from error
        with suppress(ValueError, TypeError):  # where this is not the main thread, Ray has set no handler either
            signal.signal(signal.SIGTERM, before)  # e2rl.run.processes says how to go on
        return ray


def _work(given: list, number: int, modules: tuple[str, ...], code: str) -> bytes:
    """The result of a job, in a worker."""
    if code != _code():
        raise InputError("launcher=ray: a worker has another version of e2rl or torch; install the same everywhere")
    torch.set_num_threads(1)
    for name in modules:
        importlib.import_module(name)
    function, jobs = _sent(given[0])
    return function(jobs[number])


@lru_cache(maxsize=1)
def _sent(reference: Any) -> tuple[Callable[[Any], bytes], Sequence]:
    """What was sent, once for all jobs that this worker does."""
    return importlib.import_module("ray").get(reference)


@cache
def _code() -> str:
    """Torch's version and a hash of e2rl's code, the scripts apart, which an installed package holds, too."""
    digest, package = hashlib.sha256(torch.__version__.encode()), Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] != "scripts":
            digest.update(path.read_bytes())
    return digest.hexdigest()


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


WRITING = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES}


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


@contextmanager
def ending(command: str) -> Iterator[None]:
    """End the process where the block ends early: status 2 for bad input, 1 for a disk that cannot be written, 130 for
    Ctrl-C, 143 for SIGTERM. command: goes on where this one ends."""
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    except InputError as error:
        stop(error)
    except OSError as error:
        if error.errno not in WRITING:
            raise
        reason = f"{error.filename}: cannot be written ({error.strerror}); what was written before is whole"
        _end(f"error: {reason}. Free space, then go on with: {command}", 1)
    except KeyboardInterrupt as error:
        number = signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT
        _end(f"interrupted ({number.name}); go on with: {command}", 128 + number)
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _end(message: str, status: int) -> None:
    kill_workers()
    print(f"\n{message}", file=sys.stderr)
    sys.exit(status)
