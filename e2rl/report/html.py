"""`e2rl report RUN_DIR`: the failure report of a run, one HTML file that opens offline,
and a list of its failures.

It shows the failure modes, a replay of each failure, the atlas, an index to search, the
tables of the run and collisions over realism. Everything is inside the file: no script,
font or picture is loaded from elsewhere.
"""

import argparse
import html
import json
import math
import os
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from e2rl.evaluation.budget import TRIES_FILE
from e2rl.evaluation.headline import headline
from e2rl.evaluation.methods import SEARCH
from e2rl.evaluation.modes import MODES_FILE, OTHER, read_modes
from e2rl.evaluation.rollout_files import (
    ERRORED_FILE,
    METRICS_FILE,
    TABLE,
    cell,
    nulls,
    own_folder,
    read_metrics,
    read_run,
)
from e2rl.metrics.atlas import CELL, Cell, by_likelihood, cell_of
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import raised
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.answer import FEW, of, rate
from e2rl.report.failure_tracks import replay_data
from e2rl.report.headline import (
    errored_lines,
    headline_text,
    touched_lines,
    traffic_name,
    unit_of,
)
from e2rl.report.tables import (
    Table,
    closed_loop,
    column_names,
    metric_tables,
    mode_tables,
)
from e2rl.run.config import assigned
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically, write_beside
from e2rl.run.trust import CONFIG, read_yaml
from e2rl.sim.rollout_file import ROLLOUTS, Failure, rollout_key, rollout_name

PAGE = "failures.html"
REPLAYS = 300  # in the page at most
ASSETS = Path(__file__).parents[1] / "assets" / "report"
GROUP = ("ego_policy", "method", "eta")
ENDINGS = ("errored", "raised_by", "error")  # of rollouts.csv, the last in failures.csv
COLUMNS = (  # of rollouts.csv, in failures.csv and in the page's index and facts
    *(
        "scene_id",
        "location",
        *GROUP,
        "seed",
        "contact_time",
        "counted",
        "at_fault",
        "preventable",
        "cfr_clean",
    ),
    *(
        "duty",
        "contact_type",
        "partner",
        "relvel",
        "approach",
        "ego_manoeuvre",
        "partner_manoeuvre",
    ),
    *(
        "ego_speed",
        "partner_speed",
        "avoidable",
        "avoidable_1s",
        "evasion_accel",
        "cfr_adv",
        "transport",
    ),
)
PLOTTED = ("cfr", "cfr_counted", "real", "real_adv")
AGAIN = "Drive it again"
MEASURED = (
    "before",
    f"before/{SEARCH}",
    "after",
    f"after/{SEARCH}",
)  # folders of a training
RATES = ("cfr", "cfr_counted", "cfr_preventable")  # of a group, in words


def write_report(
    run: Path,
    metrics: Sequence[dict] | None = None,
    modes: Mapping | None = None,
    tables: Sequence[Table] | None = None,
    replays: int = REPLAYS,
    methods: Sequence[str] = (),
    path: Path | None = None,
) -> Path:
    """Write the page of a run's folder, and the list of its failures beside it, in a
    file of the same name that ends in .csv; returns the page's path. Raises InputError
    where files of the run are missing, or no method has the name.

    Args:
        run: the folder, with its rollouts and their table.
        metrics, modes: contents of metrics.json and modes.json; None: those of the
            folder.
        tables: to show; None: those of the metrics and modes.
        replays: at most so many failures are shown moving.
        methods: only their failures; (): those of all.
        path: of the file; None: PAGE in the folder.
    """
    if metrics is None and not (run / METRICS_FILE).is_file():
        why = f"the run is not finished, or none of its rollouts could be scored, as {ERRORED_FILE} says then"
        raise InputError(
            f"{run}: no {METRICS_FILE}: {why}; `e2rl gate` and `e2rl compare` read its {TABLE}"
        )
    metrics = read_metrics(run / METRICS_FILE) if metrics is None else metrics
    modes = read_modes(run / MODES_FILE) if modes is None else modes
    tables = (
        [*metric_tables(metrics), *mode_tables(modes)] if tables is None else tables
    )
    content = page_content(run, metrics, modes=modes, methods=methods) | {
        "tables": [vars(table) for table in tables]
    }
    content |= add_replays(
        run, content.pop("rows"), index=content["failures"], count=replays
    )
    path = path or own_folder(run, PAGE)
    write_beside(path, ".csv", content=failure_list(content, path.name))
    scripts = sorted(
        ASSETS.glob("*.js"), key=lambda script: script.stem == "page"
    )  # which uses all others
    title = f"Failures of {', '.join(dict.fromkeys(group['ego'] for group in content['groups']))}"
    write_atomically(
        path, page(ASSETS / "page.html", title, scripts=scripts, content=content)
    )
    return path


def failure_list(content: Mapping[str, Any], page_name: str) -> str:
    """failures.csv: a line for each failure of the data block: its name, COLUMNS, its
    mode in words, the link to it in the page, the command that drives it again, and
    ENDINGS; then one for each rollout that errored, which has no mode, link or command.
    """
    again = content["commands"].get(AGAIN, "")
    lines = [
        [
            entry["key"],
            *(cell(entry[name]) for name in COLUMNS),
            content["modes"].get(entry["mode"], ""),
        ]
        + [
            f"{page_name}#failure={entry['key']}",
            again.replace("@NAME@", entry["key"]),
            0,
            "",
            "",
        ]
        for entry in content["failures"]
    ]
    lines += [
        [
            entry["key"],
            *(cell(entry[name]) for name in COLUMNS),
            "",
            "",
            "",
            1,
            entry["raised_by"],
            entry["error"],
        ]
        for entry in content["errored"]
    ]
    return csv_text([["failure", *COLUMNS, "mode", "link", "again", *ENDINGS], *lines])


def page(
    body: Path, title: str, scripts: Sequence[Path], content: Mapping[str, Any]
) -> str:
    """The frame of all pages with a body, the report's style and that beside the body,
    scripts and a data block."""
    styles = dict.fromkeys((ASSETS / "page.css", body.with_suffix(".css")))
    parts = {
        "TITLE": html.escape(title),
        "STYLE": "".join(path.read_text() for path in styles),
        "SCRIPT": "\n".join(path.read_text() for path in scripts),
        "DATA": json.dumps(
            nulls(content), allow_nan=False, separators=(",", ":")
        ).replace("<", "\\u003c"),
    }
    whole = (ASSETS / "frame.html").read_text().replace("{{BODY}}\n", body.read_text())
    return re.sub("{{([A-Z]+)}}", lambda field: parts[field[1]], whole)


def page_content(
    run: Path, metrics: Sequence[dict], modes: Mapping, methods: Sequence[str]
) -> dict[str, Any]:
    """The data block without tables and replays; `rows` are the failures' rows of
    rollouts.csv."""
    known = dict.fromkeys(group["method"] for group in modes["groups"])
    if not (known and metrics):
        raise InputError(
            f"{run / TABLE}: no closed-loop rollouts; give the folder of a run of evaluate.py with some"
        )
    if wrong := [name for name in methods if name not in known]:
        raise InputError(
            f"--method {wrong[0]}: not in {run / TABLE}; choose among {', '.join(known)}"
        )
    labels = zip(modes["groups"], column_names(modes["groups"]), strict=True)
    every = read_run(run)
    searched = (run / TRIES_FILE).is_file()
    groups = {
        group_key(group): {"ego": group["ego_policy"], "label": label}
        | {
            "rates": rates(group, metrics, searched=searched),
            "summary": summary(group, metrics, rows=every, searched=searched),
        }
        | {name: group[name] for name in ("method", "eta", "rollouts", "failures")}
        | {
            "raised": sum(
                raised(row) for row in every if group_key(row) == group_key(group)
            )
        }
        for group, label in labels
        if not methods or group["method"] in methods
    }
    rows = [row for row in every if is_failure(row) and group_key(row) in groups]
    worst = worst_keys(rows)
    errored = [row for row in every if row["errored"] == 1 and group_key(row) in groups]
    names = {mode["mode"]: mode["name"] for mode in modes["modes"]}
    typical = {mode["typical"]["file"] for mode in modes["modes"]}
    cells, places = atlas_places(rows)
    return {
        "run": {
            name: metrics[0][name]
            for name in ("dataset", "split", "n_scenes", "git", "command")
        }
        | {"stage": metrics[0].get("stage")},
        "commands": commands(run, "~" in "".join(map(rollout_key, rows))),
        "groups": list(groups.values()),
        "modes": names,
        "cells": [dict(zip(CELL, cell, strict=True)) for cell in cells],
        "failures": [
            failure(row, names, typical=typical)
            | place
            | {"worst": rollout_key(row) in worst}
            for row, place in zip(rows, places, strict=True)
        ],
        "errored": [
            {name: row[name] for name in (*COLUMNS, *ENDINGS)}
            | {"key": rollout_key(row)}
            for row in errored
        ],
        "rows": rows,
        "points": [plotted(row) for row in closed_loop(metrics)],
        "about": {metric.name: metric.about for metric in METRICS.values()},
    }


def group_key(row: Mapping) -> tuple:
    return tuple(row[name] for name in GROUP)


def rates(group: Mapping, metrics: Sequence[dict], searched: bool) -> dict[str, str]:
    """The RATES of a group of modes.json in words; {} where metrics.json knows the
    group in a pool only, or knows rates of its tries, as earlier versions wrote them.
    """
    own = [
        row
        for row in closed_loop(metrics)
        if group_key(row | {"ego_policy": row["ego"]}) == group_key(group)
    ]
    own = [row for row in own if row.get("searched", False) == searched]
    known = [
        (row, name)
        for row in own
        for name in RATES
        if row["metrics"].get(name, {}).get("n")
    ]
    return {
        name: f"{of(row, name)} {unit_of(row)} ({rate(row, name)})"
        for row, name in known
    }


def summary(
    group: Mapping, metrics: Sequence[dict], rows: Sequence[dict], searched: bool
) -> list[str]:
    """The page's first lines about a group of modes.json: its headline, then its rates
    and what to know of them.

    Args:
        group: ego, method and intensity.
        metrics: of metrics.json.
        rows: of all rollouts of the run.
        searched: they are tries.
    """
    own = [row for row in rows if group_key(row) == group_key(group)]
    known = rates(group, metrics, searched=searched)
    crashed = any(map(raised, own))
    lines = [
        headline_text(
            headline(own, searched), group["ego_policy"], traffic=traffic_name(group)
        )
    ]
    if "cfr" in known:
        lines.append(
            f"It was hit{', or raised,' if crashed else ''} in {known['cfr']}."
        )
    if "cfr_counted" in known:
        reasons = f"its fault, or a competent driver prevents it{', or it raised' if crashed else ''}"
        lines.append(
            f"It has a failure that counts in {known['cfr_counted']}: {reasons}."
        )
    lines += [] if "interval" in known.get("cfr", "interval") else [FEW]
    lines += (
        ["Tries go where failures are: rates of tries are no rates of the planner."]
        if searched
        else []
    )
    lines += touched_lines(own, shown=True)
    return [
        *lines,
        *(f"{line.rstrip(':')}." for line in errored_lines(own) if line.endswith(":")),
    ]


def worst_keys(rows: Sequence[Mapping]) -> set[str]:
    """Names of the worst failure of each ego, method and intensity: one that counts
    where any does, first preventable ones, of these the one with the highest impact
    speed."""

    def severity(row: Mapping) -> tuple[bool, bool, float]:
        speed = 0.0 if math.isnan(row["relvel"]) else row["relvel"]
        return row["counted"] == 1, row["preventable"] == 1, speed

    groups: dict[tuple, list[Mapping]] = {}
    for row in rows:
        groups.setdefault(group_key(row), []).append(row)
    return {rollout_key(max(own, key=severity)) for own in groups.values()}


def commands(run: Path, quoted: bool) -> dict[str, str]:
    """Commands about the failure @NAME@ of a run, by what they do; quoted: names that
    Hydra takes in quotes only."""
    path = (
        os.path.relpath(run) if run.resolve().is_relative_to(Path.cwd()) else str(run)
    )
    export = ["e2rl", "export", path, "--to", "openscenario", "--failure", "@NAME@"]
    found = {
        "Export it": export,
        "Its video": ["e2rl", "replay", f"{path}/{ROLLOUTS}/@NAME@.npz"],
    }
    if (run / CONFIG).is_file():  # an evaluation's
        saved = read_yaml(run / CONFIG)
        whole = (
            saved.get("reproduce") if saved.get("failure") else path
        )  # one failure, driven again, has no tries
        again = [
            assigned("reproduce", whole),
            'failure="@NAME@"' if quoted else "failure=@NAME@",
        ]
        found = {AGAIN: ["e2rl", "evaluate", *again], **found}
    return {what: shlex.join(words) for what, words in found.items()}


def failure(
    row: Mapping, names: Mapping[int, str], typical: set[str]
) -> dict[str, Any]:
    """What the page knows of a failure: its name, COLUMNS, its mode (OTHER for small
    ones), whether it is typical."""
    mode = int(row["mode"]) if row["mode"] in names else OTHER
    values = {
        name: round(row[name], 4) if isinstance(row[name], float) else row[name]
        for name in COLUMNS
    }
    return values | {
        "key": rollout_key(row),
        "mode": mode,
        "typical": rollout_name(row) in typical,
        "replay": None,
    }


def atlas_places(
    rows: Sequence[Mapping],
) -> tuple[list[Cell], list[dict[str, int | None]]]:
    """The cells of the atlas, and each failure's place in it: `cell`, a position in the
    list (None: not preventable), and `rank`, 0 for the likeliest of all rows."""
    found = [cell_of(row) for row in rows]
    cells = sorted({cell for cell in found if cell})
    order = sorted(range(len(rows)), key=lambda position: by_likelihood(rows[position]))
    ranks = {position: rank for rank, position in enumerate(order)}
    position_of = {cell: position for position, cell in enumerate(cells)}
    return cells, [
        {"cell": position_of[cell] if cell else None, "rank": ranks[at]}
        for at, cell in enumerate(found)
    ]


def plotted(row: Mapping) -> dict[str, Any]:
    """A point of the plot of collisions over realism: the estimates PLOTTED of a row of
    metrics.json."""
    values = {
        name: row["metrics"][name]
        for name in PLOTTED
        if row["metrics"].get(name, {}).get("n")
    }
    return {
        "ego": row["ego"],
        "method": row["method"],
        "eta": row["eta"],
        "values": values,
    }


def add_replays(
    run: Path, rows: Sequence[dict], index: Sequence[dict], count: int
) -> dict[str, Any]:
    """`replay_data` of `count` failures; writes the number of its replay into each of
    `index`."""
    chosen = replay_order(index)[:count]
    for number, position in enumerate(chosen):
        index[position]["replay"] = number
    return replay_data(
        ((Failure.read(run, rows[position]), None) for position in chosen), len(chosen)
    )


def replay_order(index: Sequence[Mapping]) -> list[int]:
    """Positions of failures in the order in which they get a replay: the worst of each
    traffic, the typical ones, the likeliest of each cell of the atlas in each traffic,
    then in turn one of each mode of each method."""
    seen: Counter[tuple] = Counter()

    def turn(position: int, name: str) -> int:
        key = (*group_key(index[position]), name, index[position][name])
        seen[key] += 1
        return seen[key]

    of_cell = {
        each: turn(each, "cell")
        for each in sorted(range(len(index)), key=lambda each: index[each]["rank"])
    }
    of_mode = [turn(each, "mode") for each in range(len(index))]

    def place(position: int) -> tuple:
        likeliest = index[position]["cell"] is not None and of_cell[position] == 1
        entry = index[position]
        return (
            not entry["worst"],
            not entry["typical"],
            not likeliest,
            of_mode[position],
            position,
        )

    return sorted(range(len(index)), key=place)


def folders_of(run: Path) -> list[Path]:
    """Returns the folders with rollouts: the run's own, or those of a training;
    InputError where there are none."""
    if found := [
        each
        for each in (run, *(run / part for part in MEASURED))
        if (each / TABLE).is_file()
    ]:
        return found[:1] if found[0] == run else found
    mend = "give a run of evaluate.py, which drives what another training made by its checkpoint"
    raise InputError(
        f"{run}: no {TABLE}, neither of an evaluation nor measured by a training; {mend}"
    )


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
        "--out", type=Path, help=f"file to write (default: RUN_DIR/{PAGE})"
    )
    options = parser.parse_args(arguments)
    with ending():
        folders = folders_of(options.run)
        if (options.out or options.method) and len(folders) > 1:
            raise InputError(
                f"{options.run}: a training has {len(folders)} pages; name one, such as {folders[-1]}"
            )
        for folder in folders:
            print(
                write_report(
                    folder,
                    replays=options.replays,
                    methods=options.method,
                    path=options.out,
                )
            )
