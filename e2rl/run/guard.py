"""Runs a command, and ends it with all of its process group.

`python guard.py COMMAND...` ends the command when it is told by SIGTERM, or when the
process that writes its standard input is gone, however it went. It needs no library.
"""

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from multiprocessing.queues import SimpleQueue

GRACE = 1.0  # s between SIGTERM and SIGKILL
STARTED: list[SimpleQueue] = []  # of each pool, the numbers of its workers


def kill_group(leader: int, number: int = signal.SIGKILL) -> None:
    """Send a signal to a process and to all that it has started in its group."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, number)


def kill_workers() -> None:
    """Kill the workers of all pools, each with its process group."""
    for started in STARTED:
        while not started.empty():
            kill_group(started.get())


def main(command: list[str]) -> None:
    """Run the command; end as it ends."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )

    def end(*_: object) -> None:
        kill_group(process.pid, signal.SIGTERM)
        kill = threading.Timer(GRACE, kill_group, [process.pid])
        kill.daemon = True
        kill.start()

    def watch() -> None:
        os.read(sys.stdin.fileno(), 1)  # returns once nobody holds the other end
        end()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
    status = process.wait()
    kill_group(process.pid)
    sys.exit(status if status >= 0 else 128 - status)


if __name__ == "__main__":
    main(sys.argv[1:])
