"""An evaluation as jobs of a Slurm cluster, by submitit (extra `slurm`): shards of its
batches, joined at the end.

    python examples/slurm.py --jobs 4 --into runs/all --set slurm_partition=cpu
    timeout_min=60 -- num_scenes=40 eta=3

What follows `--` are options of evaluate.py. A shard goes on where it stopped: after a
preemption or the time limit by itself, else by calling this again with the same
arguments. `--cluster local` runs the jobs on this machine.
"""

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import submitit
from submitit.helpers import Checkpointable, CommandFunction

EVALUATE = [sys.executable, str(Path(__file__).resolve().parents[1] / "evaluate.py")]
MERGE = [sys.executable, "-m", "e2rl.commands.cli", "merge"]


@dataclass
class Shard(Checkpointable):
    """A job: begins the run of a shard in its folder, or goes on with it."""

    number: int
    count: int
    folder: Path
    options: list[str]

    def __call__(self) -> str:
        if (self.folder / "provenance.json").exists():
            return CommandFunction(
                [*EVALUATE, f"resume={self.folder}", *cache_of(self.options)]
            )()
        own = [f"shard=[{self.number},{self.count}]", f"hydra.run.dir={self.folder}"]
        return CommandFunction([*EVALUATE, *self.options, *own])()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, required=True, help="shards")
    parser.add_argument(
        "--into",
        type=Path,
        required=True,
        help="folder that all machines see; runs go below it",
    )
    parser.add_argument(
        "--cluster", default="slurm", help="slurm, or local (default %(default)s)"
    )
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="of submitit's update_parameters",
    )
    parser.add_argument("options", nargs="*", help="of evaluate.py")
    given = parser.parse_args(arguments)
    into = given.into.resolve()
    executor = submitit.AutoExecutor(into / "log", cluster=given.cluster)
    executor.update_parameters(
        **{
            key: value_of(text)
            for key, text in (pair.split("=", 1) for pair in given.set)
        }
    )
    shards = [
        Shard(number, given.jobs, into / f"shard-{number}", given.options)
        for number in range(given.jobs)
    ]
    with executor.batch():
        jobs = [executor.submit(shard) for shard in shards]
    for job in jobs:
        job.result()  # raises with what its command said, where that failed
    whole = into / "whole"
    if not whole.exists():
        subprocess.run(
            [*MERGE, *(str(shard.folder) for shard in shards), "--into", str(whole)],
            check=True,
        )
    subprocess.run(
        [*EVALUATE, f"resume={whole}", "shard=null", *cache_of(given.options)],
        check=True,
    )


def cache_of(options: list[str]) -> list[str]:
    """Those that a run that goes on is told again: where it writes outside of its
    folder."""
    return [option for option in options if option.startswith("data.cache")]


def value_of(text: str) -> int | str:
    """A number where it is one."""
    return int(text) if text.isdecimal() else text


if __name__ == "__main__":
    main()
