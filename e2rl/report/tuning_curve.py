"""What an adversary's tuning found: failures against realism over its gain, as CSV and as a picture."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from e2rl.evaluation.rollout_files import cell
from e2rl.report import drawing
from e2rl.report.drawing import save_figure
from e2rl.report.plots import plain_figure
from e2rl.run.files import write_atomically

PANELS = (("cfr", "failures [%]"), ("cfr_counted", "failures that count [%]"))
REALISM = "real_adv"
SIDE, RISE = 420, 340  # points: width and height of a panel


def save_tuning_curve(folder: Path, trials: Sequence[dict], method: str) -> None:
    """Write tuning_curve.csv, a line a trial in the order of the gain, and tuning_curve.png and .pdf."""
    write_atomically(folder / "tuning_curve.csv", curve_csv(trials))
    save_figure(folder / "tuning_curve.png", curve_figure(trials, method))


def gain_of(trial: dict) -> float:
    """Returns the first of the parameters: that whose curve is drawn."""
    return next(iter(trial["parameters"].values()))


def on_curve(trials: Sequence[dict]) -> list[dict]:
    """Returns the trials with all parameters but the gain as in the first, in the order of the gain."""
    others = [list(trial["parameters"].values())[1:] for trial in trials]
    return sorted((trial for trial, own in zip(trials, others, strict=True) if own == others[0]), key=gain_of)


def curve_csv(trials: Sequence[dict]) -> str:
    """Returns trial, parameters, whether it is on the curve and admissible, then its metrics; NaN is an empty cell."""
    drawn = on_curve(trials)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["trial", *trials[0]["parameters"], "on_curve", "admissible", *trials[0]["metrics"]])
    for trial in sorted(trials, key=gain_of):
        row = [trials.index(trial), *trial["parameters"].values(), trial in drawn, trial["admissible"]]
        writer.writerow(map(cell, [*row, *trial["metrics"].values()]))
    return buffer.getvalue()


def curve_figure(trials: Sequence[dict], method: str) -> Figure:
    """Returns a panel for each of PANELS: the curve over the gain with 95% intervals, the other trials as dots; hollow
    are trials that are refused."""
    figure, panels = plain_figure(SIDE * len(PANELS), RISE, len(PANELS))
    curve, gain = on_curve(trials), next(iter(trials[0]["parameters"]))
    for axes, (metric, title) in zip(panels, PANELS, strict=True):
        places = [(trial["metrics"][REALISM], 100 * trial["metrics"][metric]) for trial in trials]
        axes.plot(*zip(*(places[trials.index(trial)] for trial in curve), strict=True), color=drawing.EGO, linewidth=1)
        for trial, (x, y) in zip(trials, places, strict=True):
            on = trial in curve
            colour = drawing.EGO if on else drawing.BACKGROUND
            face = colour if trial["admissible"] else drawing.PANEL
            axes.plot(x, y, marker="o", markersize=5, color=colour, markerfacecolor=face, zorder=2 + on)
            if on and not math.isnan(x):
                low, high = (100 * trial["metrics"][f"{metric}_{end}"] for end in ("low", "high"))
                axes.vlines(x, low, high, color=drawing.EGO, linewidth=0.8, alpha=0.5)
                axes.annotate(f"{gain_of(trial):.2g}", (x, y), (4, 4), textcoords="offset points", fontsize=7)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(f"realism of the adversaries ({REALISM})")
        axes.set_ylim(bottom=0)
    figure.suptitle(f"{method}: {gain} written at its points; hollow: refused", fontsize=9)
    return figure
