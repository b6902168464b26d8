"""Whole commands on a run's folder that a stranger may have made, and on a stranger's
study and logs."""

import contextlib
import csv
import io
import json
import logging
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from omegaconf import OmegaConf

from e2rl.run.errors import InputError
from tests.scenes.descriptions import description, numbered, write_folder
from tools.fuzz_inputs import (
    ARRAYS,
    HOSTILE,
    PLAIN,
    damaged,
    hostile,
    mutated,
    require,
    stored,
    with_program,
)

ROOT = Path(__file__).resolve().parents[1]
SMALL = [
    "num_scenes=2",
    "data.workers=1",
    "data.build.steps=20",
    "data.build.vehicles=4",
    "data.build.field_cells=64",
]
SMALL += ["data.split=tune", "seeds=[0]", "processes=1", "ego=idm"]
RUN = [*SMALL, "methods=[replay,constant_velocity]"]
TUNE = [
    *SMALL,
    "methods=[replay]",
    "tuning.group=ego",
    "tuning.trials=2",
    "+tuning.space.headway=[0.8,3.0]",
]
TUNE += ["tuning.study=study.json", "hydra.run.dir=out"]
COMMANDS = {  # module, and arguments in the folder of the case; {cache}: of scenes, {rollout}: a file of the run
    "resume": ("evaluate", "resume=run", "data.cache={cache}"),
    "reproduce": (
        "evaluate",
        "reproduce=run",
        "data.cache={cache}",
        "hydra.run.dir=out",
    ),
    "merge": ("e2rl.commands.merge", "run", "whole", "--into", "out"),
    "report": ("e2rl.commands.report", "run"),
    "replay": ("e2rl.commands.replay", "run", "--pixels", "60"),
    "replay of a file": (
        "e2rl.commands.replay",
        "{rollout}",
        "--pixels",
        "60",
        "--out",
        "out",
    ),
    "tune": ("e2rl.commands.tune", *TUNE, "data.cache={cache}"),
    "inspect": (
        "e2rl.commands.inspect",
        "logs",
        "--workers",
        "1",
        "--out",
        "out/scene.png",
    ),
}
HYDRA = (
    "evaluate",
    "e2rl.commands.tune",
)  # modules whose arguments are those of the process
NAMES = st.sampled_from(
    [
        "a\ud800",
        "a\x1b[2J",
        "a\nb",
        "../../outside/x",
        "/outside",
        "x" * 300,
        "=1+1",
        "<b>",
        "",
        "CON",
    ]
)
NUMBERS = st.sampled_from(["nan", "-inf", "1e999", "9" * 5000, "-1", "0x10"])
DEEP = st.sampled_from(
    ["[" * 100_000, '{"a":' * 50_000, "9" * 100_000, "[1e999]", '"\\ud800"', "null"]
).map(str.encode)
LAUGH = "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9 if k else ['x'] * 9)}]\n"
    for k in range(10)
)
CHAIN = "".join(f"a{k}: ${{a{k + 1}}}${{a{k + 1}}}\n" for k in range(40)) + "a40: x\n"
BOMBS = st.sampled_from(
    [
        LAUGH,
        CHAIN,
        "a: &a [*a]\n",
        "a: " + "[" * 5000 + "]" * 5000,
        "a: ${b}\nb: ${a}\n",
        "- 1\n",
    ]
)
SECRET = "outside/secret.txt"

Edit = tuple[
    str, str, Any
]  # a file of the case; what becomes of it; its content, or where a link leads


def commands(
    folder: Path, mark: str, run: Callable[[list[str]], None]
) -> tuple[st.SearchStrategy[bytes], Callable]:
    """A strategy of cases, and what runs one in folder/case; the run that they are made
    of lies in folder/run."""
    pristine = prepared(folder)
    case = folder / "case"

    def read(content: bytes) -> None:
        name, edits = pickle.loads(content)
        os.chdir(folder)
        shutil.rmtree(case, ignore_errors=True)
        shutil.copytree(pristine, case)
        for edit in edits:
            apply(case, *edit)
        os.chdir(case)
        before = contents(folder / "outside")
        files = {
            "cache": folder / "cache",
            "rollout": next((pristine / "run" / "rollouts").glob("*.npz")),
        }
        files["rollout"] = Path("run", "rollouts", files["rollout"].name)
        try:
            run([argument.format(**files) for argument in COMMANDS[name]])
        finally:
            require(
                contents(folder / "outside") == before,
                "a file outside of the run was written",
            )

    edits = {"tune": ["study.json"], "inspect": files_of(pristine, "logs")}
    strategies = {name: edits.get(name, files_of(pristine, "run")) for name in COMMANDS}
    one = {
        name: [edited_file(pristine, file, mark) for file in files]
        for name, files in strategies.items()
    }
    for name in (
        COMMANDS if run is called else ()
    ):  # what is undamaged is read; and all is imported
        read(pickle.dumps((name, [])))
    cases = st.sampled_from(list(COMMANDS)).flatmap(
        lambda name: st.tuples(
            st.just(name), st.lists(st.one_of(*one[name]), min_size=1, max_size=2)
        )
    )
    return cases.map(pickle.dumps), read


def prepared(folder: Path) -> Path:
    """Make the files of a whole case, in which each command does what it is for."""
    pristine = folder / "pristine"
    (folder / SECRET).parent.mkdir(exist_ok=True)
    (folder / SECRET).write_text("a user's\n")
    if pristine.exists():
        return pristine
    shutil.copytree(folder / "run", pristine / "whole")
    table = pristine / "whole" / "rollouts.csv"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(
            row | {"cfr": "1.0", "cfr_counted": "1.0"} for row in rows
        )  # failures, to be shown
    shutil.copytree(pristine / "whole", pristine / "run")
    write_folder(pristine / "logs", numbered([description(), description()]))
    os.chdir(pristine)
    called(["e2rl.commands.tune", *TUNE, f"data.cache={folder / 'cache'}"])
    shutil.rmtree(pristine / "out")
    return pristine


def called(command: list[str]) -> None:
    """Call a command's `main` here; InputError where it ends with one line."""
    module, *arguments = command
    main = vars(__import__(module, fromlist=["main"]))["main"]
    said = io.StringIO()
    sys.argv = [f"{module}.py", *arguments]
    logging.getLogger().handlers.clear()  # Hydra's, of a folder that is gone
    try:
        with (
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            main() if module in HYDRA else main(arguments)
    except SystemExit as error:
        ended(error.code, said.getvalue())


def started(command: list[str]) -> None:
    """The same in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    run = [
        sys.executable,
        "-m",
        "e2rl.commands.cli",
        command[0].rpartition(".")[2],
        *command[1:],
    ]
    done = subprocess.run(
        run,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )
    ended(done.returncode, done.stderr)


def ended(status: Any, said: str) -> None:
    """InputError for a command that ended with one line."""
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    require(
        status in (None, 0, 1, 2) and "Traceback" not in said,
        f"status {status}: {said[-300:]}",
    )
    require(
        not status or len(errors) == 1,
        f"status {status} without one line: {said[-300:]}",
    )
    if status:
        raise InputError(errors[0])


def files_of(case: Path, name: str) -> list[str]:
    """The files and folders below case/name, without those that no command reads."""
    return sorted(
        str(path.relative_to(case))
        for path in (case / name).rglob("*")
        if path.suffix != ".md"
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def apply(case: Path, name: str, kind: str, content: Any) -> None:
    """Make one edit of a case."""
    path = case / name
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # the folder is a file by an earlier edit
        if kind == "write":
            path.write_bytes(content)
        elif kind == "link":
            path.symlink_to(content)
        elif kind == "fifo":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()


def edited_file(case: Path, name: str, mark: str) -> st.SearchStrategy[Edit]:
    """What may become of one file: no file, another kind of file, other content."""
    targets = [
        f"../../{SECRET}",
        "../../../outside/secret.txt",
        "../../outside",
        "/dev/zero",
        "/dev/full",
        name,
        "..",
    ]
    links = st.sampled_from(targets).map(lambda target: (name, "link", target))
    others = links | st.sampled_from(
        [(name, kind, None) for kind in ("fifo", "folder", "gone")]
    )
    if (case / name).is_dir():
        return others
    written = content_of(case / name, mark).map(
        lambda content: (name, "write", content)
    )
    return st.one_of(others, written, written, written)


def content_of(path: Path, mark: str) -> st.SearchStrategy[bytes]:
    """Other contents of a file of its kind."""
    whole = path.read_bytes()
    found = damaged(whole) | st.just(b"")
    if path.suffix == ".json":
        odd = PLAIN | NAMES | NUMBERS | st.just(10**400)
        return (
            found
            | mutated(json.loads(whole), odd).map(json.dumps).map(str.encode)
            | DEEP
        )
    if path.suffix == ".yaml":
        starts = {
            "_target_": "e2rl.planners.external.ExternalEgo",
            "_args_": [["touch", mark]],
        }
        call = {"_target_": "hydra.utils.call", "_args_": [f"touch {mark}"]}
        paths = st.sampled_from(["../../outside/new", mark, f"../../{SECRET}"])
        odd = (
            PLAIN
            | HOSTILE
            | NAMES
            | paths
            | st.sampled_from([starts, call, {"command": f"touch {mark}"}])
        )
        plain = OmegaConf.to_container(OmegaConf.create(whole.decode()))
        return (
            found
            | mutated(plain, odd).map(json.dumps).map(str.encode)
            | BOMBS.map(lambda t: whole + t.encode())
        )
    if path.suffix == ".csv":
        return found | tables(whole.decode())
    if path.suffix == ".pt":
        deflated = with_program(whole, b"\0" * (1 << 28), zipfile.ZIP_DEFLATED)
        return (
            found | hostile(mark).map(partial(with_program, whole)) | st.just(deflated)
        )
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            data = dict(arrays)
        bomb = st.builds(
            lambda: stored(data | {"states": np.zeros(1 << 26)}, np.savez_compressed)
        )
        return (
            found
            | mutated(data, ARRAYS | st.floats() | st.text(max_size=9)).map(stored)
            | bomb
        )
    if path.suffix == ".pkl":
        return (
            found
            | hostile(mark)
            | mutated(pickle.loads(whole), PLAIN | ARRAYS | NAMES).map(pickle.dumps)
        )
    return found


def tables(text: str) -> st.SearchStrategy[bytes]:
    """A table with cells replaced, rows repeated, columns taken away."""
    rows = [line.split(",") for line in text.splitlines()]
    cell = st.tuples(
        st.integers(0, len(rows) - 1), st.integers(0, len(rows[0]) - 1), NAMES | NUMBERS
    )

    def changed(cells: list, repeated: list[int], left: int) -> bytes:
        table = [list(row) for row in rows]
        for row, column, value in cells:
            table[row][column % len(table[row])] = value
        lines = [
            ",".join(row[:left]) for row in table + [table[index] for index in repeated]
        ]
        return "\n".join(lines).encode("utf-8", "surrogatepass")

    repeated = st.lists(st.integers(0, len(rows) - 1), max_size=2)
    left = st.sampled_from([len(rows[0])] * 4 + [0, 1, 9])
    return st.builds(changed, st.lists(cell, max_size=2), repeated, left)
