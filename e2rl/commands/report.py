"""`e2rl report RUN_DIR`: the failure report of a run, one HTML file that opens offline,
and a list of its failures.
"""

import argparse
from pathlib import Path

from e2rl.evaluation.rollout_files import TABLE
from e2rl.report.html import PAGE, REPLAYS, write_report
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.search.tries import SEARCH

MEASURED = ("before", f"before/{SEARCH}", "after", f"after/{SEARCH}")  # of a training


def measured_folders(run: Path) -> list[Path]:
    """The folders with rollouts: the run's own, or those of a training; InputError
    where there are none."""
    if (run / TABLE).is_file():
        return [run]
    folders = [run / part for part in MEASURED if (run / part / TABLE).is_file()]
    if not folders:
        raise InputError(
            f"{run}: no {TABLE}, neither of an evaluation nor measured by a training; "
            "give a run of evaluate.py, which drives what another training made by its "
            "checkpoint"
        )
    return folders


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="e2rl report", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN_DIR",
        help="folder of a run of evaluate.py or train.py",
    )
    parser.add_argument(
        "--replays",
        type=int,
        default=REPLAYS,
        metavar="N",
        help="at most so many (%(default)s)",
    )
    parser.add_argument(
        "--method",
        action="append",
        default=[],
        metavar="NAME",
        help="its failures only; repeatable",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help=f"file to write (default: RUN_DIR/{PAGE})",
    )
    options = parser.parse_args(arguments)
    with ending():
        folders = measured_folders(options.run)
        if (options.out or options.method) and len(folders) > 1:
            raise InputError(
                f"{options.run}: a training has {len(folders)} pages; name one, such "
                f"as {folders[-1]}"
            )
        for folder in folders:
            page = write_report(
                folder,
                replays=options.replays,
                methods=options.method,
                path=options.out,
            )
            print(page)
