"""The one exception for bad input: scripts print its message as one line and exit with status 2."""

import sys
from typing import NoReturn


class InputError(ValueError):
    """Input that a user can mend; the message says what is wrong, where, and how to mend it."""


def stop(error: InputError) -> NoReturn:
    """End a script: the message as one line on stderr, exit status 2."""
    print("error:", " ".join(str(error).split()), file=sys.stderr)
    sys.exit(2)
