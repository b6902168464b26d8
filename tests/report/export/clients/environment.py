"""Virtual environments of the programs that read exports, each with its own pinned
packages.

They are kept in the folder E2RL_CLIENTS (default: ~/.cache/e2rl-clients), so a second
run does not install again.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SECONDS = 900  # to install; 300 to run
ANSWER = "answer: "
PROGRAMS = Path(__file__).parent / "programs"


def environment(name: str, *packages: str, options: tuple[str, ...] = ()) -> Path:
    """Returns the folder of an environment with `packages`; skips the test where they
    cannot be installed."""
    root = Path(
        os.environ.get("E2RL_CLIENTS") or Path.home() / ".cache" / "e2rl-clients"
    )
    digest = hashlib.sha256(
        " ".join((sys.version, *packages, *options)).encode()
    ).hexdigest()[:8]
    folder = root / f"{name}-{digest}"
    complete = folder / "complete"
    if complete.exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    command = [
        folder / "bin" / "pip",
        "install",
        "-q",
        "--no-compile",
        *options,
        *packages,
    ]
    try:
        subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=SECONDS
        )
    except subprocess.CalledProcessError as error:
        line = next(
            (line for line in reversed(error.stderr.splitlines()) if "ERROR" in line),
            "pip failed",
        )
        pytest.skip(f"{' '.join(packages)} cannot be installed: {line}")
    except subprocess.TimeoutExpired:
        pytest.skip(f"{' '.join(packages)} cannot be installed within {SECONDS} s")
    complete.touch()
    return folder


def answer(
    folder: Path, program: str, *arguments: Any, path: Path | None = None
) -> list[Any]:
    """Returns what a program prints with the Python of an environment: one JSON value
    per line.

    Args:
        folder: the environment.
        program: a file of programs/, without its suffix.
        arguments: of the program.
        path: a folder of commands that the program runs.
    """
    variables = dict(os.environ)
    variables.pop("PYTHONPATH", None)
    if path is not None:
        variables["PATH"] = f"{path}{os.pathsep}{variables['PATH']}"
    command = [
        folder / "bin" / "python",
        PROGRAMS / f"{program}.py",
        *map(str, arguments),
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=variables
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return [
        json.loads(line.removeprefix("answer: "))
        for line in done.stdout.splitlines()
        if line.startswith("answer: ")
    ]
