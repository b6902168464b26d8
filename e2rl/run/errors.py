"""The one exception for bad input: commands print its message as one line and exit with status 2."""


class InputError(ValueError):
    """Input that a user can mend; the message says what is wrong, where, and how to mend it."""
