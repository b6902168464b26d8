"""How a command ends that cannot go on: one line on stderr that says why, and how to go on; no process left behind."""

import errno
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from e2rl.errors import InputError, stop
from e2rl.workers import kill_workers

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
