"""What training gained: the paper's four panels of policy improvement, as gains over
the policy before it."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from e2rl.report import drawing
from e2rl.report.drawing import new_figure

PANELS = {  # by metric: title, and whether more (1) or less (-1) of it is a gain
    "cfr": ("(a) failure rate", -1),
    "min_dtc": ("(b) Min-DTC", 1),
    "ttc_c": ("(c) TTC-cost", -1),
    "macc": ("(d) mean acceleration", -1),
}
SIDE = 300  # points, width of a panel
RISE = 220  # points, height of a panel
DPI = 144
NAME = "policy_learning.png"


def policy_figure(rows: Sequence[dict], before: str, after: str, method: str) -> Figure:
    """Returns the gain of the ego `after` over `before` in PANELS, in per cent of
    `before`, with 95% intervals.

    A group of bars a split, a bar for each intensity of `method`; none where there was
    nothing before to be a share of.

    Args:
        rows: of metrics.json, of one split or several; those of other egos and traffic
            are left out.
        before: name of an ego.
        after: name of an ego whose rows are paired with it.
        method: of the attack.
    """
    key = f"ego {before}"
    changes = {
        (f"{row['dataset']}/{row['split']}", row["eta"]): row["paired"][key]
        for row in rows
        if (row["ego"], row["method"]) == (after, method)
        and row["eta"]
        and key in row["paired"]
    }
    splits = list(dict.fromkeys(split for split, _ in changes))
    etas = list(dict.fromkeys(eta for _, eta in changes))
    figure = new_figure(2 * SIDE, 2 * RISE, dpi=DPI)
    figure.set_layout_engine("tight")
    for axes, (name, (title, sign)) in zip(
        figure.subplots(2, 2).ravel(), PANELS.items(), strict=True
    ):
        for place, eta in enumerate(etas):
            estimates = [
                changes.get((split, eta), {}).get(name, {}) for split in splits
            ]
            gain, *limits = (
                100
                * sign
                * np.array(
                    [
                        [estimate.get(end, math.nan) for estimate in estimates]
                        for end in ("relative", "relative_low", "relative_high")
                    ]
                )
            )
            reach = np.nan_to_num(np.abs(np.array(limits[::sign]) - gain))
            width = 0.8 / len(etas)
            axes.bar(
                np.arange(len(splits)) + (place - (len(etas) - 1) / 2) * width,
                gain,
                0.9 * width,
                yerr=reach,
                label=f"η = {eta:g}",
                color=(drawing.EGO, (place + 1) / len(etas)),
                ecolor=drawing.INK,
                capsize=3,
            )
        axes.axhline(0, color=drawing.INK, linewidth=0.8)
        axes.set_xticks(range(len(splits)), splits)
        better = "more" if sign > 0 else "less"
        axes.set_title(f"{title}: {better} is a gain", fontsize="medium")
        axes.set_ylabel(f"gain over {before} [%]")
    if changes:
        figure.axes[0].legend(frameon=False)
    return figure
