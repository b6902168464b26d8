"""What training gained: the paper's four panels of policy improvement, as gains over
the policy before it.

`e2rl policy-figure RUN_DIR...` draws runs of experiment=policy_learning on several
splits, as tune and test, as one.
"""

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
SIDE, RISE, DPI = 300, 220, 144  # points: width and height of a panel
NAME = "policy_learning.png"


def policy_figure(rows: Sequence[dict], before: str, after: str, method: str) -> Figure:
    """Returns the gain of the ego `after` over `before` in PANELS, in per cent of
    `before`, with 95% intervals.

    A group of bars a split, a bar for each intensity of `method`; none where there was
    nothing before to be a share of.

    Args:
        rows: of metrics.json, of one split or several; those of other egos and traffic
            are left out.
    """
    key = f"ego {before}"
    own = [
        row
        for row in rows
        if (row["ego"], row["method"]) == (after, method)
        and row["eta"]
        and key in row["paired"]
    ]
    splits, etas = (
        {pick(row): None for row in own} for pick in (split_of, lambda row: row["eta"])
    )
    figure = new_figure(2 * SIDE, 2 * RISE, dpi=DPI)
    figure.set_layout_engine("tight")
    for axes, (name, (title, sign)) in zip(
        figure.subplots(2, 2).ravel(), PANELS.items(), strict=True
    ):
        for place, eta in enumerate(etas):
            found = {
                split_of(row): row["paired"][key].get(name) or {}
                for row in own
                if row["eta"] == eta
            }
            ends = ("relative", "relative_low", "relative_high")
            values = [
                [found.get(split, {}).get(end, math.nan) for split in splits]
                for end in ends
            ]
            gain, *limits = 100 * sign * np.array(values, dtype=float)
            reach = np.nan_to_num(np.abs(np.array(limits[::sign]) - gain))
            width = 0.8 / len(etas)
            style = {
                "color": (drawing.EGO, (place + 1) / len(etas)),
                "ecolor": drawing.INK,
                "capsize": 3,
            }
            at = np.arange(len(splits)) + (place - (len(etas) - 1) / 2) * width
            axes.bar(at, gain, 0.9 * width, yerr=reach, label=f"η = {eta:g}", **style)
        axes.axhline(0, color=drawing.INK, linewidth=0.8)
        axes.set_xticks(range(len(splits)), splits)
        axes.set_title(
            f"{title}: {'more' if sign > 0 else 'less'} is a gain", fontsize="medium"
        )
        axes.set_ylabel(f"gain over {before} [%]")
    if own:
        figure.axes[0].legend(frameon=False)
    return figure


def split_of(row: dict) -> str:
    return f"{row['dataset']}/{row['split']}"
