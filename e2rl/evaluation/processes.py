"""Work spread over processes that share what was loaded before them."""

import io
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import torch

from e2rl.errors import InputError

Job = TypeVar("Job")
Result = TypeVar("Result")
_function: Callable  # of a worker: what its pool was made for


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    function: Callable[[Job], Result], jobs: Sequence[Job], processes: int, cost: Callable[[Job], float]
) -> Iterator[Result]:
    """function(job) of each job, in their order, by so many forked processes of one thread each; the dearest begin
    first. With one process, or one job, it is called here.

    Forks share the parent's scenes and weights, and so the same function gives the same numbers everywhere.
    """
    processes = min(processes, len(jobs))
    if processes <= 1:
        yield from map(function, jobs)
        return
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(processes, context, _adopt, (function,)) as pool:
        order = sorted(range(len(jobs)), key=lambda k: -cost(jobs[k]))
        futures = {k: pool.submit(_call, jobs[k]) for k in order}
        try:
            for k in range(len(jobs)):
                yield torch.load(io.BytesIO(futures[k].result()), weights_only=False)  # from a child of ours
        except BrokenProcessPool as error:
            raise InputError(
                f"processes={processes}: one of them was ended from outside, for want of memory perhaps; "
                "use fewer, or a smaller batch"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _adopt(function: Callable) -> None:
    global _function
    _function = function
    torch.set_num_threads(1)


def _call(job) -> bytes:
    """As bytes: tensors sent as they are would each hold a file of shared memory open."""
    buffer = io.BytesIO()
    torch.save(_function(job), buffer)
    return buffer.getvalue()
