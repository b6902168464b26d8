"""`e2rl export RUN_DIR --to FORMAT`: failures of a run in the format of another tool
(docs/guide/export.md)."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

from tqdm import tqdm

from e2rl.evaluation.reproduce import failure_row
from e2rl.evaluation.rollout_files import TABLE, own_folder, read_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.export.episode import FACTS, Episode
from e2rl.report.export.scene_files import episodes_of
from e2rl.run.config import library
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically, written_whole

FORMATS = {  # modules of e2rl.report.export; what a module imports is in the extra of the format's name
    "commonroad": "commonroad_writer",
    "openscenario": "openscenario",
    "scenarionet": "scenarionet_writer",
    "mcap": "mcap",
    "npz": "archive",
}
OPEN_EGO = (
    "commonroad",
    "openscenario",
)  # formats in which the ego's place may be left open
LIST = "exported.csv"


def chosen_rows(
    run: Path, failures: int | None, every: bool, method: str | None
) -> list[dict]:
    """Rows of rollouts.csv: its failures, first those that count, at most `failures`;
    or every rollout of it."""
    rows = [
        row for row in read_rows(run / TABLE) if row["errored"] != 1
    ]  # which have no file
    if method is not None:
        known = dict.fromkeys(row["method"] for row in rows)
        if method not in known:
            raise InputError(
                f"--method {method}: not in {run / TABLE}; choose among {', '.join(known)}"
            )
        rows = [row for row in rows if row["method"] == method]
    if every:
        return rows
    found = sorted(
        (row for row in rows if is_failure(row)), key=lambda row: row["counted"] != 1
    )
    if not found:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta, evaluate more scenes, or pass --all"
        )
    return found[:failures]


def export(
    episodes: Iterator[Episode],
    write: Callable[..., Iterator],
    out: Path,
    open_ego: bool,
) -> None:
    """Write episodes by the `write` of a format into a new folder, with a list of the
    files and their facts."""
    if out.exists():
        raise InputError(
            f"{out}: is there already; remove it, or pass another folder with --out"
        )
    columns = ("file", *FACTS, "adversaries")
    with written_whole(out) as folder:
        lines = []
        for episode, path in write(episodes, folder, open_ego):
            facts = episode.facts | {
                "adversaries": " ".join(map(str, episode.facts["adversaries"]))
            }
            facts["file"] = str(path.relative_to(folder))
            lines.append([facts.get(column, "") for column in columns])
        write_atomically(folder / LIST, csv_text([columns, *lines]))


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl export", description=__doc__)
    parser.add_argument(
        "run", type=Path, metavar="RUN_DIR", help="folder of a run of evaluate.py"
    )
    parser.add_argument(
        "--to",
        required=True,
        choices=FORMATS,
        metavar="FORMAT",
        help=", ".join(FORMATS),
    )
    parser.add_argument(
        "--failures",
        type=int,
        metavar="N",
        help="at most so many failures (default: all)",
    )
    parser.add_argument(
        "--failure", metavar="NAME", help="only this failure, as failures.csv names it"
    )
    parser.add_argument(
        "--all", action="store_true", help="every rollout, not only failures"
    )
    parser.add_argument("--method", metavar="NAME", help="rollouts in its traffic only")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="a new folder (default: below RUN_DIR/export)",
    )
    parser.add_argument(
        "--open-ego",
        action="store_true",
        help="leave the ego to a planner or controller of your own",
    )
    parser.add_argument(
        "--no-scene",
        action="store_true",
        help="do without the data: lanes of the rollout files alone",
    )
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="MODULE",
        help="the data source's; repeatable",
    )
    options = parser.parse_args(arguments)
    with ending():
        out = options.out or own_folder(
            options.run, "export", *filter(None, [options.failure]), options.to
        )
        if options.open_ego and options.to not in OPEN_EGO:
            others = " or ".join(OPEN_EGO)
            raise InputError(
                f"--open-ego: {options.to} has no such form; leave it out, or pass --to {others}"
            )
        write = library(
            f"e2rl.report.export.{FORMATS[options.to]}",
            f"--to {options.to}",
            extra=options.to,
        ).write
        if options.failures is not None and options.failures < 1:
            raise InputError(f"--failures {options.failures}: expected at least 1")
        given = (options.run, options.failures, options.all, options.method)
        rows = (
            [failure_row(options.run, options.failure)]
            if options.failure
            else chosen_rows(*given)
        )
        episodes = episodes_of(
            options.run, rows, plugins=options.plugin, scene=not options.no_scene
        )
        shown = tqdm(
            episodes, "exporting", len(rows), unit="rollout", leave=False, disable=None
        )
        export(shown, write, out=out, open_ego=options.open_ego)
        print(f"{len(rows)} rollouts written to {out}")
