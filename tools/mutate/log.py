"""A recorded log as arrays that can be changed, and written again in its own format."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FIELDS = ("position", "heading", "velocity", "valid", "size", "stamps", "lines")


@dataclass
class RecordedLog:
    """position [F, A, 2] m, heading [F, A] rad, velocity [F, A, 2] m/s, valid [F, A], size [A, 2] m, stamps [F] s;
    lines: the points [P, 2] m of everything in the map; ego: its track, -1 where the file names none.

    file: its name, relative to the folder that it is written into; holds: those of FIELDS that the format has; edits:
    changes of the format's own content.
    """

    file: str
    position: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    valid: np.ndarray
    size: np.ndarray
    stamps: np.ndarray
    lines: list[np.ndarray]
    ego: int
    holds: frozenset[str] = frozenset(FIELDS)
    edits: list[Callable[[Any], None]] = field(default_factory=list)
    resized: bool = False

    def changed(self, change: Callable[["RecordedLog"], None]) -> "RecordedLog":
        """A copy with a change."""
        own = copy.copy(self)
        for name in FIELDS[:-1]:
            setattr(own, name, np.array(getattr(self, name)))
        own.lines, own.edits = [line.copy() for line in self.lines], []
        change(own)
        own.resized = not np.array_equal(own.size, self.size)
        return own

    def write(self, folder: Path) -> None:
        """Write the log's files into a folder."""
        raise NotImplementedError
