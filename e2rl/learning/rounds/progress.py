"""How long the rest of a training takes, and a round in one line."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from statistics import mean

from e2rl.run.terminal import Bar, duration


class Progress:
    """The phases of a training, by their kinds, in order. Phases of one kind take about
    equally long."""

    def __init__(self, kinds: Sequence[str]) -> None:
        """kinds: of the phases of which one of its kind has to be over before its
        length is known."""
        self._kinds = list(kinds)
        self._spent: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def phase(self, kind: str) -> Iterator[None]:
        """The next phase, of this kind, is done in the block."""
        begin = time.monotonic()
        yield
        self._spent[kind].append(time.monotonic() - begin)

    def left(self) -> str:
        """Returns the time left in words, "about 12 min left", by what phases of this
        run have taken.

        "" where nothing is left, and where no phase of a kind that is to come is over.
        """
        rest = Counter(self._kinds)
        rest.subtract({kind: len(seconds) for kind, seconds in self._spent.items()})
        seconds = 0.0
        for kind, count in (+rest).items():
            if not self._spent[kind]:
                return ""
            seconds += count * mean(self._spent[kind])
        return f"about {duration(seconds)} left" if +rest else ""

    def say(self, text: str) -> None:
        """Print a line with the time left, where it is known, above any progress bar."""
        with Bar.external_write_mode():
            print("; ".join(filter(None, [text, self.left()])), flush=True)


def round_line(metrics: Mapping[str, float], number: int, rounds: int) -> str:
    """A round in one line of at most 100 characters, errored rollouts apart."""
    hit = metrics.get("synthesizer/contact", float("nan"))
    left_out = metrics["synthesizer/left_out"]
    reasons = ", ".join(
        f"{count:.0f} {name.partition('/errored_')[2].replace('_', ' ')}"
        for name, count in metrics.items()
        if "/errored_" in name
    )
    harder = metrics.get("synthesizer/harder", 0.0)
    mix = f", {harder:.0f} harder" if harder else ""
    errored = f", without a score: {reasons}" if reasons else ""
    left = f", {left_out:.0f} left out" if left_out else ""
    return (
        f"round {number}/{rounds}: the attacks hit in {hit:.0%} of "
        f"{metrics['synthesizer/scenes']:.0f} scenes{left} "
        f"(eta {metrics['synthesizer/eta']:.2f}{mix}); {metrics['time/improve']:.0f} s learning"
        f"{errored}"
    )
