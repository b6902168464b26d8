"""A command that writes into a file says now and then how far it is; what it says of
the rest is measured."""

import io
import sys
import time

from e2rl.run import terminal
from e2rl.run.terminal import Bar, duration


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_in_a_file_there_are_lines_at_the_pace_so_far(monkeypatch):
    output = io.StringIO()
    clock = [100.0]
    monkeypatch.setattr(sys, "stderr", output)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with Bar(total=40, desc="rollouts", unit="rollout", mininterval=0) as bar:
        bar._time = lambda: clock[0]
        bar.start_t = bar.last_print_t = clock[0]
        for _ in range(40):
            clock[0] += 4.0
            bar.update(1)
    lines = output.getvalue().splitlines()
    assert lines[0] == "rollouts: 3 of 40 after 12 s, about 2 min left"
    assert len(lines) == 5
    assert not any("\r" in line for line in lines)
    counts = [int(line.split()[1]) for line in lines]
    assert all(
        4.0 * (after - before) >= terminal.EVERY
        for before, after in zip(counts, counts[1:], strict=False)
    )


def test_short_work_says_nothing_in_a_file(monkeypatch):
    output = io.StringIO()
    monkeypatch.setattr(sys, "stderr", output)
    assert list(Bar(range(5), "scenes", mininterval=0)) == [0, 1, 2, 3, 4]
    assert output.getvalue() == ""


def test_a_terminal_has_a_bar(monkeypatch):
    output = Terminal()
    monkeypatch.setattr(sys, "stderr", output)
    list(Bar(range(5), "scenes"))
    assert "scenes: 100%" in output.getvalue()


def test_a_duration_has_its_sensible_units():
    assert [duration(seconds) for seconds in (0.2, 29, 90, 7300)] == [
        "1 s",
        "29 s",
        "2 min",
        "2 h 2 min",
    ]
