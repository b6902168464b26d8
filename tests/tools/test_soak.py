"""tools/soak.py: the memory and the CPU time that it tells are those of the processes that it started."""

import re
import subprocess
import sys
from threading import Timer

import pytest

from tools import soak

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
HOLDS = "data = b'x' * ({} << 20); print(flush=True); input()"
FORKS = "import os; data = b'x' * (120 << 20); os.fork(); print(flush=True); input()"
ROUNDS = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1].partition('=')[2]) / 'checkpoints'
for number in range(1, 4):
    end = time.process_time() + 0.3
    while time.process_time() < end: pass
    (folder / f'round-{number:06d}').mkdir(parents=True)
    time.sleep(0.5)
sys.exit(3)
"""


def started(code: str) -> subprocess.Popen:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", code], start_new_session=True, **pipes)


def measured(code: str, lines: int = 1) -> soak.Look:
    """A look at a process when it, with what it started, has printed so many lines."""
    run = started(code)
    try:
        for _ in range(lines):
            run.stdout.readline()
        return soak.look(run.pid)
    finally:
        run.communicate(b"\n" * lines)


def test_memory_is_what_a_process_holds():
    little, much = (measured(HOLDS.format(size)).own for size in (1, 121))
    assert much - little == pytest.approx(120, abs=5)


def test_pages_that_processes_share_count_once():
    assert measured(FORKS, lines=2).own < 1.5 * 120


def test_a_row_per_round_with_the_cpu_time_between(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(soak.watch, "__defaults__", (0.05,))
    run, file = f"hydra.run.dir={tmp_path / 'run'}", tmp_path / "soak.csv"
    assert soak.main(file, [sys.executable, "-c", ROUNDS, run]) == 3
    rows = [line.split(",") for line in file.read_text().splitlines()]
    assert [row[0] for row in rows] == ["number", "1", "2", "3"]
    assert all(0.2 < float(row[2]) < 1.0 for row in rows[1:])
    assert "3 rounds" in capfd.readouterr().out


def test_rounds_of_an_earlier_session_are_not_counted(tmp_path):
    (tmp_path / "checkpoints" / "round-000007").mkdir(parents=True)
    with started(HOLDS.format(1)) as run:
        run.stdout.readline()
        Timer(0.3, (tmp_path / "checkpoints" / "round-000008").mkdir).start()
        numbers = [next(soak.watch(run, tmp_path / "checkpoints", every=0.05)).number]
        run.communicate(b"\n")
    assert numbers == [8]


def test_drift_of_memory_is_told_from_the_second_round_on():
    rounds = [soak.Round(number, 60.0 * number, 10.0, own, 0.0) for number, own in ((1, 500), (2, 1000), (3, 1100))]
    assert re.search(r"from there \+0.0% to \+10.0%", soak.told(rounds))
