"""Docstrings as the API pages show them: plain text in which [B, N] is a shape, and no
link of Markdown.

An extension of griffe, which reads the sources without importing them (mkdocs.yml).
Lists and code stay what they are.
"""

import re
from typing import Any

from griffe import Extension, Object

CODE = re.compile(r"(`[^`]+`|^ {4}.*$)", re.MULTILINE)
MARKS = str.maketrans({mark: f"&#{ord(mark)};" for mark in "[]*_<$\\"})


class PlainDocstrings(Extension):
    """Takes from docstrings what Markdown would read into brackets, stars and
    underscores."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Called for every module, class, function and attribute."""
        if obj.docstring:
            obj.docstring.value = plain(obj.docstring.value)


def plain(text: str) -> str:
    """A docstring without marks of Markdown outside of code."""
    parts = CODE.split(text)
    return "".join(
        part if index % 2 else part.translate(MARKS) for index, part in enumerate(parts)
    )
