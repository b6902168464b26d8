"""The one exception for bad input: commands print its message as one line and exit with
status 2."""


class InputError(ValueError):
    """Input that a user can mend; the message says what is wrong, where, and how to
    mend it."""

    def __str__(self) -> str:
        """The message, in which what a terminal might obey, as of a stranger's names,
        is escaped."""
        return "".join(
            each if each.isprintable() or each == "\n" else ascii(each)[1:-1]
            for each in super().__str__()
        )
