"""`e2rl merge RUN_DIR ... --into FOLDER`: the shards of a run (`e2rl evaluate
shard=[k,n]`) as one run.

`e2rl evaluate resume=FOLDER shard=null` then drives what is missing and writes the
tables.
"""

import argparse
import json
import shlex
import shutil
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import IO

from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import open_regular, write_atomically, written_whole
from e2rl.run.run import PARTS, PROVENANCE, assigned, changed, read_provenance
from e2rl.run.trust import CONFIG
from e2rl.sim.rollout_file import ROLLOUTS

# A batch is done when its part is there.
COPIED = (f"{PARTS}/*.pt", f"{ROLLOUTS}/*.npz", "*.csv", str(CONFIG))
OWN = ("shard=", "hydra.run.dir=")  # what the commands of shards differ in


def merge(runs: Sequence[Path], into: Path) -> int:
    """Copies the batches of shards that are done into a new run's folder; returns how
    many there are. Raises InputError where a folder is no run, `into` is there, or runs
    differ in scenes, inputs or settings."""
    provenances = [read_provenance(run) for run in runs]
    first = provenances[0]
    for run, other in zip(runs, provenances, strict=True):
        names = changed(first["inputs"], other["inputs"])
        names += changed(first["settings"], other["settings"])
        if names:
            raise InputError(
                f"{run}: began with another {', '.join(names)} than {runs[0]}; merge "
                "the shards of one run"
            )
    if into.exists():
        raise InputError(f"{into}: is there already; name a new folder")
    try:
        command = [
            part for part in shlex.split(first["command"]) if not part.startswith(OWN)
        ]
    except ValueError as error:
        raise InputError(
            f"{runs[0] / PROVENANCE}: its command is none ({error}); restore it"
        ) from error
    with written_whole(into) as folder:
        for run, pattern in product(runs, COPIED):
            for source in sorted(run.glob(pattern)):
                copy = folder / source.relative_to(run)
                copy.parent.mkdir(exist_ok=True)
                with opened(source, run) as content, copy.open("wb") as file:
                    shutil.copyfileobj(content, file)
        versions: list[dict] = []
        for provenance in provenances:
            for version in provenance["versions"]:
                if version not in versions:
                    versions.append(version)
        whole = first | {"command": shlex.join(command), "versions": versions}
        write_atomically(folder / PROVENANCE, json.dumps(whole, indent=1))
        return len(list(folder.glob(COPIED[0])))


def opened(file: Path, run: Path) -> IO[bytes]:
    """A shard's file, to read; InputError for a link to elsewhere, a pipe, a device."""
    try:
        return open_regular(file, within=run)
    except OSError as error:
        raise InputError(
            f"{file}: cannot be read ({error.strerror}); put the shard's own file there"
        ) from error


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl merge", description=__doc__)
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="folder of a shard",
    )
    parser.add_argument(
        "--into",
        type=Path,
        required=True,
        help="folder of the whole run, a new one",
    )
    options = parser.parse_args(arguments)
    with ending():
        batches = merge(options.runs, options.into)
        go_on = shlex.join(
            ["e2rl", "evaluate", assigned("resume", options.into), "shard=null"]
        )
        print(f"{batches} batches in {options.into}; go on with: {go_on}")
