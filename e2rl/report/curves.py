"""Failures against realism and against verdicts over the gain of each adversary, as CSV
and as a picture.

The strength of an attack is its gain times eta. So its curve is a run of several
intensities (`evaluate.py experiment=curves`), or the sweep of its tuning (`e2rl tune`).
`e2rl curves RUN_DIR...` draws both kinds together.
"""

import argparse
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from e2rl.evaluation.rollout_files import (
    METRICS_FILE,
    NUMBER,
    cell,
    nans,
    read_json,
    read_metrics,
)
from e2rl.evaluation.tuning import TUNING_FILE
from e2rl.metrics.catalogue import METRICS
from e2rl.report import drawing
from e2rl.report.drawing import new_figure, save_figure
from e2rl.report.tables import closed_loop, heading
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, misfit, write_atomically
from e2rl.run.run import read_provenance
from e2rl.sim.rollout_file import UNPRINTABLE

PANELS = (  # (horizontal, vertical): failures over realism, then what they are worth
    (("real", "cfr"), ("real_adv", "cfr"), ("aor_step", "cfr")),
    (
        ("cfr", "cfr_preventable"),
        ("real_adv", "cfr_preventable"),
        ("cfr", "cfr_counted"),
    ),
)
COLUMNS = (
    "cfr",
    "cfr_preventable",
    "cfr_clean",
    "cfr_counted",
    "real",
    "real_adv",
    "aor_step",
    "cfr_bg",
    "nfe",
)
OURS = "e2"
NOMINAL = "nominal"
COLOURS = {OURS: drawing.ADVERSARY, NOMINAL: drawing.INK}  # what stands out
APART = [
    f"C{number}" for number in (0, 1, 2, 4, 5, 6, 7, 8, 9)
]  # for the others: the cycle's red is too near to ours
TABLES_ETA = 2.0  # intensity of the tables
SIDE, RISE, DPI = 380, 330, 144  # points: width and height of a panel
NAME = "curves"
TUNING = {
    "best": (dict, NoneType),
    "trials": [{"parameters": {...: (int, float)}, "metrics": {...: NUMBER}}],
}


class Point(NamedTuple):
    """Rollouts of a method at one value of its dial; metrics: {name: {mean, low, high}}
    of some of COLUMNS, NaN where unknown; on_curve: nothing but the dial differs from
    the others on the curve; chosen: the setting of the tables.
    """

    method: str
    dial: str
    value: float
    on_curve: bool
    chosen: bool
    metrics: Mapping[str, Mapping[str, float]]


def points_of_rows(rows: Sequence[dict]) -> list[Point]:
    """The points of the closed-loop rows of metrics.json; the dial is eta, 0 for
    traffic without an adversary."""
    return [
        Point(
            row["method"],
            "eta",
            value=row["eta"],
            on_curve=True,
            chosen=row["eta"] in (0, TABLES_ETA),
            metrics=row["metrics"],
        )
        for row in closed_loop(rows)
    ]


def points_of_tuning(result: Mapping, method: str) -> list[Point]:
    """The points of tuning.json: the trials that differ from the first in the gain
    alone, which is the first of the parameters; the best trial; and the nominal traffic
    beside them."""
    first = result["trials"][0]
    best = result["best"]
    dial, *others = first["parameters"]
    points: list[Point] = []
    for trial in result["trials"]:
        on_curve = all(
            trial["parameters"][name] == first["parameters"][name] for name in others
        )
        chosen = trial["parameters"] == best and not any(
            point.chosen for point in points
        )
        if on_curve or chosen:
            found = intervals(trial["metrics"])
            points.append(
                Point(
                    method,
                    dial,
                    value=trial["parameters"][dial],
                    on_curve=on_curve,
                    chosen=chosen,
                    metrics=found,
                )
            )
    nominal = {
        name: first["metrics"].get(f"{name} {NOMINAL}", math.nan) for name in COLUMNS
    }
    return [
        *points,
        Point(
            NOMINAL,
            dial,
            value=0.0,
            on_curve=True,
            chosen=True,
            metrics=intervals(nominal),
        ),
    ]


def intervals(metrics: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """{name: {mean, low, high}} of NAME, NAME_low and NAME_high of a trial."""
    return {
        name: {
            "mean": metrics[name],
            **{end: metrics.get(f"{name}_{end}", math.nan) for end in ("low", "high")},
        }
        for name in COLUMNS
        if name in metrics
    }


def read_points(run: Path) -> list[Point]:
    """The points of a run's folder; InputError where it holds neither tuning.json nor
    metrics.json."""
    file = Path(run) / TUNING_FILE
    if not os.path.lexists(file):
        return points_of_rows(read_metrics(Path(run) / METRICS_FILE))
    result = read_json(file, wrong_tuning)
    known = read_provenance(run)["settings"].get("synthesizer")
    if misfit(known, {"name": str}) or UNPRINTABLE.search(known["name"]):
        raise InputError(
            f"{file}: no tuning of an adversary; give the folder of a run of e2rl tune"
        )
    trials = [trial | {"metrics": nans(trial["metrics"])} for trial in result["trials"]]
    return points_of_tuning(result | {"trials": trials}, known["name"])


def wrong_tuning(found: Any) -> str | None:
    """What in the content of a tuning.json is not as it is written; None: nothing."""
    if wrong := misfit(found, TUNING):
        return wrong
    names = [list(trial["parameters"]) for trial in found["trials"]]
    return (
        None
        if names and names[0] and names.count(names[0]) == len(names)
        else "its trials have other parameters"
    )


def curves_csv(points: Sequence[Point]) -> str:
    """A line a point, by method and value: each of COLUMNS with its 95% interval; NaN
    is an empty cell."""
    ends = ("mean", "low", "high")
    names = [
        name if end == "mean" else f"{name}_{end}" for name in COLUMNS for end in ends
    ]
    lines: list[Iterable] = [["method", "dial", "value", "on_curve", "chosen", *names]]
    for point in chain(*by_method(points).values()):
        found = [
            point.metrics.get(name, {}).get(end, math.nan)
            for name in COLUMNS
            for end in ends
        ]
        lines.append(map(cell, [*point[:5], *found]))
    return csv_text(lines)


def by_method(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Each method's points in the order of their values; of the nominal traffic of
    several tunings the first."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(point.method, []).append(point)
    found[NOMINAL] = found.get(NOMINAL, [])[:1]
    return {
        name: sorted(each, key=lambda point: point.value)
        for name, each in found.items()
        if each
    }


def curves_figure(points: Sequence[Point]) -> Figure:
    """PANELS, with a line a method: dots grow with the gain, the chosen setting is
    filled and has its intervals."""
    figure = new_figure(SIDE * len(PANELS[0]), RISE * len(PANELS), dpi=DPI)
    methods = by_method(points)
    figure.set_layout_engine("tight")
    panels = figure.subplots(len(PANELS), len(PANELS[0])).ravel()
    for axes, (across, up) in zip(
        panels, (pair for row in PANELS for pair in row), strict=True
    ):
        for number, (name, own) in enumerate(methods.items()):
            draw_curve(
                axes,
                own,
                across=across,
                up=up,
                colour=COLOURS.get(name, APART[number % len(APART)]),
            )
        if up != "cfr" and across == "cfr":
            most = max(axes.get_xlim()[1], axes.get_ylim()[1])
            axes.plot(
                [0, most],
                [0, most],
                color=drawing.MUTED,
                linewidth=0.8,
                linestyle="dotted",
            )
        axes.set_xlabel(heading(METRICS[across]))
        axes.set_ylabel(heading(METRICS[up]))
        axes.set_ylim(bottom=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=drawing.ROAD, linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].legend(frameon=False, fontsize=7)
    figure.suptitle(
        "A dot a gain, larger dots for larger gains; filled: the setting of the tables, with 95% intervals"
    )
    return figure


def draw_curve(
    axes: Axes, points: Sequence[Point], across: str, up: str, colour: str
) -> None:
    """One method's line, dots and intervals."""

    def at(point: Point, name: str, end: str = "mean") -> float:
        return (100 if METRICS[name].fraction else 1) * point.metrics.get(name, {}).get(
            end, math.nan
        )

    line = [point for point in points if point.on_curve]
    places = [[at(point, name) for point in line] for name in (across, up)]
    axes.plot(
        *places,
        color=colour,
        linewidth=1.8 if points[0].method == OURS else 1,
        label=points[0].method,
    )
    for rank, point in enumerate(points):
        x = at(point, across)
        y = at(point, up)
        face = colour if point.chosen else drawing.PANEL
        axes.plot(
            x,
            y,
            "o",
            markersize=3 + 5 * (rank + 1) / len(points),
            color=colour,
            markerfacecolor=face,
            zorder=3,
        )
        if point.chosen:
            axes.vlines(
                x,
                at(point, up, "low"),
                at(point, up, "high"),
                color=colour,
                linewidth=0.7,
                alpha=0.6,
            )
            axes.hlines(
                y,
                at(point, across, "low"),
                at(point, across, "high"),
                color=colour,
                linewidth=0.7,
                alpha=0.6,
            )


def save_curves(folder: Path, points: Sequence[Point]) -> list[Path]:
    """Write curves.csv and curves.png (and .pdf) into a folder; returns their paths."""
    table = Path(folder) / f"{NAME}.csv"
    picture = Path(folder) / f"{NAME}.png"
    write_atomically(table, curves_csv(points))
    save_figure(picture, curves_figure(points))
    return [table, picture]


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="e2rl curves", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="of experiment=curves or of e2rl tune",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        help="folder to write to (default: the current one)",
    )
    options = parser.parse_args(arguments)
    with ending():
        points = [point for run in options.runs for point in read_points(run)]
        print(*save_curves(options.out, points), sep="\n")
