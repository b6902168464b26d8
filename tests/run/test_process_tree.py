"""What a command has started ends with it; helpers of libraries end by themselves;
orphans leave no zombies."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from e2rl.run import process_tree
from e2rl.run.process_tree import adopting, kill_descendants

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
SLEEP = ["-c", "import time; time.sleep(60)"]


def ended_by_kill(process: subprocess.Popen) -> bool:
    """Returns whether `kill_descendants` ends a process."""
    before = process_tree.descendants(os.getpid())
    while not Path(f"/proc/{process.pid}/cmdline").read_bytes():
        time.sleep(0.01)
    kill_descendants([each for each in before if each != process.pid])
    try:
        return process.wait(0.2) == -signal.SIGKILL
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False


@pytest.mark.parametrize(
    "words",
    [
        ["python", *SLEEP, "/opt/ray/planner.py", "--log", "wandb"],
        ["python", *SLEEP, "multiprocessing.resource_tracker"],
        ["/home/me/ray/bin/planner", *SLEEP],
        ["planner", *SLEEP, "ray::", "/site-packages/ray/"],
        ["my-raylet", *SLEEP],
    ],
)
def test_a_planner_is_ended_whatever_its_paths_and_options_are(words):
    assert ended_by_kill(subprocess.Popen(words, executable=sys.executable))


@pytest.mark.parametrize(
    "words",
    [
        ["/usr/lib/python3/site-packages/ray/core/src/ray/raylet/raylet", *SLEEP],
        ["gcs_server", *SLEEP],
        ["/home/me/wandb/bin/wandb-core", *SLEEP],
        ["ray::IDLE", *SLEEP],
        [
            "python3.11",
            "-c",
            "from multiprocessing.resource_tracker import main; import time; time.sleep(60)",
        ],
    ],
)
def test_helpers_of_libraries_end_by_themselves(words):
    assert not ended_by_kill(subprocess.Popen(words, executable=sys.executable))


def test_scripts_of_ray_end_by_themselves(tmp_path):
    script = tmp_path / "site-packages" / "ray" / "agent.py"
    script.parent.mkdir(parents=True)
    script.write_text("import time; time.sleep(60)")
    assert not ended_by_kill(subprocess.Popen([sys.executable, "-u", str(script)]))


def zombies() -> set[int]:
    """Returns the ended children of this process whose status nobody has taken."""
    found = [
        (number, state)
        for number, state, parent in process_tree._processes()
        if parent == os.getpid()
    ]
    return {number for number, state in found if state == "Z"}


def orphan() -> None:
    """Start a process of which nobody knows, and which ends at once."""
    subprocess.run(["sh", "-c", "(sleep 0.05 &) ; exit 0"], check=True)


def test_orphans_leave_no_zombies_and_others_keep_their_status(monkeypatch):
    monkeypatch.setattr(process_tree, "LOOK", 0.05)
    before = zombies()
    with adopting():
        child = subprocess.Popen(["sh", "-c", "exit 7"])
        for _ in range(5):
            orphan()
        time.sleep(0.3)  # they have ended
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline and zombies() - before != {child.pid}:
            time.sleep(0.05)
        assert zombies() - before == {child.pid}
        assert child.wait() == 7


def test_the_last_orphans_leave_no_zombies(monkeypatch):
    monkeypatch.setattr(process_tree, "LOOK", 60.0)
    before = zombies()
    with adopting():
        orphan()
        time.sleep(0.3)
        assert len(zombies() - before) == 1
    assert not zombies() - before
