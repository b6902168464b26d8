"""Virtual environments of the programs that read exports, each with its own pinned
packages.

They are kept in the folder E2RL_CLIENTS (default: ~/.cache/e2rl-clients), so a second
run does not install again. `python -m tests.report.export.clients.environment` installs
all of them.
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
PACKAGES = {
    "metadrive": ["metadrive-simulator==0.4.3"],
    "sumo": ["eclipse-sumo==1.28.0"],
    # commonroad-sumo and the drivability checker come with the designer.
    "commonroad": ["commonroad-scenario-designer==0.8.5"],
    # The library's pins do not fit the project's.
    "commonroad-io": ["--no-deps", "commonroad-io==2026.1", "iso3166==2.1.1"],
}


def environment(name: str) -> Path:
    """Returns the folder of an environment of PACKAGES; skips the test where it cannot
    be installed."""
    packages = PACKAGES[name]
    root = Path(
        os.environ.get("E2RL_CLIENTS") or Path.home() / ".cache" / "e2rl-clients"
    )
    content = " ".join([sys.version, *packages]).encode()
    folder = root / f"{name}-{hashlib.sha256(content).hexdigest()[:8]}"
    complete = folder / "complete"
    if complete.exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    command = [folder / "bin" / "pip", "install", "-q", "--no-compile", *packages]
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
    process = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=variables
    )
    assert process.returncode == 0, process.stderr[-3000:]
    return [
        json.loads(line.removeprefix("answer: "))
        for line in process.stdout.splitlines()
        if line.startswith("answer: ")
    ]


def main() -> None:
    """Installs every environment, or says why it cannot be."""
    for name in PACKAGES:
        try:
            print(environment(name))
        except pytest.skip.Exception as skipped:
            print(skipped)


if __name__ == "__main__":
    main()
