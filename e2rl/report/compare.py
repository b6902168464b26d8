"""Two egos in the same scenes: a page with both replays of each pair in step, and the
pairs as CSV and JSON (docs/guide/compare.md).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import starmap
from pathlib import Path
from typing import Any

from e2rl.evaluation.comparison import CHANGES, PAIR, RATES, Driven, compared
from e2rl.evaluation.rollout_files import cell, json_text
from e2rl.evaluation.summary import headline
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.failure_modes import Row, is_failure, mode_name
from e2rl.report.answer import (
    FEW,
    errored_lines,
    headline_text,
    paragraphs,
    touched_lines,
    traffic_name,
)
from e2rl.report.failure_tracks import encoded_failure, replay_data
from e2rl.report.html import ASSETS, COLUMNS, page, rounded
from e2rl.report.tables import difference_cell
from e2rl.run.files import csv_text, write_atomically, write_beside
from e2rl.run.run import read_provenance
from e2rl.sim.rollout_file import ROLLOUTS, Failure, rollout_name

PAGE = "compare.html"
MOST = 200  # pairs that the page shows moving
FOLDER = ASSETS.parent / "compare"
SCRIPTS = (  # of the report that the page uses
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
FACTS = (  # of a rollout
    *(name for name in COLUMNS if name not in OF_BOTH),
    "min_dtc",
    "progress",
)
SIDES = ("first", "second")


def compare(first: Driven, second: Driven, path: Path) -> list[str]:
    """Writes the page, and JSON and CSV files of its name beside it; returns the lines
    that tell what has changed."""
    groups, pairs = compared(first, second)
    sides = dict(zip(SIDES, (first, second), strict=True))
    names = [side.ego for side in sides.values()]
    if first.ego == second.ego:
        names = [f"{side.ego} of {side.run}" for side in sides.values()]
    lines = [
        *sentences(groups, first.searched),
        *notes(first, second, groups=groups),
        *facts_of(names, (first, second)),
    ]
    changed = [pair for pair in pairs if pair["change"] != "same"]
    shown = []
    if all((side.run / ROLLOUTS).is_dir() for side in sides.values()):
        shown = [  # those with files
            pair
            for pair in changed
            if all(pair[name]["errored"] != 1 for name in sides)
        ][:MOST]
    rows = [pair | {name: facts(pair[name]) for name in sides} for pair in pairs]
    about = {
        "names": names,
        "runs": [str(side.run) for side in sides.values()],
        "groups": groups,
        "pairs": rows,
    }
    content = {
        **about,
        "told": lines,
        "pairs": rows[: len(changed)],
        **replay_data(starmap(encoded_failure, failures(sides, shown)), 2 * len(shown)),
    }
    scripts = [*(ASSETS / f"{name}.js" for name in SCRIPTS), FOLDER / "compare.js"]
    title = f"{names[1]} against {names[0]}"
    write_atomically(path, page(FOLDER / PAGE, title, scripts, content))
    write_beside(path, ".json", content=json_text(about))
    write_beside(path, ".csv", content=pair_list(rows))
    pages = f"All pairs: {path.with_suffix('.csv')} and .json"
    return paragraphs([f"{title}:", *lines, f"Watch both: {path}", pages])


def pair_list(rows: Sequence[Mapping]) -> str:
    """A line for each pair of the data block."""
    names = (*FACTS, "file", "error")
    head = [*PAIR, "change", "what"]
    head += [f"{name}_{side}" for side in SIDES for name in names]
    lines = [
        [
            *(row[name] for name in (*PAIR, "change")),
            " ".join(row["what"]),
            *(cell(row[side][name]) for side in SIDES for name in names),
        ]
        for row in rows
    ]
    return csv_text([head, *lines])


def facts(row: Row) -> dict[str, Any]:
    """What the page knows of a rollout: FACTS, its file, whether it has a `contact`,
    and in words what happens."""
    contact = is_failure(row)
    text = "no contact"
    if contact:
        text = mode_name([row])
    elif row["errored"] == 1:
        text = f"raised {row['error']}"
    return rounded(row, FACTS) | {
        "file": rollout_name(row),
        "contact": contact,
        "error": row["error"],
        "named": text,
    }


def facts_of(names: Sequence[str], sides: Sequence[Driven]) -> Iterator[str]:
    """The headline of both in each traffic, then whom else they touched, and what
    errored."""
    for name, driven in zip(names, sides, strict=True):
        for rows in driven.traffic().values():
            traffic = traffic_name(rows[0])
            yield headline_text(headline(rows, driven.searched), name, traffic=traffic)
    for name, driven in zip(names, sides, strict=True):
        for line in touched_lines(driven.rows):
            yield f"{name}: {line}"
        for line in errored_lines(driven.rows):
            yield f"{name}: {line}" if line.endswith(":") else line


def sentences(groups: Sequence[Mapping], searched: bool) -> Iterator[str]:
    """What has changed in each traffic: failures, then rates."""
    for group in groups:
        new, gone, moved, same = (group[name] for name in CHANGES)
        preventable = group["preventable"]
        where = f"{traffic_name(group)}, {group['of']} {group['unit']}"
        if searched:
            yield (
                f"{where}: failures in {gone + moved + same} before, in "
                f"{new + moved + same} after: {new} new, {gone} gone, {moved} moved to "
                f"other ways, {same} the same way."
            )
        else:
            yield (
                f"{where}: {new} failures are new ({preventable['new']} preventable), "
                f"{gone} gone ({preventable['gone']} preventable), {moved} moved, "
                f"{same} the same."
            )
        cells = [
            f"{rate} {difference_cell(METRICS[RATES[rate]], value)}"
            for rate, value in group["differences"].items()
        ]
        yield (
            "After minus before, in points (progress: m), 95% interval: "
            f"{'; '.join(cells)}."
        )


def notes(first: Driven, second: Driven, groups: Sequence[Mapping]) -> Iterator[str]:
    """What to know about the numbers."""
    differences = [value for group in groups for value in group["differences"].values()]
    if all(math.isnan(value["low"]) for value in differences):
        yield FEW
    if alone := len(first.rollouts().keys() ^ second.rollouts().keys()):
        yield f"Left out: {alone} that only one has driven to an end."
    versions = {
        read_provenance(side.run)["versions"][-1]["e2rl"] for side in (first, second)
    }
    if len(versions) > 1:
        yield (
            "The runs are of two versions of e2rl: what traffic does, and verdicts, "
            "may have changed, too."
        )


def failures(
    sides: Mapping[str, Driven], pairs: Sequence[Mapping]
) -> Iterator[tuple[Failure, Failure]]:
    """Both rollouts of each pair, each with the other beside it."""
    for pair in pairs:
        first, second = (
            Failure.read(side.run, pair[name]) for name, side in sides.items()
        )
        yield first, second
        yield second, first
