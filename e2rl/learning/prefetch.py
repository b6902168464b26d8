"""Work beside this process, in a forked one or by workers elsewhere; its result is a file that it writes."""

import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing.connection import Connection
from threading import Thread

import torch

from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.processes import die_with_parent

DONE = b"done "  # begins a message of success, before the seconds


class Ahead:
    """`work()` in a process of its own, begun at once, with one thread. It sees what this process holds now; later
    changes of either are not the other's."""

    def __init__(self, work: Callable[[], None], name: str) -> None:
        """name: of the work, in messages."""
        context = multiprocessing.get_context("fork")
        self._name, (self._receiver, sender) = name, context.Pipe(duplex=False)
        sys.stdout.flush(), sys.stderr.flush()  # or the fork would write them once more
        self._process = context.Process(target=_run, args=(work, sender, os.getpid()), daemon=True)
        self._process.start()
        sender.close()

    def wait(self) -> float:
        """Wait for the end; returns the seconds that the work took. Raises InputError if it failed or was killed."""
        try:
            message = self._receiver.recv_bytes()
        except EOFError:  # it died without a word
            message = b""
        self._process.join()
        self._receiver.close()
        if message.startswith(DONE):
            return float(message.removeprefix(DONE))
        reason = message.decode() or (
            f"its process was killed (exit code {self._process.exitcode}), perhaps for lack of memory"
        )
        raise InputError(f"{self._name}: {reason}")


class AheadElsewhere:
    """`work()` in a thread of this process, for work that waits for workers elsewhere. It may see later changes."""

    def __init__(self, work: Callable[[], None], name: str) -> None:
        """name: of the work, in messages."""
        self._name, self._spent = name, Future[float]()
        Thread(target=self._run, args=(work,), daemon=True).start()

    def _run(self, work: Callable[[], None]) -> None:
        begin = time.perf_counter()
        try:
            work()
            self._spent.set_result(time.perf_counter() - begin)
        except BaseException as error:
            self._spent.set_exception(error)

    def wait(self) -> float:
        """Wait for the end; returns the seconds that the work took. Raises InputError if it failed."""
        try:
            return self._spent.result()
        except InputError as error:
            raise InputError(f"{self._name}: {error}") from error
        except Exception as error:
            raise InputError(f"{self._name}: {type(error).__name__}: {error}") from error


def why_not_ahead(device: str, threads: int, ego: Ego, traffic: str | None = None) -> str:
    """Why the next round cannot be synthesized beside learning, or nothing."""
    if traffic == "live":
        return "learner.round.traffic=live is not synthesized beforehand"
    if not isinstance(ego, ActorEgo):
        return f"it hands over the weights of ego=actor, which {type(ego).__name__} has not"
    if device != "cpu" or threads > 1 or "fork" not in multiprocessing.get_all_start_methods():
        here = f"device={device}, threads={threads}, {sys.platform}"
        return f"it forks a process with one thread on the CPU; here are {here}"
    return ""


def _run(work: Callable[[], None], sender: Connection, parent: int) -> None:
    die_with_parent(parent)
    torch.set_num_threads(1)
    begin = time.perf_counter()
    try:
        work()
        sender.send_bytes(DONE + f"{time.perf_counter() - begin:.3f}".encode())
    except InputError as error:
        sender.send_bytes(str(error).encode())
    except KeyboardInterrupt:
        os._exit(1)  # the parent was interrupted too
    except Exception as error:
        traceback.print_exc()
        sender.send_bytes(f"{type(error).__name__}: {error}".encode())
