"""How a command ends that cannot go on: one line on stderr says why and how to go on;
no process is left behind."""

import errno
import os
import select
import shlex
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from e2rl.run.errors import InputError
from e2rl.run.process_tree import descendants, kill_descendants

WRITING = {
    *(
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EROFS,
        errno.EIO,
        errno.EEXIST,
        errno.ENAMETOOLONG,
    ),
    *(errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR, errno.ELOOP),
}
REFUSED = 2  # status of a command that bad input ends
MEMORY = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
)  # in what torch raises, of a GPU's memory, too


def program() -> list[str]:
    """Returns the words that start the running command: `python evaluate.py`, `e2rl
    evaluate`, `python -m MODULE`."""
    script = Path(sys.argv[0])
    package = Path(__file__).parents[1]
    if script.suffix != ".py":
        return sys.argv[0].split()
    if package not in script.resolve().parents:
        return ["python", sys.argv[0]]
    return [
        "python",
        "-m",
        ".".join(script.resolve().relative_to(package.parent).with_suffix("").parts),
    ]


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
    arrived: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        arrived.append(number)
        raise KeyboardInterrupt

    heeded = [
        each
        for each in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(each) is not signal.SIG_IGN
    ]
    before = {number: signal.signal(number, interrupt) for number in heeded}
    others = descendants(os.getpid())
    try:
        yield
        if sys.stdout is not None:  # as after `>&-`
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        if arrived or isinstance(error, KeyboardInterrupt):
            number = signal.Signals(arrived[0] if arrived else signal.SIGINT)
            _end(
                f"\ninterrupted ({number.name}); go on with: {go_on()}",
                128 + number,
                others=others,
            )
        if isinstance(error, InputError):
            _end(f"error: {' '.join(str(error).split())}", REFUSED, others=others)
        if isinstance(error, BrokenPipeError) and _is_unread():
            os.dup2(
                os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            )  # or the end of python complains, too
            _end(
                f"\nerror: nobody reads the output any more; go on with: {go_on()}",
                1,
                others=others,
            )
        failed = (
            error.__cause__ if isinstance(error.__cause__, OSError) else error
        )  # of logging that is set up
        if isinstance(failed, OSError) and failed.errno in WRITING:
            where = failed.filename or "a file"
            reason = f"{where}: cannot be written ({failed.strerror}); what was written before is whole"
            _end(
                f"\nerror: {reason}. Mend that, then go on with: {go_on()}",
                1,
                others=others,
            )
        memory = isinstance(error, MemoryError) or (
            isinstance(error, OSError) and error.errno == errno.ENOMEM
        )
        if memory or (
            isinstance(error, RuntimeError)
            and any(words in str(error) for words in MEMORY)
        ):
            reason = "out of memory; what was written before is whole"
            _end(
                f"\nerror: {reason}. Free memory, or use fewer processes, then go on with: {go_on()}",
                1,
                others=others,
            )
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_unread() -> bool:
    """Returns whether the standard output is a pipe that nobody reads any more."""
    try:
        number = sys.stdout.fileno()
    except (
        AttributeError,
        ValueError,
    ):  # it is closed, or something else stands for it
        return False
    poll = select.poll()
    poll.register(number, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _end(message: str, status: int, others: Collection[int]) -> NoReturn:
    kill_descendants(others)
    print(message, file=sys.stderr)
    sys.exit(status)
