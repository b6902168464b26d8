"""What a command shows while it works: a bar on a terminal, a line now and then in a
file."""

import shutil
import sys
import textwrap
import time
from collections.abc import Sequence
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

NARROWEST, WIDEST = 60, 100  # columns
FIRST, EVERY = 10.0, 30.0  # s until the first line, and between lines


def terminal_width() -> int:
    """Returns the columns of the terminal, between 60 and 100; 100 where the output is
    no terminal."""
    return min(max(shutil.get_terminal_size((WIDEST, 24)).columns, NARROWEST), WIDEST)


def column_groups(sizes: Sequence[int], width: int) -> list[list[int]]:
    """Returns the columns that stand side by side, in groups of at most `width`: the
    first, and some of the others."""
    groups = [[0]]
    for column in range(1, len(sizes)):
        if (
            len(groups[-1]) > 1
            and sum(sizes[index] + 2 for index in groups[-1]) + sizes[column] > width
        ):
            groups.append([0])
        groups[-1].append(column)
    return groups


def columns(table: Sequence[Sequence[str]]) -> list[str]:
    """Returns aligned rows of text that fit the terminal; table: the heads, which may
    be wrapped, then rows.

    Columns that find no room stand beneath, beside the first column again, which is cut
    where it is too wide.
    """
    width = terminal_width()
    head, *rows = table
    sizes = [
        max(map(len, [*title.split(), *(row[column] for row in rows)]), default=0)
        for column, title in enumerate(head)
    ]
    room = width - sum(sizes[1:]) - 2 * (len(sizes) - 1)
    sizes[0] = min(sizes[0], max(width // 3, room))
    lines: list[str] = []
    for group in column_groups(sizes, width):
        body: list[list[str]] = []
        heads = [textwrap.wrap(head[column], sizes[column]) for column in group]
        height = max(map(len, heads))
        for line in range(-height, 0):
            body.append([title[line] if -line <= len(title) else "" for title in heads])
        for row in rows:
            body.append([row[column] for column in group])
            if len(row[0]) > sizes[0]:
                body[-1][0] = f"{row[0][: sizes[0] - 1]}…"
        align = ["left"] + ["right"] * (len(group) - 1)
        text = tabulate(body, tablefmt="plain", disable_numparse=True, colalign=align)
        lines += text.splitlines()
    return lines


def duration(seconds: float) -> str:
    """Returns a duration in its two largest sensible units."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{max(round(seconds), 1)} s"
    return (
        f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
    )


class Bar(tqdm):
    """A progress bar on stderr; where that is no terminal, a line after 10 s, and then
    every 30 s, if work is done.

    A line says how long the rest takes at the pace so far.
    """

    def __init__(self, *args: Any, **settings: Any) -> None:
        """Takes what tqdm takes."""
        self.as_lines = sys.stderr is None or not sys.stderr.isatty()
        self._line_due = time.monotonic() + FIRST
        super().__init__(
            *args,
            disable=sys.stderr is None,
            **settings,
        )  # as after `2>&-`

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Show the state: draw the bar, or write a line where one is due."""
        if not self.as_lines:
            return super().display(msg, pos)
        if self.n and time.monotonic() >= self._line_due:
            self._line_due = time.monotonic() + EVERY
            self.fp.write(f"{self.line()}\n")
            self.fp.flush()
        return True

    def clear(self, *args: Any, **settings: Any) -> None:
        """Take the bar away, for what `write` prints; lines stay."""
        if not self.as_lines:
            super().clear(*args, **settings)

    def line(self) -> str:
        """Returns the state in words."""
        elapsed = self._time() - self.start_t
        text = f"{self.desc.removesuffix(': ')}: {self.n:g}"
        if not self.total:
            return f"{text} after {duration(elapsed)}"
        left = elapsed * (self.total - self.n) / self.n
        text += f" of {self.total:g} after {duration(elapsed)}"
        return text + (f", about {duration(left)} left" if left > 0 else "")

    def close(self) -> None:
        """End the bar; lines need no end."""
        if self.as_lines:
            self.disable = True
        super().close()
