"""`e2rl report RUN`: the failure report of a run, one HTML file that opens offline, and a
list of its failures; of several runs, oldest first, the history of their scenes.
"""

import argparse
from pathlib import Path

from e2rl.evaluation.history import read_versions
from e2rl.evaluation.record import Record, part_files
from e2rl.evaluation.rollout_files import TABLE, own_folder
from e2rl.report.attachments import Attached
from e2rl.report.export.formats import FORMATS
from e2rl.report.history import HISTORY, write_history
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
    if not folders and part_files(run):
        return [run]
    if not folders:
        raise InputError(
            f"{run}: no {TABLE}, neither of an evaluation nor measured by a training; "
            "give a run of evaluate.py, which drives what another training made by its "
            "checkpoint"
        )
    return folders


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl report", description=__doc__)
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN",
        help="folder of a run of evaluate.py or train.py; of evaluate.py, two or more "
        "versions of a planner, oldest first",
    )
    parser.add_argument(
        "--replays",
        type=int,
        metavar="N",
        help=f"at most so many ({REPLAYS}); of one run",
    )
    parser.add_argument(
        "--method",
        action="append",
        default=[],
        metavar="NAME",
        help="its failures only; repeatable",
    )
    parser.add_argument(
        "--ego",
        metavar="NAME",
        help="of a history, where its runs have several",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help=f"file to write (default: RUN/{PAGE}; of a history {HISTORY} in the last)",
    )
    parser.add_argument(
        "--attach",
        action="append",
        default=[],
        choices=tuple(FORMATS),
        metavar="FORMAT",
        help="to download from the page, with each replay; repeatable: "
        f"{', '.join(FORMATS)}",
    )
    parser.add_argument(
        "--no-scene",
        action="store_true",
        help="attach without the data: lanes of the rollout files alone",
    )
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="MODULE",
        help="the data source's, to attach; repeatable",
    )
    options = parser.parse_args(arguments)
    with ending():
        if len(options.runs) > 1:
            report_history(options)
        else:
            report_run(options)


def report_run(options: argparse.Namespace) -> None:
    """Write the failure reports of a run."""
    run = options.runs[0]
    folders = measured_folders(run)
    if options.ego:
        raise InputError("--ego: for two or more runs; leave it out")
    if (options.out or options.method) and len(folders) > 1:
        raise InputError(
            f"{run}: a training has {len(folders)} pages; name one, such "
            f"as {folders[-1]}"
        )
    attached = attached_by(options)
    for folder in folders:
        record = None
        progress = None
        if not (folder / TABLE).is_file():
            record = Record.of_parts(folder)
            count = len(record.rollouts)
            text = f"So far: {count} rollouts of a run that is not finished."
            progress = {"text": text, "every": 0}
        page = write_report(
            folder,
            record,
            tables=[] if progress else None,
            replays=REPLAYS if options.replays is None else options.replays,
            methods=options.method,
            path=options.out,
            progress=progress,
            attached=attached,
        )
        print(page)


def attached_by(options: argparse.Namespace) -> Attached | None:
    """What the options ask to attach to one run's replays; InputError where they do not
    go together."""
    if options.attach:
        if len(options.runs) > 1:
            raise InputError("--attach: for one run; leave it out")
        if options.replays == 0:
            raise InputError(
                "--attach: goes with replays, and --replays 0 has none; leave one out"
            )
        formats = list(dict.fromkeys(options.attach))
        return Attached(formats, scene=not options.no_scene, plugins=options.plugin)
    if options.no_scene or options.plugin:
        raise InputError("--no-scene, --plugin: for --attach FORMAT; pass it, too")
    return None


def report_history(options: argparse.Namespace) -> None:
    """Write the history of several runs."""
    attached_by(options)
    path = options.out or own_folder(options.runs[-1], HISTORY)
    if options.replays is not None:
        raise InputError("--replays: for one run; leave it out")
    if path.suffix != ".html":
        raise InputError(
            f"--out {path}: name a file that ends in .html; .csv comes beside it"
        )
    versions = read_versions(options.runs, options.ego)
    print(*write_history(versions, path, options.method), sep="\n")
