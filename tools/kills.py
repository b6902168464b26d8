"""python tools/kills.py N [--seed S] [--stages NAME ...]: N runs are killed and
resumed, then compared.

Each stage of STAGES runs once without interruption, on a few bundled scenes. Then it is
started anew, killed by SIGINT, SIGTERM or SIGKILL at a random moment, and resumed;
every third is killed again in the resumed run. Its folder is compared with that of the
uninterrupted run: the same files, and the same content but for wall times. Prints a
line a kill and a table. The exit status is 1 where something differs or a process
outlives its parent.
"""

import argparse
import csv
import io
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load

from e2rl.run.parts import HASHED, read_state
from e2rl.run.run import PROVENANCE

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LIMIT = 600.0  # s of one command
SCENES = "data.build.steps=20 data.build.vehicles=8 data.build.others=2 data.build.field_cells=128 data.workers=1"
TRAINED = f"train.py {SCENES}"
TESTED = f"evaluate.py data.split=tune {SCENES} prior.sampler.steps=2"
STAGES = {
    "prior": f"{TRAINED} stage=prior num_scenes=40 prior.network.width=32 stage.steps=60"
    " stage.validate_every=10 stage.route_steps=50",
    "imitation": f"{TRAINED} stage=imitation num_scenes=8 stage.epochs=20 stage.minibatch=64",
    "evolution": f"{TRAINED} prior.sampler.steps=2 num_scenes=4 rounds=3 batch=4 "
    "learner.round.scenes=4"
    " learner.collect.batch=4 learner.collect.iterations=1 measure.scenes=4 "
    "measure.seeds=[0] measure.eta=2",
    "evaluation": f"{TESTED} num_scenes=4 seeds=[0,1] batch=2 processes=2",
    "table1": f"{TESTED} experiment=table1 methods=[e2,e2_pursuit,nominal,ctg_adv] "
    "num_scenes=2 seeds=[0,1] batch=1",
}
WORKING = {
    ".hydra",
    "parts",
    "time",
}  # what a run keeps for itself, and logs of wall times
TIMED = re.compile(
    r"seconds|^time$|^cwd$"
)  # names of wall times, and of the folder that a run began in
DERIVED = {".pdf", ".md", ".tex", ".log", ".html"}  # files that show what others hold
HASHES = "sha256.json"  # of files that are compared themselves


def start(command: list[str], folder: Path) -> subprocess.Popen:
    """The command in a session of its own; `folder` is its working directory."""
    folder.mkdir(parents=True, exist_ok=True)
    heed = partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # a shell starts background jobs deaf to it
    with (folder / "output.txt").open("a") as output:
        return subprocess.Popen(
            [sys.executable, str(ROOT / command[0]), *command[1:]],
            cwd=folder,
            start_new_session=True,
            preexec_fn=heed,
            stdout=output,
            stderr=output,
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        )


def living(session: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, number = entry.read_text().rpartition(") ")[2].split()[:4]
        except OSError:
            continue
        found += [int(entry.parent.name)] * (
            int(number) == session and state not in "ZX"
        )
    return found


def killed(
    command: list[str], folder: Path, after: float, number: signal.Signals
) -> tuple[bool, str]:
    """(whether the command was still at work, what is wrong) of one that gets a signal
    after some seconds."""
    run = start(command, folder)
    try:
        status = run.wait(after)
        return False, f"status {status}" if status else ""
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, number) if number is signal.SIGINT else run.send_signal(
            number
        )  # as a terminal does
    try:
        run.wait(60)
    except subprocess.TimeoutExpired:
        run.kill()
        return True, f"deaf to {number.name}"
    end = time.monotonic() + 5
    while living(run.pid) and time.monotonic() < end:
        time.sleep(0.05)
    left = living(run.pid)
    for process in left:
        os.kill(process, signal.SIGKILL)
    return True, "a worker outlived it" if left else ""


def complete(command: list[str], folder: Path) -> str:
    """What is wrong with a command that runs to its end."""
    status = start(command, folder).wait(LIMIT)
    return f"status {status}; see {folder / 'output.txt'}" if status else ""


def interrupted(
    command: list[str], folder: Path, took: float, draw: random.Random, times: int
) -> tuple[list, str]:
    """(names of the signals that came in time, what is wrong) of a run that is killed
    so many times, then ends."""
    came = []
    for left in range(times, -1, -1):
        begun = (folder / "run" / PROVENANCE).is_file()
        now = (
            [
                command[0],
                "resume=run",
                *(each for each in command if "data.cache=" in each),
            ]
            if begun
            else command
        )
        if not left:
            return came, complete(now, folder)
        number = draw.choice(SIGNALS)
        working, wrong = killed(now, folder, draw.uniform(0.0, took), number)
        if wrong or not working:
            return came, wrong
        came.append(number.name)
    return came, ""


def differences(one: Path, other: Path) -> list[str]:
    """Names of files that are in one folder only, or whose content differs by more than
    wall times."""
    names = {folder: set(compared(folder)) for folder in (one, other)}
    alone = names[one] ^ names[other]
    both = names[one] & names[other]
    return sorted(
        alone | {name for name in both if content(one / name) != content(other / name)}
    )


def compared(folder: Path) -> list[str]:
    """Files of a run that are compared."""
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    return [
        str(path)
        for path in files
        if not WORKING & set(path.parts) and path.suffix not in DERIVED
    ]


def content(path: Path) -> Any:
    """The content of a file, without wall times, in a form that can be compared."""
    data = path.read_bytes()
    if path.name == HASHES:
        return None
    if path.suffix == ".pt":
        hashed = data.startswith(HASHED)
        return plain(
            read_state(path)
            if hashed
            else torch.load(path, map_location="cpu", weights_only=True)
        )
    if path.suffix == ".json":
        return plain(json.loads(data))
    if path.suffix == ".safetensors":  # the header holds wall times
        return plain(load(data))
    if path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(data.decode())))
        return plain(rows) if "logs" not in path.parts else data
    return data


def plain(value: Any) -> Any:
    """Nested containers with arrays as bytes, and without wall times."""
    if isinstance(value, dict):
        return {
            str(key): plain(part)
            for key, part in value.items()
            if not TIMED.search(str(key))
        }
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, torch.Tensor | np.ndarray):
        array = np.asarray(value)
        return str(array.dtype), array.shape, array.tobytes()
    return repr(value)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("count", type=int, metavar="N", help="runs that are killed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    given = parser.parse_args(arguments)
    draw = random.Random(given.seed)
    took = {}
    counts = Counter()
    done = 0
    tried = 0
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        while done < given.count:
            stage = given.stages[done % len(given.stages)]
            command = [
                *STAGES[stage].split(),
                f"data.cache={folder / 'cache'}",
                "hydra.run.dir=run",
            ]
            whole = folder / stage
            own = folder / f"{stage}-{tried}"
            tried = tried + 1
            if stage not in took:
                begin = time.monotonic()
                if wrong := complete(command, whole):
                    raise SystemExit(f"{stage}: {wrong}")
                took[stage] = time.monotonic() - begin
            came, wrong = interrupted(
                command, own, took[stage], draw, 2 if done % 3 == 2 else 1
            )
            if not came and not wrong:  # it ended before the signal
                continue
            wrong = wrong or ", ".join(differences(whole / "run", own / "run"))
            counts.update(
                {
                    (stage, "runs"): 1,
                    (stage, "equal"): int(not wrong),
                    **Counter((stage, name) for name in came),
                }
            )
            done += 1
            print(f"{done}: {stage}: {', '.join(came)}: {wrong or 'equal'}", flush=True)
    columns = ("runs", *(number.name for number in SIGNALS), "equal")
    print(
        "\n| stage | " + " | ".join(columns) + " |\n| --- |" + " ---: |" * len(columns)
    )
    for stage in given.stages:
        print(
            f"| {stage} | "
            + " | ".join(str(counts[stage, name]) for name in columns)
            + " |"
        )
    return int(
        any(counts[stage, "runs"] != counts[stage, "equal"] for stage in given.stages)
    )


if __name__ == "__main__":
    sys.exit(main())
