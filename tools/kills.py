"""python tools/kills.py N [--seed S] [--stages NAME ...] [--json FILE]: N runs are killed and resumed, then compared.

Each stage of STAGES runs once without interruption, on a few bundled scenes. Then it is started anew, killed by SIGINT,
SIGTERM or SIGKILL at a random moment, and resumed; every third is killed again in the resumed run. At the end its
folder is compared with that of the uninterrupted run: the same files, and the same content but for wall times. Prints a
line a kill and a table; the exit status is 1 where something differs or a process outlives its parent.
"""

import argparse
import csv
import io
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from safetensors import safe_open

from e2rl.run.files import HASH
from e2rl.run.parts import HASHED, read_state

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
SCENES = [
    *("data.build.steps=20", "data.build.vehicles=8", "data.build.others=2", "data.build.field_cells=128"),
    *("data.workers=1", "prior.sampler.steps=2"),
]
TESTED = ["evaluate.py", "data.split=tune", *SCENES]
TRAINED = ["train.py", *SCENES]
STAGES = {
    "prior": [
        *TRAINED,
        *("stage=prior", "num_scenes=40", "prior.network.width=32", "prior.training.steps=60"),
        *("prior.training.validate_every=10", "prior.training.route_steps=50", "prior.training.closed_loop_scenes=4"),
    ],
    "imitation": [
        *TRAINED,
        *("stage=imitation", "num_scenes=8", "learner.imitation.epochs=20", "learner.imitation.minibatch=64"),
    ],
    "evolution": [
        *TRAINED,
        *("num_scenes=4", "rounds=3", "batch=4", "learner.round.scenes=4", "learner.collect.batch=4"),
        *("learner.collect.iterations=1", "measure.scenes=4", "measure.seeds=[0]", "measure.eta=2"),
    ],
    "evaluation": [*TESTED, "num_scenes=4", "seeds=[0,1]", "batch=2", "processes=2"],
    "table1": [
        *TESTED,
        *("experiment=table1", "methods=[e2,nominal,ctg_adv,cat]", "num_scenes=2", "seeds=[0,1]"),
        *("batch=1", "processes=2"),
    ],
    "prior_table": [
        *TESTED,
        *("experiment=prior", "num_scenes=3", "seeds=[0]", "open_loop_samples=2", "meta_rollouts=4"),
        *("batch=3", "processes=1"),
    ],
    "tune_planner": [
        *TESTED,
        *("experiment=tune_planner", "ego=sampling", "num_scenes=2", "tuning.trials=6", "tuning.startup=2"),
        "processes=2",
    ],
}
WORKING = {".hydra", "parts"}  # what a run keeps for itself
TIMED = re.compile(r"seconds|^time$")  # names of wall times
ENDED = "none, it had ended"
LIMIT = 600.0  # s of one command


@dataclass
class Kill:
    """One interrupted run: how often and when it was killed, by what, what was finished then, and what came of it."""

    stage: str
    signals: list[str] = field(default_factory=list)
    moments: list[float] = field(default_factory=list)
    finished: list[str] = field(default_factory=list)
    outcome: str = ""


# --- running and killing


def start(arguments: list[str], folder: Path) -> subprocess.Popen:
    """The command in a session of its own; `folder` is its working directory, and its output goes to output.txt."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(ROOT / arguments[0]), *arguments[1:]]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (folder / "output.txt").open("a") as output:
        streams = {"stdout": output, "stderr": output, "env": environment}
        heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell starts background jobs deaf to it
        return subprocess.Popen(command, cwd=folder, start_new_session=True, preexec_fn=heed, **streams)


def session(leader: int) -> Iterator[int]:
    """Living processes of a session."""
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, number = entry.read_text().rpartition(") ")[2].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(number) == leader and state not in "ZX":
            yield int(entry.parent.name)


def outlived(leader: int) -> bool:
    """Whether a process of a session is still there five seconds after its leader's end."""
    end = time.monotonic() + 5
    while list(session(leader)) and time.monotonic() < end:
        time.sleep(0.05)
    left = list(session(leader))
    for process in left:
        os.kill(process, signal.SIGKILL)
    return bool(left)


def kill_once(arguments: list[str], folder: Path, after: float, number: signal.Signals) -> tuple[bool, str]:
    """(whether the command was still at work, what is wrong) of a command that gets a signal after some seconds."""
    run = start(arguments, folder)
    try:
        status = run.wait(after)
        return False, "" if status == 0 else f"status {status}"
    except subprocess.TimeoutExpired:
        if number is signal.SIGINT:
            os.killpg(run.pid, number)  # a terminal sends it to all
        else:
            run.send_signal(number)
    try:
        run.wait(60)
    except subprocess.TimeoutExpired:
        run.kill()
        return True, f"deaf to {number.name}"
    return True, "a worker outlived it" if outlived(run.pid) else ""


def complete(arguments: list[str], folder: Path) -> str:
    """What is wrong with a command that runs to its end."""
    run = start(arguments, folder)
    try:
        status = run.wait(LIMIT)
    except subprocess.TimeoutExpired:
        run.kill()
        return "no end"
    return "" if status == 0 else f"status {status}"


def next_command(arguments: list[str], folder: Path) -> list[str]:
    """The command that goes on with what is in a working directory: from the beginning where nothing was begun."""
    begun = folder / "run" / ".hydra" / "hydra.yaml"
    return [arguments[0], "resume=run"] if begun.is_file() and begun.stat().st_size else arguments


def finished(run: Path) -> str:
    """What a run has finished, in words."""
    if (run / "training.pt").exists():
        return f"step {len((run / 'progress.jsonl').read_text().splitlines())} of validation"
    if rounds := sorted(path.name for path in run.glob("checkpoints/round-*")):
        return rounds[-1]
    parts = list((run / "parts").rglob("*.pt"))
    return f"{len(parts)} parts" if parts else "nothing"


def interrupted(stage: str, arguments: list[str], folder: Path, took: float, draw: random.Random, again: bool) -> Kill:
    """A run that is killed, once or again in its resumption, and then ends; without the comparison."""
    kill = Kill(stage)
    for _ in range(2 if again else 1):
        number, after = draw.choice(SIGNALS), draw.uniform(0.0, took)
        working, wrong = kill_once(next_command(arguments, folder), folder, after, number)
        if wrong:
            kill.outcome = wrong
            return kill
        kill.signals.append(number.name if working else ENDED)
        kill.moments.append(round(after, 1))
        kill.finished.append(finished(folder / "run"))
    kill.outcome = complete(next_command(arguments, folder), folder)
    return kill


# --- comparing


def differences(one: Path, other: Path) -> list[str]:
    """Names of files that are in one folder only, or whose content differs by more than wall times."""
    names = {folder: set(_files(folder)) for folder in (one, other)}
    alone = sorted(names[one] ^ names[other])
    return alone + [name for name in sorted(names[one] & names[other]) if content(one / name) != content(other / name)]


def _files(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        if path.is_file() and not WORKING.intersection(parts) and "time" not in parts and path.suffix != ".log":
            yield str(path.relative_to(folder))


def content(path: Path) -> Any:
    """The content of a file, without wall times, in a form that can be compared."""
    if path.name == "sha256.json":  # hashes of files that are compared themselves
        return None
    if path.suffix == ".pdf":  # the picture of the PNG beside it, with fonts in an order that changes
        return None
    if path.suffix == ".pt":
        hashed = path.read_bytes().startswith(HASHED)
        return plain(read_state(path) if hashed else torch.load(path, map_location="cpu", weights_only=True))
    if path.suffix == ".json":
        return plain(json.loads(path.read_text()))
    if path.suffix == ".safetensors":
        with safe_open(path, "np") as file:
            header = {name: plain(_parsed(text)) for name, text in (file.metadata() or {}).items()}
            header.pop(HASH, None)  # of wall times, too
            return header, {name: plain(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118 - not a dict
    if path.suffix == ".csv" and path.parent.name not in ("train", "eval", "curriculum", "synthesizer"):
        return [plain(row) for row in csv.DictReader(io.StringIO(path.read_text()))]
    if path.suffix in (".md", ".tex"):
        return list(untimed(path.read_text()))
    return path.read_bytes()


def untimed(text: str) -> Iterator[list[str]]:
    """The cells of the lines of Markdown or LaTeX tables, without lines and columns of wall times."""
    timed: set[int] = set()
    for line in text.splitlines():
        cells = re.split(r"(?<!\\)[|&]", line)
        here = {number for number, cell in enumerate(cells) if TIMED.search(cell)}
        if not line.strip():
            timed = set()  # the table's end
        elif here and min(here) < 2:  # the row of a time
            cells = []
        elif here:  # a head
            timed = here
        yield [cell for number, cell in enumerate(cells) if number not in timed]


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def plain(value: Any) -> Any:
    """Nested containers with arrays as bytes, numbers exactly as written, and without wall times."""
    if isinstance(value, dict):
        return {str(key): plain(part) for key, part in value.items() if not TIMED.search(str(key))}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, torch.Tensor | np.ndarray):
        array = np.asarray(value)
        return str(array.dtype), array.shape, array.tobytes()
    return repr(value)


# --- the table


def table(kills: list[Kill]) -> str:
    """Outcomes by stage, in Markdown: kills by signal, those that were killed twice, and how many are equal."""
    names = [number.name for number in SIGNALS]
    lines = ["| stage | runs | killed twice | " + " | ".join(names) + " | equal |", "| --- |" + " ---: |" * 6]
    for stage in dict.fromkeys(kill.stage for kill in kills):
        ours = [kill for kill in kills if kill.stage == stage]
        by_signal = Counter(name for kill in ours for name in kill.signals)
        equal = sum(kill.outcome == "equal" for kill in ours)
        counts = [len(ours), sum(len(kill.signals) > 1 for kill in ours), *(by_signal[name] for name in names), equal]
        lines.append(f"| {stage} | " + " | ".join(map(str, counts)) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python tools/kills.py", description=__doc__)
    parser.add_argument("count", type=int, help="runs that are killed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    parser.add_argument("--json", type=Path, help="file for the outcomes")
    parser.add_argument("--keep", type=Path, help="folder for the runs; default: a temporary one")
    given = parser.parse_args(arguments)
    with TemporaryDirectory() as temporary:
        kills = all_kills(given, Path(given.keep or temporary).resolve())
    print("\n" + table(kills))
    if given.json:
        given.json.write_text(json.dumps([asdict(kill) for kill in kills], indent=1))
    return int(any(kill.outcome != "equal" for kill in kills))


def all_kills(given: argparse.Namespace, folder: Path) -> list[Kill]:
    """Kill runs of the stages in turn."""
    draw, kills, took = random.Random(given.seed), [], {}
    for index in itertools.count():
        if len(kills) == given.count:
            break
        stage = given.stages[len(kills) % len(given.stages)]
        command = [*STAGES[stage], f"data.cache={folder / 'cache'}", "hydra.run.dir=run"]
        whole, own = folder / f"{stage}-whole", folder / f"{stage}-{index}"
        if stage not in took:
            took[stage] = uninterrupted(stage, command, whole)
        kill = interrupted(stage, command, own, took[stage], draw, len(kills) % 3 == 2)
        if set(kill.signals) == {ENDED}:  # before the signals came: no kill
            continue
        if not kill.outcome:
            wrong = differences(whole / "run", own / "run")
            kill.outcome = f"differs: {', '.join(wrong)}" if wrong else "equal"
        if kill.outcome == "equal" and not given.keep:
            shutil.rmtree(own)
        kills.append(kill)
        what = ", ".join(
            f"{name} at {moment} s of {took[stage]:.0f} with {state}"
            for name, moment, state in zip(kill.signals, kill.moments, kill.finished, strict=True)
        )
        print(f"{len(kills)}: {stage}: {what}: {kill.outcome}", flush=True)
    return kills


def uninterrupted(stage: str, command: list[str], folder: Path) -> float:
    """Seconds that a stage takes."""
    begin = time.monotonic()
    if wrong := complete(command, folder):
        raise SystemExit(f"{stage}: {wrong}; see {folder / 'output.txt'}")
    return time.monotonic() - begin


if __name__ == "__main__":
    sys.exit(main())
