"""A guarded command ends with its process group, and its end is told."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from e2rl.run import guard

STARTS = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"])
pathlib.Path(sys.argv[1]).write_text(str(child.pid))
time.sleep(60)
"""


def guarded(*words: str) -> subprocess.Popen:
    command = [sys.executable, "-I", "-S", guard.__file__, *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)


def alive(process: int) -> bool:
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return False
    return text.rpartition(") ")[2][0] not in "ZX"


@pytest.mark.parametrize(("code", "status"), [("exit(7)", 7), ("abort()", 134)])
def test_it_ends_as_its_command_ends(code, status):
    code = f"import os, resource; resource.setrlimit(4, (0, 0)); os.{code}"
    process = guarded(sys.executable, "-c", code.replace("os.exit", "exit"))
    assert process.wait(20) == status


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
@pytest.mark.parametrize("how", ["SIGTERM", "its input is closed"])
def test_what_its_command_has_started_ends_too(tmp_path, how):
    mark = tmp_path / "child"
    process = guarded(sys.executable, "-S", "-c", STARTS, str(mark))
    while not mark.exists() or not mark.read_text():
        time.sleep(0.02)
    child = int(mark.read_text())
    assert alive(child)
    if how == "SIGTERM":
        process.send_signal(signal.SIGTERM)
    else:
        process.stdin.close()
    process.wait(20)
    deadline = time.monotonic() + 10
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(child)
