"""The failure report of a run, one HTML file that opens offline, and a list of its
failures.

It shows the failure modes, a replay of each failure, the atlas, an index to search, the
tables of the run and collisions over realism. Everything is inside the file: no script,
font or picture is loaded from elsewhere.
"""

import html
import json
import math
import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from e2rl.evaluation.modes import OTHER
from e2rl.evaluation.rates import EgoRates
from e2rl.evaluation.record import Record
from e2rl.evaluation.rollout_files import (
    RATES_FILE,
    TABLE,
    nulls,
    own_folder,
    rows_text,
)
from e2rl.evaluation.summary import headline
from e2rl.evaluation.transfer import CROSS_FILE, Matrix
from e2rl.metrics.atlas import CELL, by_likelihood, cell_of
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import raised
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.answer import group_lines
from e2rl.report.attachments import Attached
from e2rl.report.cross import cross_tables
from e2rl.report.failure_tracks import Encoded, encoded_failure, replay_data
from e2rl.report.outcomes import outcome_table
from e2rl.report.plain import plain_answer, plain_rate
from e2rl.report.rates import rate_tables, summary_lines
from e2rl.report.tables import (
    Table,
    column_names,
    metric_tables,
)
from e2rl.run.config import assigned
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically, write_beside
from e2rl.sim.rollout_file import ROLLOUTS, Failure, rollout_key, rollout_name

CHOSEN = (
    "These attacks were kept because they made a planner fail: rates are of them alone."
)
PAGE = "failures.html"
REPLAYS = 300  # in the page at most
ASSETS = Path(__file__).parents[1] / "assets" / "report"
GROUP = ("ego_policy", "method", "eta")
group_key = itemgetter(*GROUP)
ENDINGS = ("errored", "raised_by", "error")  # of rollouts.csv, the last in failures.csv
COLUMNS = (  # of rollouts.csv, in failures.csv and in the page's index and facts
    "scene_id",
    "location",
    *GROUP,
    "seed",
    "contact_time",
    "counted",
    "at_fault",
    "preventable",
    "cfr_clean",
    "duty",
    "contact_type",
    "partner",
    "relvel",
    "approach",
    "ego_manoeuvre",
    "partner_manoeuvre",
    "ego_speed",
    "partner_speed",
    "avoidable",
    "avoidable_1s",
    "evasion_accel",
    "cfr_adv",
    "transport",
)
PLOTTED = ("cfr", "cfr_counted", "real", "real_adv")
AGAIN = "Drive it again"


def encode(run: Path, row: Mapping[str, Any]) -> Encoded:
    """The replay of the failure of a row of a run's table."""
    return encoded_failure(Failure.read(run, row))


def write_report(
    run: Path,
    record: Record | None = None,
    tables: Sequence[Table] | None = None,
    replays: int = REPLAYS,
    methods: Sequence[str] = (),
    path: Path | None = None,
    *,
    progress: Mapping[str, Any] | None = None,
    attached: Attached | None = None,
    encode: Callable[[Path, Mapping], Encoded] = encode,
) -> Path:
    """Write the page of a run's folder, and the list of its failures beside it, in a
    file of the same name that ends in .csv; returns the page's path.

    Args:
        run: the folder, with its rollouts.
        record: what the run found; None: as its folder says.
        tables: to show; None: those of the metrics and modes.
        replays: at most so many failures are shown moving.
        methods: only their failures; (): those of all.
        path: of the file; None: PAGE in the folder.
        progress: of a run that is not finished, `text` that says how far it is, and
            `every`, s after which the page loads itself again (0: never).
        attached: files of the failures that are shown moving.
        encode: returns the replay of the failure of a row.

    Raises:
        InputError: where files of the run or a format's library are missing, or no
            method has the name.
    """
    record = record or Record.read(run)
    rates = EgoRates.read(run) if (run / RATES_FILE).is_file() else []
    crossed = (run / CROSS_FILE).is_file()
    if tables is None and crossed:
        tables = cross_tables(Matrix.read(run))
    if tables is None:
        tables = rate_tables(rates) if rates else metric_tables(record.metrics)
    content = page_content(run, record, methods)
    for ego, group in product(rates, content["groups"]):
        if ego.ego == group["ego"]:
            group |= {"summary": summary_lines(ego), "rates": {}}
            group["plain"] = plain_rate(ego)
    if rates or crossed:  # their noise is not kept
        content["commands"].pop(AGAIN, None)
        content["outcomes"] = None  # rollouts that were chosen because something failed
    if crossed:
        for group in content["groups"]:
            group["plain"] = None
            group["summary"] = [*group["summary"], CHOSEN]
    rows = content.pop("rows")
    entries = content["failures"]
    order = replay_order(entries)[:replays]
    for number, position in enumerate(order):
        entries[position]["replay"] = number
    content["tables"] = list(map(vars, tables))
    content["progress"] = progress
    if attached:
        content["attached"] = attached.files(run, [rows[each] for each in order])
    # one rollout at a time in memory
    replays_shown = (encode(run, rows[position]) for position in order)
    content |= replay_data(replays_shown, len(order))
    path = path or own_folder(run, PAGE)
    write_beside(path, ".csv", content=failure_list(content, path.name))
    scripts = sorted(ASSETS.glob("*.js"), key=lambda file: file.stem == "page")
    egos = dict.fromkeys(group["ego"] for group in content["groups"])
    title = f"Failures of {', '.join(egos)}"
    write_atomically(path, page(ASSETS / "page.html", title, scripts, content))
    return path


def failure_list(content: Mapping[str, Any], page_name: str) -> str:
    """failures.csv: a line for each failure of the data block: its name, COLUMNS, its
    mode in words, the link to it in the page, the command that drives it again, and
    ENDINGS; then one for each rollout that errored, which has no mode, link or command.
    """
    again = content["commands"].get(AGAIN, "")
    rows = []
    for entry in content["failures"]:
        key = entry["key"]
        about = {
            "failure": key,
            "mode": content["modes"].get(entry["mode"], ""),
            "link": f"{page_name}#failure={key}",
            "again": again.replace("@NAME@", key),
            "errored": 0,
        }
        rows.append(entry | about)
    for entry in content["errored"]:
        rows.append(entry | {"failure": entry["key"], "errored": 1})
    columns = ("failure", *COLUMNS, "mode", "link", "again", *ENDINGS)
    return rows_text(rows, columns)


def page(
    body: Path,
    title: str,
    scripts: Sequence[Path],
    content: Mapping[str, Any],
) -> str:
    """The frame of all pages with a body, the report's style and that beside the body.

    Args:
        body: of HTML, with a style sheet of its name beside it.
        title: of the page.
        scripts: the last one uses all others.
        content: the data block, of what JSON holds.

    Returns:
        The page's text.
    """
    styles = dict.fromkeys((ASSETS / "page.css", body.with_suffix(".css")))
    data = json.dumps(nulls(content), allow_nan=False, separators=(",", ":"))
    parts = {
        "TITLE": html.escape(title),
        "STYLE": "".join(path.read_text() for path in styles),
        "SCRIPT": "\n".join(path.read_text() for path in scripts),
        "DATA": data.replace("<", "\\u003c"),
    }
    frame = (ASSETS / "frame.html").read_text()
    whole = frame.replace("{{BODY}}\n", body.read_text())
    return re.sub("{{([A-Z]+)}}", lambda field: parts[field[1]], whole)


def page_content(run: Path, record: Record, methods: Sequence[str]) -> dict[str, Any]:
    """The data block without replays and tables of metrics.

    Args:
        run: the folder.
        record: what the run found.
        methods: whose failures are shown; (): all.

    Returns:
        The fields of the page; besides, `rows` are the failures' rows of rollouts.csv.

    Raises:
        InputError: for a run without closed-loop rollouts, or an unknown method.
    """
    metrics = record.metrics
    modes = record.modes
    every = record.rollouts
    searched = record.searched
    names = dict.fromkeys(group["method"] for group in modes["groups"])
    if not (names and metrics):
        raise InputError(
            f"{run / TABLE}: no closed-loop rollouts; give the folder of a run of "
            "evaluate.py with some"
        )
    for name in methods:
        if name not in names:
            raise InputError(
                f"--method {name}: not in {run / TABLE}; choose among "
                f"{', '.join(names)}"
            )
    first = metrics[0]
    measured = {(row["ego"], row["method"], row["eta"]): row for row in metrics}
    groups = {}
    by_name = {}
    for group, label in zip(
        modes["groups"],
        column_names(modes["groups"]),
        strict=True,
    ):
        if methods and group["method"] not in methods:
            continue
        key = group_key(group)
        rows = [row for row in every if group_key(row) == key]
        by_name[f"{group['ego_policy']}, {label}"] = rows
        rates, lines = group_lines(group, rows, metrics=metrics, searched=searched)
        groups[key] = {
            "ego": group["ego_policy"],
            "label": label,
            "rates": rates,
            "summary": lines,
            "plain": plain_answer(
                headline(rows, searched),
                measured.get(key, first | {"metrics": {}}),
                ego=group["ego_policy"],
                eta=group["eta"],
            ),
            **{name: group[name] for name in ("method", "eta", "rollouts", "failures")},
            "raised": sum(map(raised, rows)),
        }
    shown = [row for row in every if group_key(row) in groups]
    failures = list(filter(is_failure, shown))
    cells = sorted({cell for row in failures if (cell := cell_of(row))})
    mode_names = {mode["mode"]: mode["name"] for mode in modes["modes"]}
    typical = {mode["typical"]["file"] for mode in modes["modes"]}
    facts = ("dataset", "split", "n_scenes", "git", "command")
    return {
        "run": {name: first[name] for name in facts} | {"stage": first.get("stage")},
        "commands": commands(
            run,
            record.config,
            quoted=any("~" in rollout_key(row) for row in failures),
        ),
        "groups": list(groups.values()),
        "modes": mode_names,
        "cells": [dict(zip(CELL, cell, strict=True)) for cell in cells],
        "failures": failure_entries(failures, mode_names, typical=typical, cells=cells),
        "errored": [
            {name: row[name] for name in (*COLUMNS, *ENDINGS)}
            | {"key": rollout_key(row)}
            for row in shown
            if row["errored"] == 1
        ],
        "rows": failures,
        "outcomes": outcome_table(by_name, searched=searched),
        "points": [
            {name: row[name] for name in ("ego", "method", "eta")}
            | {
                "values": {
                    name: row["metrics"][name]
                    for name in PLOTTED
                    if row["metrics"].get(name, {}).get("n")
                }
            }
            for row in metrics
        ],
        "about": {metric.name: metric.about for metric in METRICS.values()},
    }


def commands(run: Path, config: DictConfig | None, quoted: bool) -> dict[str, str]:
    """Commands about the failure @NAME@ of a run, by what they do; config: of the
    evaluation, if it is one; quoted: names that Hydra takes in quotes only."""
    path = str(run)
    if run.resolve().is_relative_to(Path.cwd()):
        path = os.path.relpath(run)
    lines = {}
    if config is not None:
        # One failure, driven again, has no tries.
        whole = config.get("reproduce") if config.get("failure") else path
        name = 'failure="@NAME@"' if quoted else "failure=@NAME@"
        lines[AGAIN] = ["e2rl", "evaluate", assigned("reproduce", whole), name]
    export = ["e2rl", "export", path, "--to", "openscenario", "--failure", "@NAME@"]
    lines["Export it"] = export
    lines["Its video"] = ["e2rl", "replay", f"{path}/{ROLLOUTS}/@NAME@.npz"]
    return {title: shlex.join(words) for title, words in lines.items()}


def failure_entries(
    rows: Sequence[dict],
    modes: Mapping[int, str],
    *,
    typical: set[str],
    cells: Sequence[tuple],
) -> list[dict[str, Any]]:
    """What the page knows of each failure.

    Args:
        rows: of rollouts.csv.
        modes: names of the modes that are none of small ones.
        typical: files of the typical failures.
        cells: of the atlas.

    Returns:
        COLUMNS and its name, `key`; its `mode`, OTHER for small ones; whether it is
        `typical`, and the `worst` of its group; its `cell`, a position in the atlas
        (None: not preventable), and `rank`, 0 for the likeliest of all.
    """
    worst: dict[tuple, str] = {}
    for row in sorted(rows, key=severity, reverse=True):
        worst.setdefault(group_key(row), rollout_key(row))
    likeliest = sorted(
        range(len(rows)), key=lambda position: by_likelihood(rows[position])
    )
    ranks = {position: rank for rank, position in enumerate(likeliest)}
    entries = []
    for position, row in enumerate(rows):
        cell = cell_of(row)
        entries.append(
            rounded(row, COLUMNS)
            | {
                "key": rollout_key(row),
                "mode": int(row["mode"]) if row["mode"] in modes else OTHER,
                "typical": rollout_name(row) in typical,
                "replay": None,
                "cell": cells.index(cell) if cell else None,
                "rank": ranks[position],
                "worst": rollout_key(row) in worst.values(),
            }
        )
    return entries


def severity(row: Mapping) -> tuple[bool, bool, float]:
    """The greater, the worse: a failure that counts, a preventable one, the impact
    speed."""
    speed = 0.0 if math.isnan(row["relvel"]) else row["relvel"]
    return row["counted"] == 1, row["preventable"] == 1, speed


def rounded(row: Mapping, names: Sequence[str]) -> dict[str, Any]:
    """Values of a row, with four decimals."""
    return {
        name: round(row[name], 4) if isinstance(row[name], float) else row[name]
        for name in names
    }


def replay_order(entries: Sequence[Mapping]) -> list[int]:
    """Positions of failures in the order in which they get a replay: the worst of each
    traffic, the typical ones, the likeliest of each cell of the atlas in each traffic,
    then in turn one of each mode of each method."""
    turns: Counter[tuple] = Counter()

    def turn(position: int, name: str) -> int:
        """How many of its group had the same value, with it."""
        key = (*group_key(entries[position]), name, entries[position][name])
        turns[key] += 1
        return turns[key]

    positions = range(len(entries))
    likeliest = sorted(positions, key=lambda position: entries[position]["rank"])
    of_cell = {position: turn(position, "cell") for position in likeliest}
    of_mode = [turn(position, "mode") for position in positions]

    def place(position: int) -> tuple:
        entry = entries[position]
        first = entry["cell"] is not None and of_cell[position] == 1
        return not entry["worst"], not entry["typical"], not first, of_mode[position]

    return sorted(positions, key=place)
