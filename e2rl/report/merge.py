"""`python -m e2rl.report.merge RUN_DIR ... --into FOLDER`: the shares of a run (evaluate.py share=[k,n]) as one run.

`python evaluate.py resume=FOLDER share=null` then drives what is missing and writes the tables.
"""

import argparse
import json
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from e2rl.evaluation.provenance import PROVENANCE, changed, read_provenance
from e2rl.evaluation.rollout_files import ROLLOUTS
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically, written_whole
from e2rl.run.parts import PARTS

KEPT = (f"{PARTS}/*.pt", f"{ROLLOUTS}/*.npz")  # a batch is finished when its part is there
OWN = ("share=", "hydra.run.dir=")  # what the commands of shares differ in


def merge(runs: Sequence[Path], into: Path) -> int:
    """Copy the finished batches of shares into a new run's folder; returns how many.

    Raises InputError where a folder is no run, `into` is there, or runs differ in scenes, inputs or settings.
    """
    first, *others = runs
    known = {run: _provenance(run) for run in runs}
    for run in others:
        kinds = ("inputs", "settings")
        if names := [name for kind in kinds for name in changed(known[first][kind], known[run][kind])]:
            raise InputError(f"{run}: began with another {', '.join(names)} than {first}; merge the shares of one run")
    if into.exists():
        raise InputError(f"{into}: is there already; name a new folder")
    with written_whole(into) as folder:
        for source in (source for run in runs for pattern in KEPT for source in sorted(run.glob(pattern))):
            copy = folder / source.parent.name / source.name
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(source, copy)
        shutil.copytree(first / ".hydra", folder / ".hydra")
        command = [part for part in shlex.split(known[first]["command"]) if not part.startswith(OWN)]
        versions = [each for run in runs for each in known[run]["versions"]]
        versions = [each for number, each in enumerate(versions) if each not in versions[:number]]
        whole = known[first] | {"command": shlex.join(command), "versions": versions}
        write_atomically(folder / PROVENANCE, json.dumps(whole, indent=1))
        return len(list(folder.glob(KEPT[0])))


def _provenance(run: Path) -> dict[str, Any]:
    known = read_provenance(run)
    if known is None or not (run / ".hydra" / "config.yaml").is_file():
        raise InputError(f"{run}: no run of evaluate.py; give the folders that its shares printed")
    return known


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m e2rl.report.merge", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN_DIR", help="folder of a share")
    parser.add_argument("--into", type=Path, required=True, help="folder of the whole run, a new one")
    options = parser.parse_args(arguments)
    try:
        batches = merge(options.runs, options.into)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{batches} batches in {options.into}; go on with: python evaluate.py resume={options.into} share=null")
    return 0


if __name__ == "__main__":
    sys.exit(main())
