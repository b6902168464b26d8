"""How a command ends that cannot go on: one line on stderr says why and how to go on;
no process is left behind."""

import errno
import gc
import os
import select
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from e2rl.run.errors import InputError
from e2rl.run.guard import kill_workers

WRITING = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EIO,
    errno.EEXIST,
    errno.ENAMETOOLONG,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.ELOOP,
}
REFUSED = 2  # status of a command that bad input ends
# in what torch raises, of a GPU's memory, too
MEMORY = ("can't allocate memory", "not enough memory", "out of memory")


def program() -> list[str]:
    """Returns the words that start the running command: `python evaluate.py`, `e2rl
    evaluate`, `python -m MODULE`."""
    script = Path(sys.argv[0])
    package = Path(__file__).parents[1]
    if script.suffix != ".py":
        return sys.argv[0].split()
    if package not in script.resolve().parents:
        return ["python", sys.argv[0]]
    module = script.resolve().relative_to(package.parent).with_suffix("")
    return ["python", "-m", ".".join(module.parts)]


def command_line() -> str:
    """Returns the running command, quoted for a shell."""
    return shlex.join([*program(), *sys.argv[1:]])


@contextmanager
def ending(go_on: Callable[[], str] = command_line) -> Iterator[None]:
    """End the process where the block ends early, with one line on stderr.

    The status is 2 for bad input, 1 for a full disk or memory, 130 for Ctrl-C, 143 for
    SIGTERM. Libraries may turn the interrupt into an error of their own, or lose it on
    the way; what counts is that the signal arrived. go_on: returns the command that
    goes on where this one ends.
    """
    if not gc.isenabled():  # while libraries loaded (early.py)
        gc.freeze()
        gc.enable()
    arrived: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        arrived.append(number)
        raise KeyboardInterrupt

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, interrupt)
    try:
        yield
        if sys.stdout is not None:  # as after `>&-`
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt):
            arrived.append(signal.SIGINT)
        message, status = _told(error, arrived, go_on)
        if message is None:
            raise
        kill_workers()
        print(message, file=sys.stderr)
        sys.exit(status)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _told(
    error: BaseException,
    arrived: list[int],
    go_on: Callable[[], str],
) -> tuple[str | None, int]:
    """The line that an error ends in, and the status; None where it is of the code."""
    if arrived:
        number = signal.Signals(arrived[0])
        message = f"\ninterrupted ({number.name}); go on with: {go_on()}"
        return message, 128 + number
    if isinstance(error, InputError):
        return f"error: {' '.join(str(error).split())}", REFUSED
    if isinstance(error, BrokenPipeError) and _is_unread():
        # or the end of python complains, too
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return f"\nerror: nobody reads the output any more; go on with: {go_on()}", 1
    cause = error.__cause__  # of logging that is set up
    failed = cause if isinstance(cause, OSError) else error
    if isinstance(failed, OSError) and failed.errno in WRITING:
        where = failed.filename or "a file"
        message = (
            f"\nerror: {where}: cannot be written ({failed.strerror}); what was written "
            f"before is whole. Mend that, then go on with: {go_on()}"
        )
        return message, 1
    if out_of_memory(error):
        message = (
            "\nerror: out of memory; what was written before is whole. Free memory, or "
            f"use fewer processes, then go on with: {go_on()}"
        )
        return message, 1
    return None, 1


def out_of_memory(error: BaseException) -> bool:
    """Returns whether an error says that memory is full, a GPU's included."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    if isinstance(error, RuntimeError):
        return any(words in str(error) for words in MEMORY)
    return isinstance(error, MemoryError)


def _is_unread() -> bool:
    """Returns whether the standard output is a pipe that nobody reads any more."""
    try:
        number = sys.stdout.fileno()
    except (AttributeError, ValueError):  # closed, or something else stands for it
        return False
    poll = select.poll()
    poll.register(number, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
