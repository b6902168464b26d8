"""Work beside this process, in a forked one, whose result is a file that it writes."""

import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection

from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.cpu import configure_cpu
from e2rl.run.errors import InputError
from e2rl.run.processes import die_with_parent


class Prefetch:
    """`work()`, begun at once. A forked process sees what this one holds now; later
    changes of either are not the other's."""

    def __init__(self, work: Callable[[], None], name: str) -> None:
        """name: of the work, in messages."""
        context = multiprocessing.get_context("fork")
        self._name = name
        self._receiver, sender = context.Pipe(duplex=False)
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()  # or the fork would write it once more
        self._worker = context.Process(
            target=_run,
            args=(work, sender, os.getpid()),
            daemon=True,
        )
        self._worker.start()
        sender.close()

    def wait(self) -> float:
        """Wait for the end; returns the seconds that the work took. Raises InputError
        if it failed or was killed."""
        try:
            seconds, reason = self._receiver.recv()
        except EOFError:  # it died without a word
            seconds = 0.0
            reason = "its process was killed, perhaps for lack of memory"
        self._worker.join()
        self._receiver.close()
        if reason:
            raise InputError(f"{self._name}: {reason}")
        return seconds


def _run(work: Callable[[], None], sender: Connection, parent: int) -> None:
    die_with_parent(parent)
    configure_cpu(1)
    begin = time.perf_counter()
    reason = ""
    try:
        work()
    except InputError as error:
        reason = str(error)
    except KeyboardInterrupt:
        os._exit(1)  # the parent was interrupted too
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {error}"
    sender.send((time.perf_counter() - begin, reason))
    sender.close()


def why_no_prefetch(device: str, threads: int, ego: Ego) -> str:
    """Returns why the next round cannot be made beside learning, or nothing."""
    if not isinstance(ego, ActorEgo):
        return f"it hands over the weights of ego=actor, which {type(ego).__name__} has not"
    if (
        device != "cpu"
        or threads > 1
        or "fork" not in multiprocessing.get_all_start_methods()
    ):
        here = f"device={device}, threads={threads}, {sys.platform}"
        return f"it forks a process with one thread on the CPU; here are {here}"
    return ""
