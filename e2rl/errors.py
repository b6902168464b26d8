"""The one exception for bad input: scripts print its message as one line and exit with status 2."""

import sys
from typing import NoReturn, TypeVar

Settings = TypeVar("Settings")


class InputError(ValueError):
    """Input that a user can mend; the message says what is wrong, where, and how to mend it."""


def stop(error: InputError) -> NoReturn:
    """End a script: the message as one line on stderr, exit status 2."""
    print("error:", " ".join(str(error).split()), file=sys.stderr)
    sys.exit(2)


def settings_of(kind: type[Settings], values, where: str) -> Settings:
    """kind(**values); InputError naming the configuration group `where` for keys that the class does not know."""
    try:
        return kind(**values)
    except TypeError as error:
        reason = str(error).partition(" ")[2]
        raise InputError(f"{where}: {reason}; compare the group with its file in conf/") from error
