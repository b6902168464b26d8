"""`e2rl compare RUN RUN`, or `e2rl compare RUN --egos A B`: which failures of the
second are new, gone, or moved.

Writes a page with both replays in step, and the pairs as CSV and JSON
(docs/how-to/compare.md).
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from e2rl.evaluation.comparison import CHANGES, PAIR, RATES, Driven, compared
from e2rl.evaluation.headline import headline
from e2rl.evaluation.rollout_files import cell, json_text, own_folder
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.failure_modes import Row, is_failure, mode_name
from e2rl.report.answer import FEW, wrapped
from e2rl.report.failure_tracks import replay_data
from e2rl.report.headline import (
    errored_lines,
    headline_text,
    touched_lines,
    traffic_name,
)
from e2rl.report.html import ASSETS, COLUMNS, page
from e2rl.report.tables import difference_cell
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically, write_beside
from e2rl.run.run import read_provenance
from e2rl.sim.rollout_file import ROLLOUTS, Failure, rollout_name

PAGE = "compare.html"
MOST = 200  # pairs that the page shows moving
FOLDER = ASSETS.parent / "compare"
# scripts of the report that the page uses
SCRIPTS = (
    "palette",
    "plot",
    "decode",
    "scene",
    "plans",
    "curves",
    "verdict",
    "modes",
    "index",
    "player",
)
OF_BOTH = (*PAIR, "location", "ego_policy")
FACTS = (
    *(name for name in COLUMNS if name not in OF_BOTH),
    "min_dtc",
    "progress",
)  # of a rollout
SIDES = ("first", "second")


def compare(first: Driven, second: Driven, path: Path) -> list[str]:
    """Writes the page, and JSON and CSV files of its name beside it; returns the lines
    that tell what has changed."""
    groups, pairs = compared(first, second)
    names = [
        f"{one.ego} of {one.run}" if first.ego == second.ego else one.ego
        for one in (first, second)
    ]
    rows = [pair | {side: facts(pair[side]) for side in SIDES} for pair in pairs]
    told = [
        *sentences(groups, first.searched),
        *notes(first, second, groups=groups),
        *facts_of(names, (first, second)),
    ]
    changed = [pair for pair in pairs if pair["change"] != "same"]
    runs = first.run, second.run
    ended = [
        pair for pair in changed if all(pair[side]["errored"] != 1 for side in SIDES)
    ]  # which have files
    shown = ended[:MOST] if all((run / ROLLOUTS).is_dir() for run in runs) else []
    about = {"names": names, "runs": [*map(str, runs)], "groups": groups, "pairs": rows}
    replays = replay_data(replayed(runs, shown), 2 * len(shown))
    content = {**about, "told": told, "pairs": rows[: len(changed)], **replays}
    scripts = [*(ASSETS / f"{name}.js" for name in SCRIPTS), FOLDER / "compare.js"]
    write_atomically(
        path,
        page(
            FOLDER / PAGE,
            " against ".join(names[::-1]),
            scripts=scripts,
            content=content,
        ),
    )
    write_beside(path, ".json", content=json_text(about))
    columns = [
        *PAIR,
        "change",
        "what",
        *(f"{name}_{side}" for side in SIDES for name in (*FACTS, "file", "error")),
    ]
    flat = [
        row
        | {
            f"{name}_{side}": cell(row[side][name])
            for side in SIDES
            for name in row[side]
        }
        for row in rows
    ]
    lines = [
        [" ".join(row[name]) if name == "what" else row[name] for name in columns]
        for row in flat
    ]
    write_beside(path, ".csv", content=csv_text([columns, *lines]))
    ends = [f"Watch both: {path}", f"All pairs: {path.with_suffix('.csv')} and .json"]
    return [
        line
        for text in (f"{names[1]} against {names[0]}:", *told, *ends)
        for line in wrapped(text, "  ")
    ]


def facts(row: Row) -> dict[str, Any]:
    """What the page knows of a rollout: FACTS, its file, whether it has a `contact`,
    and in words what happens."""
    values = {
        name: round(row[name], 4) if isinstance(row[name], float) else row[name]
        for name in FACTS
    }
    hit = is_failure(row)
    named = (
        mode_name([row])
        if hit
        else f"raised {row['error']}"
        if row["errored"] == 1
        else "no contact"
    )
    return {
        **values,
        "file": rollout_name(row),
        "contact": hit,
        "error": row["error"],
        "named": named,
    }


def facts_of(names: Sequence[str], sides: Sequence[Driven]) -> Iterator[str]:
    """The headline of both in each traffic, then whom else they touched, and what
    errored."""
    for name, driven in zip(names, sides, strict=True):
        for rows in driven.traffic().values():
            yield headline_text(
                headline(rows, driven.searched), name, traffic=traffic_name(rows[0])
            )
    for name, driven in zip(names, sides, strict=True):
        yield from (f"{name}: {line}" for line in touched_lines(driven.rows))
        yield from (
            f"{name}: {line}" if line.endswith(":") else line
            for line in errored_lines(driven.rows)
        )


def sentences(groups: Sequence[Mapping], searched: bool) -> Iterator[str]:
    """What has changed in each traffic: failures, then rates."""
    for group in groups:
        (new, gone, moved, same), counts = (
            (group[name] for name in CHANGES),
            group["preventable"],
        )
        text = f"{traffic_name(dict(group))}, {group['of']} {group['unit']}: "
        if searched:
            text += f"failures in {gone + moved + same} before, in {new + moved + same} after: "
            yield f"{text}{new} new, {gone} gone, {moved} moved to other ways, {same} the same way."
        else:
            text += f"{new} failures are new ({counts['new']} preventable), "
            yield f"{text}{gone} gone ({counts['gone']} preventable), {moved} moved, {same} the same."
        values = group["differences"].items()
        cells = [
            f"{rate} {difference_cell(METRICS[RATES[rate]], value)}"
            for rate, value in values
        ]
        yield f"After minus before, in points (progress: m), 95% interval: {'; '.join(cells)}."


def notes(first: Driven, second: Driven, groups: Sequence[Mapping]) -> Iterator[str]:
    """What to know about the numbers."""
    if all(
        value["low"] != value["low"]
        for group in groups
        for value in group["differences"].values()
    ):
        yield FEW
    if lost := len(first.rollouts().keys() ^ second.rollouts().keys()):
        yield f"Left out: {lost} that only one has driven to an end."
    if (
        len(
            {
                read_provenance(one.run)["versions"][-1]["e2rl"]
                for one in (first, second)
            }
        )
        > 1
    ):
        yield "The runs are of two versions of e2rl: what traffic does, and verdicts, may have changed, too."


def replayed(
    runs: Sequence[Path], pairs: Sequence[Mapping]
) -> Iterator[tuple[Failure, Failure]]:
    """Both rollouts of each pair, each with the other beside it."""
    for pair in pairs:
        one, other = (
            Failure.read(run, pair[side]) for run, side in zip(runs, SIDES, strict=True)
        )
        yield from ((one, other), (other, one))


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl compare", description=__doc__)
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN",
        help="the one before, the one after; or one run",
    )
    parser.add_argument(
        "--egos", nargs=2, metavar="NAME", help="the ego before and the one after"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=f"the page (default: {PAGE} in the last run's folder)",
    )
    options = parser.parse_args(arguments)
    with ending():
        runs = options.runs
        egos = options.egos or (None, None)
        if len(runs) > 2 or (len(runs) == 1 and not options.egos):
            raise InputError(
                "give two runs, or one with several egos and --egos BEFORE AFTER"
            )
        if options.out is not None and options.out.suffix != ".html":
            raise InputError(
                f"--out {options.out}: name a file that ends in .html; .csv and .json come beside it"
            )
        first, second = (
            Driven.read(run, ego)
            for run, ego in zip((runs[0], runs[-1]), egos, strict=True)
        )
        print(
            *compare(first, second, path=options.out or own_folder(runs[-1], PAGE)),
            sep="\n",
        )
