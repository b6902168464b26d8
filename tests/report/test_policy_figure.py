"""The figure of policy improvement: a panel a metric, a bar for each traffic, as high as the paired change."""

import math

from e2rl.report.policy_figure import PANELS, policy_figure


def row(method, eta, change):
    paired = {
        name: {"relative": change, "relative_low": change - 0.1, "relative_high": change + 0.1} for name in PANELS
    }
    return {"ego": "after", "method": method, "eta": eta, "paired": {"ego before": paired}}


def test_a_bar_is_the_change_in_per_cent_and_of_the_synthesizer_s_own_traffic():
    rows = [row("nominal", 0, math.nan), row("e2", 1, -0.4), row("e2", 2, -0.5), row("cat", 2, 9.0)]
    figure = policy_figure(rows, "before", "after", "e2")
    assert len(figure.axes) == len(PANELS)
    for axes in figure.axes:
        heights = [bar.get_height() for bar in axes.patches]
        assert math.isnan(heights[0]) and heights[1:] == [-40.0, -50.0]
