"""Plots of numbers: collision rates of several egos as bars, and learning curves over environment steps."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from e2rl.metrics.catalogue import METRICS
from e2rl.report import drawing
from e2rl.report.comparison_tables import by_ego
from e2rl.report.drawing import new_figure
from e2rl.run.errors import InputError

COLOURS = (drawing.BACKGROUND, drawing.EGO, "#2e8b57", drawing.VULNERABLE, "#7a4fbf", drawing.ADVERSARY)
WIDTH, HEIGHT = 820, 440  # points, of the bars
SIDE, RISE, DPI = 380, 300, 144  # points: width and height of a panel of curves
STEPS = "train/frames"  # environment steps done at the end of a round
CURVES = (  # scalar, title, whether it was measured before the round's steps
    ("synthesizer/contact", "collisions, adversaries made anew [%]", True),
    ("train/contact_adversarial", "collisions, adversarial episodes [%]", False),
    ("train/contact_nominal", "collisions, nominal episodes [%]", False),
    ("train/progress_nominal", "progress, nominal episodes [m]", False),
)


def collision_bars(rows: Sequence[dict], names: Sequence[str], method: str) -> Figure:
    """`cfr` with its 95% interval as bars: a group for nominal traffic and each intensity of `method`, in each group a
    bar for each ego of `names`. rows: of metrics.json."""
    chosen = [row for row in rows if row["method"] in ("nominal", method)]
    cells, traffic = by_ego(chosen, names)
    figure, axes = plain_figure(WIDTH, HEIGHT, 1)
    width = 0.8 / len(names)
    for index, name in enumerate(names):
        found = [cells[name, label]["metrics"]["cfr"] for label in traffic]
        places = np.arange(len(traffic)) + (index - (len(names) - 1) / 2) * width
        means, *ends = 100 * np.array([[value[end] for value in found] for end in ("mean", "low", "high")])
        style = {"color": COLOURS[index % len(COLOURS)], "label": name, "yerr": np.nan_to_num(np.abs(ends - means))}
        error = {"ecolor": drawing.INK, "capsize": 3, "elinewidth": 1}
        axes[0].bar(places, means, 0.92 * width, error_kw=error, **style)
    axes[0].set_xticks(range(len(traffic)), traffic)
    axes[0].set_ylabel(f"{METRICS['cfr'].about} [%]")
    axes[0].set_ylim(bottom=0)
    axes[0].legend(frameon=False, ncols=len(names))
    return figure


def learning_curves(runs: Sequence[Path]) -> Figure:
    """Panels of CURVES that some run knows, over environment steps; a line for each run of train.py."""
    series = [read_curves(run) for run in runs]
    known = [curve for curve in CURVES if any(curve[0] in found for found in series)]
    figure, panels = plain_figure(SIDE * len(known), RISE, len(known))
    for axes, (name, title, _) in zip(panels, known, strict=True):
        for index, (run, found) in enumerate(zip(runs, series, strict=True)):
            if name in found:
                steps, values = found[name]
                scale = 100 if "[%]" in title else 1
                points = [step / 1e6 for step in steps], [scale * value for value in values]
                axes.plot(*points, color=COLOURS[(index + 1) % len(COLOURS)], marker="o", markersize=3, label=run.name)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("environment steps [million]")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
    panels[0].legend(frameon=False, fontsize=8)
    return figure


def read_curves(run: Path) -> dict[str, tuple[list[float], list[float]]]:
    """{scalar: (environment steps, values)} of CURVES that a run has logged, a point a round.

    Raises InputError for a folder without the log of steps of a learned policy.
    """
    logs = Path(run) / "logs" / "scalars"
    steps = read_scalar(logs / f"{STEPS}.csv")
    if not steps:
        raise InputError(f"{run}: no {STEPS} logged there; give the folder of a policy's train.py run with logger=csv")
    rounds = sorted(steps)
    earlier = dict(zip(rounds, [0.0, *(steps[number] for number in rounds[:-1])], strict=True))
    result = {}
    for name, _, before in CURVES:
        values, done = read_scalar(logs / f"{name}.csv"), earlier if before else steps
        if shared := sorted(values.keys() & done.keys()):
            result[name] = ([done[number] for number in shared], [values[number] for number in shared])
    return result


def read_scalar(path: Path) -> dict[int, float]:
    """{round: value} of a scalar's CSV file, the last value of a round that was done twice; {} without a file.

    Raises InputError for a file that is none.
    """
    if not path.is_file():
        return {}
    try:
        with path.open(newline="") as file:
            return {int(number): float(value) for number, value in csv.reader(file, strict=True)}
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: no log of a scalar ({error}); remove it, or restore it") from error


def plain_figure(width: float, height: float, panels: int, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure of rows with so many panels each, row by row, with light axes; size in points."""
    figure = new_figure(width, height, DPI)
    figure.set_layout_engine("tight")
    axes = list(figure.subplots(rows, panels, squeeze=False).flat)
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(axis="y", color=drawing.ROAD, linewidth=0.6)
        each.set_axisbelow(True)
    return figure, axes
