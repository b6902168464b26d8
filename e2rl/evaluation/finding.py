"""A property that was looked at before a run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A line of a check.

    Args:
        about: the property, in a word.
        fine: whether it holds; None where it need not, or could not be looked at.
        text: how it is, and where.
        mend: how to mend it.
    """

    about: str
    fine: bool | None
    text: str
    mend: str = ""
