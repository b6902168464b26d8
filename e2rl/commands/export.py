"""`e2rl export RUN_DIR --to FORMAT`: failures of a run in the format of another tool
(docs/guide/export.md)."""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tqdm import tqdm

from e2rl.evaluation.attack_set import ENDING, AttackSet, kept
from e2rl.evaluation.reproduce import failure_row
from e2rl.evaluation.rollout_files import TABLE, own_folder, read_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.export.episode import FACTS, Episode
from e2rl.report.export.formats import FORMATS, OPEN_EGO, writer_of
from e2rl.report.export.scene_files import episodes_of
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically, written_whole
from e2rl.sim.rollout_file import file_stem

ATTACKS = "attacks"  # the format of e2rl cross
LIST = "exported.csv"


def chosen_rows(options: argparse.Namespace) -> list[dict]:
    """Rows of rollouts.csv: one failure; its failures, first those that count, at most
    so many; or every rollout of it."""
    run = options.run
    if options.failures is not None and options.failures < 1:
        raise InputError(f"--failures {options.failures}: expected at least 1")
    if options.failure:
        return [failure_row(run, options.failure)]
    # Rollouts that errored have no file.
    rows = [row for row in read_rows(run / TABLE) if row["errored"] != 1]
    if options.method is not None:
        methods = dict.fromkeys(row["method"] for row in rows)
        if options.method not in methods:
            raise InputError(
                f"--method {options.method}: not in {run / TABLE}; choose among "
                f"{', '.join(methods)}"
            )
        rows = [row for row in rows if row["method"] == options.method]
    if options.all:
        return rows
    failures = list(filter(is_failure, rows))
    if not failures:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta, "
            "evaluate more scenes, or pass --all"
        )
    failures.sort(key=lambda row: row["counted"] != 1)
    return failures[: options.failures]


def export_attacks(run: Path, rows: list[dict], out: Path) -> None:
    """Write a file for each planner into a new folder: its attacks."""
    sets = AttackSet.of_run(run, kept(rows, "all"), begun=run)
    with written_whole(out) as folder:
        for attacks in sets:
            attacks.write(folder / f"{file_stem(attacks.ego)}{ENDING}")


def export(write: Callable[[Path], Iterator[tuple[Episode, Path]]], out: Path) -> None:
    """Write episodes into a new folder, with a list of the files and their facts."""
    lines = [["file", *FACTS, "adversaries"]]
    with written_whole(out) as folder:
        for episode, path in write(folder):
            facts = [episode.facts.get(name, "") for name in FACTS]
            adversaries = " ".join(map(str, episode.facts["adversaries"]))
            lines.append([str(path.relative_to(folder)), *facts, adversaries])
        write_atomically(folder / LIST, csv_text(lines))


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl export", description=__doc__)
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN_DIR",
        help="folder of a run of evaluate.py",
    )
    parser.add_argument(
        "--to",
        required=True,
        choices=(*FORMATS, ATTACKS),
        metavar="FORMAT",
        help=", ".join((*FORMATS, ATTACKS)),
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--failures",
        type=int,
        metavar="N",
        help="at most so many failures (default: all)",
    )
    which.add_argument(
        "--failure",
        metavar="NAME",
        help="only this failure, as failures.csv names it",
    )
    which.add_argument(
        "--all",
        action="store_true",
        help="every rollout, not only failures",
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
        part = "export"
        if options.failure:
            part = f"export/{options.failure}"
        out = options.out or own_folder(options.run, f"{part}/{options.to}")
        if options.open_ego and options.to not in OPEN_EGO:
            raise InputError(
                f"--open-ego: {options.to} has no such form; leave it out, or pass "
                f"--to {' or '.join(OPEN_EGO)}"
            )
        if out.exists():
            raise InputError(
                f"{out}: is there already; remove it, or pass another folder with --out"
            )
        rows = chosen_rows(options)
        if options.to == ATTACKS:
            export_attacks(options.run, rows, out)
            print(f"{len(rows)} attacks written to {out}")
            return
        write = writer_of(options.to, "--to")
        episodes = tqdm(
            episodes_of(
                options.run,
                rows,
                plugins=options.plugin,
                scene=not options.no_scene,
            ),
            "exporting",
            total=len(rows),
            unit="rollout",
            leave=False,
            disable=None,
        )
        export(partial(write, episodes, open_ego=options.open_ego), out)
        print(f"{len(rows)} rollouts written to {out}")
