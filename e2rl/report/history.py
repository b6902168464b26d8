"""Versions of a planner, each with a run in the same scenes: a page of scenes over
versions, and the list of scenes as CSV (docs/guide/compare.md).
"""

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

from e2rl.evaluation.comparison import Driven, difference
from e2rl.evaluation.history import (
    ALWAYS,
    FLICKERS,
    KINDS,
    LASTS,
    MENDED,
    NEVER,
    NEW,
    SceneHistory,
    SceneResult,
    scene_histories,
    scene_results,
    version_names,
)
from e2rl.evaluation.rollout_files import TABLE
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.failure_modes import is_failure
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import summarise
from e2rl.report.answer import paragraphs, per_cent
from e2rl.report.html import ASSETS, PAGE, page
from e2rl.report.tables import UNKNOWN, estimate, plural
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically, write_beside
from e2rl.run.run import read_provenance
from e2rl.sim.rollout_file import rollout_key

HISTORY = "history.html"
FOLDER = ASSETS.parent / "history"
SCRIPTS = (ASSETS / "palette.js", ASSETS / "plot.js", FOLDER / "history.js")
FAILED = "cfr_preventable"
SHOWN = {"preventable": FAILED, "hit": "cfr", "progress": "progress"}
PLATFORM = ("git", "python", "torch", "e2rl", "bundled weights")  # no code of a planner
SHORT = 8  # characters of a hash
SEARCHED = (
    "A search goes on by what it has found, so a scene may come and go by chance; rates "
    "over all scenes tell."
)
Traffic = tuple[str, float]  # method and intensity


def write_history(
    versions: Sequence[Driven],
    path: Path,
    methods: Sequence[str] = (),
) -> list[str]:
    """Writes the page, and a CSV file of its name beside it; returns the lines for a
    terminal.

    Args:
        versions: `read_versions`, oldest first.
        path: of the page.
        methods: whose traffic is shown; (): all.

    Raises:
        InputError: no version has such a method.
    """
    newest = versions[-1]
    traffics = sorted(newest.traffic(), key=lambda traffic: not traffic[1])
    choices = dict.fromkeys(method for method, _ in traffics)
    if unknown := set(methods) - choices.keys():
        raise InputError(
            f"--method {min(unknown)}: not in {newest.run / TABLE}; choose among "
            f"{', '.join(choices)}"
        )
    sections = []
    lines = []
    table: list[list[object]] = []
    names = version_names([version.run for version in versions])
    for traffic in traffics:
        if methods and traffic[0] not in methods:
            continue
        histories = scene_histories(
            [scene_results(version.traffic().get(traffic, [])) for version in versions]
        )
        section = traffic_section(versions, names, traffic=traffic, histories=histories)
        sections.append(section)
        lines += [f"{section['title']}: {section['lines'][0]}", *section["lines"][1:]]
        for history in histories:
            letters = [result.kind if result else "" for result in history.results]
            table.append([history.scene, *traffic, history.change, *letters])
    title = f"History of {', '.join(dict.fromkeys(map(attrgetter('ego'), versions)))}"
    content: dict[str, Any] = {
        "versions": [
            about_version(version, name, path.parent)
            for version, name in zip(versions, names, strict=True)
        ],
        "kinds": KINDS,
        "traffics": sections,
        "notes": list(notes(versions)),
    }
    write_atomically(path, page(FOLDER / HISTORY, title, SCRIPTS, content))
    head = ["scene_id", "method", "eta", "change", *names]
    write_beside(path, ".csv", content=csv_text([head, *table]))
    title += f", {plural(len(versions), 'version')}, {names[0]} to {names[-1]}:"
    return paragraphs([title, *lines, *content["notes"], f"Scene by scene: {path}"])


def about_version(version: Driven, name: str, folder: Path) -> dict[str, Any]:
    """What the page says of a version: its name, ego, day and code; `page`: its failure
    report, from a folder, None where there is none."""
    code = read_provenance(version.run)["versions"][-1]
    modules = [key for key in code if key not in PLATFORM]
    texts = [f"{module} {code[module][:SHORT]}" for module in modules]
    if code["git"]:
        texts.append(f"e2rl {code['git'][:SHORT]}")
    report = version.run / PAGE
    address = os.path.relpath(report.resolve(), folder.resolve())
    written = (version.run / TABLE).stat().st_mtime
    return {
        "name": name,
        "ego": version.ego,
        "date": date.fromtimestamp(written).isoformat(),
        "code": ", ".join(texts),
        "page": quote(Path(address).as_posix()) if report.is_file() else None,
    }


def traffic_section(
    versions: Sequence[Driven],
    names: Sequence[str],
    *,
    traffic: Traffic,
    histories: Sequence[SceneHistory],
) -> dict[str, Any]:
    """What the page shows of a traffic: its title, lines, `rates` of each version,
    `groups` of scenes by their change, and the number of scenes that are `clear` of any
    contact. A key of a failure lacks the beginning that all of its version have,
    `prefixes`."""
    method, eta = traffic
    units = [version.units().get(traffic, []) for version in versions]
    rates = [version_rates(rows) for rows in units]
    keys = [
        [failure_key(history.results[number]) for history in histories]
        for number in range(len(versions))
    ]
    prefixes = [os.path.commonprefix(list(filter(None, column))) for column in keys]
    rows = {}
    for history, *links in zip(histories, *keys, strict=True):
        rows[history.scene] = [
            result
            and [
                result.kind,
                result.events,
                result.rollouts,
                key and key.removeprefix(prefix),
            ]
            for result, key, prefix in zip(
                history.results, links, prefixes, strict=True
            )
        ]
    clear = [history for history in histories if is_clear(history)]
    shown = [history for history in histories if not is_clear(history)]
    groups = {}  # the histories are sorted by what makes a title
    for title, group in groupby(shown, lambda history: group_title(history, names)):
        groups[title] = list(group)
    return {
        "title": f"{method}, intensity {eta:g}" if eta else method,
        "unit": versions[0].unit,
        "lines": [
            *changes_sentences(histories, names),
            *trend_sentences(units, names, rates=rates, unit=versions[0].unit),
        ],
        "rates": rates,
        "prefixes": prefixes,
        "groups": [
            {
                "title": title,
                "change": group[0].change,
                "rows": [[history.scene, rows[history.scene]] for history in group],
            }
            for title, group in groups.items()
        ],
        "clear": len(clear),
    }


def version_rates(rows: Sequence[dict]) -> dict[str, dict[str, Any]]:
    """Mean and interval of SHOWN of a version's units, and their `text`."""
    metrics = summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0) if rows else {}
    rates = {}
    for name, column in SHOWN.items():
        value = metrics.get(column, {"n": 0})
        text = UNKNOWN
        if value["n"]:
            text = estimate(METRICS[column], value, name="mean")
        if value["n"] and METRICS[column].fraction:
            text += f" ({round(value['mean'] * value['n'])} of {value['n']})"
        rates[name] = {"text": text, **value}
    return rates


def failure_key(result: SceneResult | None) -> str | None:
    """The name of the failure to watch; None where there is none."""
    return rollout_key(result.row) if result and is_failure(result.row) else None


def is_clear(history: SceneHistory) -> bool:
    """Whether nothing has happened in a scene in any version."""
    return all(result is None or result.kind == "·" for result in history.results)


# --- sentences


def group_title(history: SceneHistory, names: Sequence[str]) -> str:
    """What scenes have in common that stand together in the grid."""
    name = names[history.version]
    return {
        NEW: f"New in {name}",
        MENDED: f"Mended in {name}",
        FLICKERS: f"Come and go, last change in {name}",
        LASTS: f"Fail since {name}",
        ALWAYS: "Fail in all",
        NEVER: "Contacts, none of them a preventable failure",
    }[history.change]


def changes_sentences(
    histories: Sequence[SceneHistory], names: Sequence[str]
) -> Iterator[str]:
    """How many scenes broke and were mended in the newest version, and fail in all; then
    how many of each other history there are."""
    newest = len(names) - 1
    counts = Counter(history.change for history in histories)
    latest = [history for history in histories if history.version == newest]
    mended = sum(history.change == MENDED for history in latest)
    again = sum(history.change == FLICKERS and history.failing for history in latest)
    yield (
        f"new in {names[-1]}: {plural(counts[NEW], 'scene')}; mended in {names[-1]}: "
        f"{mended}; fails in all: {counts[ALWAYS]}."
    )
    others = {
        "mended before": counts[MENDED] - mended,
        "fails since a version between": counts[LASTS],
        "comes and goes": counts[FLICKERS],
        f"of these, fails again in {names[-1]}": again,
    }
    parts = [f"{text}: {count}; " for text, count in others.items() if count]
    text = f"{''.join(parts)}never fails: {counts[NEVER]} of {len(histories)}."
    yield text[0].upper() + text[1:]


def trend_sentences(
    units: Sequence[Sequence[dict]],
    names: Sequence[str],
    *,
    rates: Sequence[Mapping],
    unit: str,
) -> Iterator[str]:
    """Whether the newest version fails more rarely than the first, and than the one
    before it.

    Args:
        units: rows that rates are of, of each version.
        names: of the versions.
        rates: `version_rates` of each.
        unit: what rates are of.

    Yields:
        A sentence for each of the two.
    """
    newest = rates[-1]["preventable"]
    for number in sorted({0, len(names) - 2}):
        former = rates[number]["preventable"]
        if not (newest["n"] and former["n"]):
            continue
        change = difference(units[-1], units[number])[FAILED]
        points = estimate(METRICS[FAILED], change, name="difference", sign="+")
        outcome = "no change beyond chance"
        if math.isnan(change["low"]):
            outcome = "too few places to tell"
        elif change["high"] < 0:
            outcome = "fewer"
        elif change["low"] > 0:
            outcome = "more"
        yield (
            f"Preventable failures, {names[number]} to {names[-1]}: {outcome} "
            f"({per_cent(former['mean'])} to {per_cent(newest['mean'])} of {unit}, by "
            f"{points} points{', 95% interval' * points.endswith(']')})."
        )


def notes(versions: Sequence[Driven]) -> Iterator[str]:
    """What to know about the numbers."""
    if versions[0].searched:
        yield SEARCHED
    driven = Counter(key for version in versions for key in version.rollouts())
    if partly := sum(count < len(versions) for count in driven.values()):
        yield f"Not driven to an end by all versions: {partly} {versions[0].unit}."
    codes = {read_provenance(run.run)["versions"][-1]["e2rl"] for run in versions}
    if len(codes) > 1:
        yield (
            "The runs are of several versions of e2rl: what traffic does, and verdicts, "
            "may have changed, too."
        )
