"""What training changed, in per cent of the policy before it: the paper's four panels of policy improvement."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from e2rl.metrics.catalogue import METRICS
from e2rl.report import drawing
from e2rl.report.comparison_tables import by_ego
from e2rl.report.drawing import new_figure

PANELS = ("cfr", "min_dtc", "ttc_c", "macc")
SIDE, RISE, DPI = 260, 280, 144  # points: width and height of a panel


def policy_figure(rows: Sequence[dict], before: str, after: str, method: str) -> Figure:
    """Returns the change of PANELS from the ego `before` to `after`, with 95% intervals: a bar for nominal traffic and
    each intensity of `method`, none where there was nothing before to be a share of. rows: of metrics.json."""
    cells, traffic = by_ego([row for row in rows if row["method"] in ("nominal", method)], [after])
    figure = new_figure(SIDE * len(PANELS), RISE, DPI)
    figure.set_layout_engine("tight")
    for axes, name in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        found = [cells[after, label]["paired"][f"ego {before}"].get(name) or {} for label in traffic]
        ends = ("relative", "relative_low", "relative_high")
        change, *limits = 100 * np.array([[value.get(end, math.nan) for value in found] for end in ends])
        style = {"color": drawing.EGO, "ecolor": drawing.INK, "capsize": 3}
        axes.bar(range(len(traffic)), change, 0.6, yerr=np.nan_to_num(np.abs(limits - change)), **style)
        axes.axhline(0, color=drawing.INK, linewidth=0.8)
        axes.set_xticks(range(len(traffic)), traffic)
        axes.set_title(METRICS[name].about, fontsize="medium")
    figure.axes[0].set_ylabel(f"{after} against {before} [%]")
    return figure
