"""A command that is interrupted, killed or out of disk ends soon, leaves no process,
and says how to go on."""

import os
import resource
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.run.endings import ending
from e2rl.run.errors import InputError

SCRIPT = """
import os, sys, time
from pathlib import Path
from e2rl.run.endings import ending
from e2rl.run.processes import interrupts_held, worker_pool

def work(name):
    Path(name).write_text(str(os.getpid()))
    time.sleep(120)

if __name__ == "__main__":
    with ending(lambda: "do it again"), worker_pool(2, sys.argv[1]) as pool:
        with interrupts_held():
            found = pool.map(work, sys.argv[2:])
        list(found)
"""


def alive(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().split(") ")[1][:1]
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
@pytest.mark.parametrize(
    ("how", "method"),
    [
        ("Ctrl-C", "fork"),
        ("SIGTERM", "fork"),
        ("SIGKILL", "fork"),
        ("SIGKILL", "spawn"),
    ],
)
def test_an_interrupted_command_leaves_no_process(tmp_path, method, how):
    marks = [tmp_path / name for name in "ab"]
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, str(tmp_path / "script.py"), method, *map(str, marks)]
    heed = partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # tests in the background are started deaf to it
    run = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed,
    )
    while not all(mark.exists() and mark.read_text() for mark in marks):
        assert run.poll() is None, run.stderr.read()
        time.sleep(0.05)
    begin = time.monotonic()
    workers = [int(mark.read_text()) for mark in marks]
    if how == "Ctrl-C":
        os.killpg(run.pid, signal.SIGINT)  # a terminal sends it to all
    else:
        run.send_signal(getattr(signal, how))
    said = run.communicate(timeout=20)[1]
    while any(map(alive, workers)) and time.monotonic() - begin < 20:
        time.sleep(0.05)
    assert not any(map(alive, workers))
    assert time.monotonic() - begin < 20
    assert run.returncode == {"Ctrl-C": 130, "SIGTERM": 143, "SIGKILL": -9}[how]
    if how != "SIGKILL":
        name = "SIGINT" if how == "Ctrl-C" else how
        assert said.strip() == f"interrupted ({name}); go on with: do it again"


def unconfigured():
    raise ValueError("Unable to configure handler 'file'") from PermissionError(
        13, "Permission denied", "runs/log"
    )


@pytest.mark.parametrize(
    ("fail", "told"),
    [
        (
            lambda: os.write(os.open("/dev/full", os.O_WRONLY), b"x"),
            "a file: cannot be written (No space left",
        ),
        (
            lambda: Path("/dev/null/x").mkdir(),
            "/dev/null/x: cannot be written (Not a directory)",
        ),
        (
            lambda: Path("/dev/null").mkdir(),
            "/dev/null: cannot be written (File exists)",
        ),
        (
            lambda: Path("/dev").write_bytes(b""),
            "/dev: cannot be written (Is a directory)",
        ),
        (unconfigured, "runs/log: cannot be written (Permission denied)"),
        (lambda: torch.empty(2**48, dtype=torch.uint8), "out of memory"),
        (lambda: np.empty(2**50, np.uint8), "out of memory"),
    ],
)
def test_a_disk_or_memory_that_is_full_ends_in_one_line_with_how_to_go_on(
    capsys, fail, told
):
    with pytest.raises(SystemExit) as stopped, ending(lambda: "run x again"):
        fail()
    said = capsys.readouterr().err.strip()
    assert stopped.value.code == 1
    assert said.startswith(f"error: {told}")
    assert "\n" not in said
    assert said.endswith("go on with: run x again")


def test_bad_input_ends_with_its_message_and_other_errors_pass(capsys):
    before = [signal.getsignal(item) for item in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as stopped, ending(lambda: "run x again"):
        raise InputError("x=3: no")
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: x=3: no\n"
    for error in (ValueError("a bug"), FileNotFoundError(2, "none")):
        with pytest.raises(type(error)), ending(lambda: "run x again"):
            raise error
    assert [
        signal.getsignal(item) for item in (signal.SIGINT, signal.SIGTERM)
    ] == before


@pytest.mark.parametrize(
    ("code", "redirection", "status", "reason"),
    [
        ("print('good')", ">&-", 0, ""),
        (
            "print('x' * 100_000)",
            "| true",
            1,
            "error: nobody reads the output any more; go on with: again",
        ),
        (
            "time.sleep(0.5); print('x')",
            "| true",
            1,
            "error: nobody reads the output any more; go on with: again",
        ),
        (
            "raise BrokenPipeError(32, 'Broken pipe')",
            "| cat",
            1,
            "BrokenPipeError: [Errno 32] Broken pipe",
        ),
        (
            "raise BrokenPipeError(32, 'Broken pipe')",
            ">&-",
            1,
            "BrokenPipeError: [Errno 32] Broken pipe",
        ),
    ],
    ids=[
        "closed",
        "unread",
        "unread at the end",
        "another pipe",
        "another pipe, closed",
    ],
)
def test_an_output_that_nobody_reads_is_told_from_others(
    code, redirection, status, reason
):
    script = f"import time\nfrom e2rl.run.endings import ending\nwith ending(lambda: 'again'): {code}"
    command = f'set -o pipefail; "$0" -c "$1" {redirection}'
    process = subprocess.run(
        ["bash", "-c", command, sys.executable, script],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.returncode == status
    assert process.stderr.strip().splitlines()[-1:] == ([reason] if reason else [])


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
def test_an_interrupt_that_a_library_turns_into_an_error_of_its_own_is_one(
    capsys, monkeypatch, number, status
):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "a=$(touch x)"])
    before = signal.signal(
        number, signal.default_int_handler
    )  # where the tests run in the background it is ignored
    with pytest.raises(SystemExit) as stopped, ending():
        try:
            os.kill(os.getpid(), number)
            time.sleep(5)
        except KeyboardInterrupt as error:
            raise RuntimeError(
                "Converting a tensordict to boolean value is not permitted"
            ) from error
    signal.signal(number, before)
    assert stopped.value.code == status
    message = (
        f"interrupted ({number.name}); go on with: python evaluate.py 'a=$(touch x)'"
    )
    assert capsys.readouterr().err.strip() == message


@pytest.mark.parametrize(
    ("code", "status", "told"),
    [
        (
            "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(5)",
            130,
            "run the same command",
        ),
        ("", 1, "name a writable folder by TMPDIR"),
    ],
)
def test_what_ends_a_command_before_it_begins_is_one_line(code, status, told):
    """An interrupt; a disk on which nothing can be written."""

    def heed():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if not code:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))

    command = [sys.executable, "-c", f"import e2rl.commands.cli; {code}"]
    process = subprocess.run(
        command, stderr=subprocess.PIPE, text=True, preexec_fn=heed, timeout=60
    )
    assert process.returncode == status
    assert process.stderr.strip().count("\n") == 0
    assert told in process.stderr
