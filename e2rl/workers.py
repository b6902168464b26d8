"""Pools of worker processes that end with this one: on Ctrl-C, on SIGTERM, on an error, and where it is killed."""

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

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
