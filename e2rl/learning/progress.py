"""What a training has to do, and how long it takes: a header at once, one line a phase and a round, in a pipe too."""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from tqdm import tqdm

ROLLOUT = 0.7  # s on one core, measured and scored
FRAMES = 7_000  # simulated steps a second that are collected and learned from
BEGIN = 20.0  # s to read what a run begins with


class Progress:
    """The phases of a training: (kind, expected seconds), in order. Phases of one kind take about equally long."""

    def __init__(self, phases: Sequence[tuple[str, float]]) -> None:
        self._phases = list(phases)
        self._spent: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def phase(self, kind: str) -> Iterator[None]:
        """The next phase, of this kind, is done in the block."""
        begin = time.monotonic()
        yield
        self._spent[kind].append(time.monotonic() - begin)

    def left(self) -> str:
        """Returns the time left in words: "about 12 min left", "done"."""
        done = {kind: len(seconds) for kind, seconds in self._spent.items()}
        seconds = 0.0
        for kind, guess in self._phases:
            if done.get(kind, 0) > 0:
                done[kind] -= 1
                continue
            known = self._spent[kind]
            seconds += sum(known) / len(known) if known else guess
        return f"about {duration(seconds)} left" if seconds else "done"

    def say(self, text: str) -> None:
        """Print a line with the time left, above any progress bar."""
        with tqdm.external_write_mode():
            print(f"{text}; {self.left()}", flush=True)


def duration(seconds: float) -> str:
    """A duration in its two largest sensible units."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{max(round(seconds), 1)} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
