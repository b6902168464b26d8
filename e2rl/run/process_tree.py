"""Processes, with all that they start in turn, which end together.

As a script, `python process_tree.py COMMAND...` runs a command and ends it, with all
that it has started, when it is told by SIGTERM or when the process that writes its
standard input is gone, however it went. It needs no library.
"""

import ctypes
import gc
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import popen_fork
from pathlib import Path

PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER = 36, 37  # of prctl(2)
PAUSE = 0.02  # s between two looks at what is left
GRACE = 1.0  # s between SIGTERM and SIGKILL
PATIENCE = 5.0  # s in which a killed process ends, unless it hangs in the kernel
LOOK = 0.3  # s between two looks at who has ended
PROCESSES = Path("/proc")
# Helpers of libraries, which end by themselves, and tidy up: programs, what Ray's
# workers call themselves, Ray's own scripts, and what Python runs by -c.
PROGRAMS = (b"raylet", b"gcs_server", b"wandb-core", b"wandb-symon")
TITLE = b"ray::"
SCRIPTS = b"-packages/ray/"
CODE = b"from multiprocessing.resource_tracker"


def descendants(root: int, spared: Collection[int] = ()) -> list[int]:
    """Returns the processes that descend from `root`, in whatever group or session, but
    for `spared` and what descends from those alone; none where there is no /proc."""
    children: dict[int, list[int]] = {}
    for process, state, parent in _processes():
        if state not in "ZX":
            children.setdefault(parent, []).append(process)
    found: list[int] = []
    waiting = [root]
    while waiting:
        own = [each for each in children.get(waiting.pop(), ()) if each not in spared]
        found += own
        waiting += own
    return found


def kill_descendants(spared: Collection[int] = ()) -> None:
    """Kill all that this process has started and that they have started, but for
    `spared` and helpers of libraries."""
    for child in multiprocessing.active_children():
        if child.pid not in spared:
            child.kill()
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        left = [
            each for each in descendants(os.getpid(), spared) if not _finishes(each)
        ]
        if not left:
            return
        _signal(
            left, signal.SIGKILL
        )  # what they have started meanwhile is there at the next look
        time.sleep(PAUSE)


@contextmanager
def adopting() -> Iterator[None]:
    """On Linux: what has lost its parent in the block becomes a child of this process,
    for `kill_descendants`.

    What of it ends leaves no zombie.
    """
    if sys.platform != "linux":
        yield
        return
    library = ctypes.CDLL(None, use_errno=True)
    before = ctypes.c_int()
    library.prctl(PR_GET_CHILD_SUBREAPER, ctypes.byref(before))
    library.prctl(PR_SET_CHILD_SUBREAPER, 1)
    ended = threading.Event()
    reaping = threading.Thread(target=Orphans().reap_until, args=(ended,), daemon=True)
    reaping.start()
    try:
        yield
    finally:
        ended.set()
        reaping.join()
        library.prctl(PR_SET_CHILD_SUBREAPER, before.value)


class Orphans:
    """Adopted processes that have ended.

    The system does not tell them from children that this process has started, whose
    status belongs to whoever waits for them: those are the ones that a Popen object
    knows. Another waiter takes a status at once, so what is left for a while is
    nobody's.
    """

    def __init__(self) -> None:
        self._zombies: set[int] = set()  # at the last look
        self._awaited: set[int] = set()

    def reap_until(self, ended: threading.Event) -> None:
        """Take the status of those that have ended, until the event, and then of the
        last."""
        while not ended.wait(LOOK):
            self._reap()
        self._reap()
        if self._zombies:
            time.sleep(PAUSE)
            self._reap()

    def _reap(self) -> None:
        """Take the status of those that had ended at the last look already."""
        zombies = _zombies()
        self._awaited &= zombies
        left = (self._zombies & zombies) - self._awaited
        if left:
            self._awaited |= zombies & _known_to_popen()
            for process in left - self._awaited:
                with suppress(ChildProcessError):
                    os.waitpid(process, os.WNOHANG)
        self._zombies = zombies - self._awaited


def _zombies() -> set[int]:
    """Returns the children of this process that have ended and whose status nobody has
    taken."""
    with suppress(ChildProcessError):
        if os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            own = os.getpid()
            return {
                process
                for process, state, parent in _processes()
                if state == "Z" and parent == own
            }
    return set()


def _known_to_popen() -> set[int]:
    """Returns the processes that have an object in this one which may wait for them."""
    kinds = (subprocess.Popen, popen_fork.Popen)
    popens = [each for each in gc.get_objects() if issubclass(type(each), kinds)]
    return {
        process
        for each in popens
        if (process := getattr(each, "pid", None)) is not None
    }


def _processes() -> Iterator[tuple[int, str, int]]:
    """Yields number, state and parent of all processes; none where there is no /proc."""
    for folder in PROCESSES.glob("[0-9]*"):
        with suppress(OSError):
            state, parent = (
                (folder / "stat").read_text().rpartition(") ")[2].split()[:2]
            )
            yield int(folder.name), state, int(parent)


def _finishes(process: int) -> bool:
    """Returns whether a process is a helper of a library, by its program, title or
    script."""
    try:
        words = (PROCESSES / str(process) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    if os.path.basename(words[0]) in PROGRAMS or words[0].startswith(TITLE):
        return True
    if not os.path.basename(words[0]).startswith(b"python"):
        return False
    script = next(
        (word for word in words[1:] if not word.startswith(b"-")), b""
    )  # or the code of -c
    return SCRIPTS in script or script.startswith(CODE)


def _signal(processes: Collection[int], number: int) -> None:
    for process in processes:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(process, number)


# --- the script


class Guard:
    """A command that runs, and its end."""

    def __init__(self, command: list[str]) -> None:
        """Raises OSError where it cannot be started."""
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        self._ending = threading.Event()
        self._ended = threading.Event()

    def watch(self) -> None:
        """End the command when nobody holds the other end of the standard input any
        more."""
        os.read(sys.stdin.fileno(), 1)
        self.end()

    def end(self) -> None:
        """End the command, and all that it has started: by SIGTERM, and what is left
        GRACE s later by SIGKILL."""
        if self._ending.is_set():
            return
        self._ending.set()
        deadline = time.monotonic() + GRACE
        _signal({self._process.pid, *descendants(os.getpid())}, signal.SIGTERM)
        while time.monotonic() < deadline and (
            self._process.poll() is None or descendants(os.getpid())
        ):
            time.sleep(PAUSE)
        if self._process.poll() is None:
            self._process.kill()
        kill_descendants()
        self._ended.set()

    def status(self) -> int:
        """Returns how the command ended, once nothing of it is left; below 0: by that
        signal."""
        status = self._process.wait()
        if self._ending.is_set():
            self._ended.wait()
        kill_descendants()
        return status


def main(command: list[str]) -> None:
    """Run the command; end as it ends."""
    with adopting():
        guard = Guard(command)
        signal.signal(
            signal.SIGTERM,
            lambda *_: threading.Thread(target=guard.end, daemon=True).start(),
        )
        signal.signal(signal.SIGINT, lambda *_: None)
        threading.Thread(target=guard.watch, daemon=True).start()
        status = guard.status()
    if status < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError):  # SIGKILL has no other handler
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    sys.exit(status)


if __name__ == "__main__":
    main(sys.argv[1:])
