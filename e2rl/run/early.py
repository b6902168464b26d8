"""Import this first in a command: Ctrl-C ends it in one line from then on, also while
heavy libraries load; so does a disk on which no temporary file can be written, which
these libraries need. Garbage is not collected while they load: that would look through
all of their objects time and again, for a sixth of the start.

`e2rl.run.endings.ending` takes over once the command knows how it can go on.
"""

import gc
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def loading() -> Iterator[None]:
    """Heavy libraries load in the block, where a command has begun already: what they
    leave in memory is never looked through for garbage."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"\ninterrupted before it began; run the same command again\n")
    os._exit(128 + number)


gc.disable()
if (
    signal.getsignal(signal.SIGINT) is signal.default_int_handler
):  # not in the background, which is deaf to it
    signal.signal(signal.SIGINT, _leave)
try:
    tempfile.gettempdir()
except FileNotFoundError as none:
    print(
        f"error: {none.strerror}; free space, or name a writable folder by TMPDIR",
        file=sys.stderr,
    )
    sys.exit(1)
