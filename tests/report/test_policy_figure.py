"""The figure of policy improvement: a panel a metric, a bar for each split and
intensity, as high as the gain."""

import json
import math

import pytest

from e2rl.commands import policy_figure as module
from e2rl.report.policy_figure import PANELS, policy_figure


def row(method, eta, change, split="tune"):
    paired = {
        name: {
            "relative": change,
            "relative_low": change - 0.1,
            "relative_high": change + 0.2,
        }
        for name in PANELS
    }
    about = {"ego": "after", "dataset": "waymo", "split": split}
    return about | {"method": method, "eta": eta, "paired": {"ego before": paired}}


def test_a_bar_is_the_gain_in_per_cent_of_a_split_and_intensity_with_its_interval():
    rows = [
        row("nominal", 0, change=-0.9),
        row("e2", 1, change=-0.4),
        row("e2", 2, change=-0.5),
        row("cat", 2, change=9.0),
    ]
    rows += [
        row("e2", 1, change=math.nan, split="test"),
        row("e2", 2, change=-0.3, split="test"),
    ]
    figure = policy_figure(rows, "before", after="after", method="e2")
    assert len(figure.axes) == len(PANELS)
    for axes, (_, sign) in zip(figure.axes, PANELS.values(), strict=True):
        tune_1, test_1, tune_2, test_2 = (bar.get_height() for bar in axes.patches)
        assert [tune_1, tune_2, test_2] == pytest.approx(
            [-40 * sign, -50 * sign, -30 * sign]
        )
        assert math.isnan(test_1)
        (bars,) = [
            drawn.lines[2][0] for drawn in axes.containers[:1]
        ]  # limits of the first intensity
        segment = bars.get_segments()[
            0
        ]  # a change of 10 points less to 20 more, mirrored where less is a gain
        assert sorted(segment[:, 1]) == pytest.approx(sorted([sign * -50, sign * -20]))
        assert [label.get_text() for label in axes.get_xticklabels()] == [
            "waymo/tune",
            "waymo/test",
        ]


def test_the_command_joins_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(
        module, "read_metrics", lambda path: json.loads(path.read_text())
    )
    for split in ("tune", "test"):
        (tmp_path / split).mkdir()
        (tmp_path / split / "metrics.json").write_text(
            json.dumps([row("e2", 2, change=-0.5, split=split)])
        )
    module.main(
        [str(tmp_path / "tune"), str(tmp_path / "test"), "--out", str(tmp_path)]
    )
    assert (tmp_path / "policy_learning.png").exists()


def test_runs_without_such_rows_are_told_and_drawn_empty(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        module, "read_metrics", lambda path: [row("e2", 2, change=-0.5)]
    )
    assert (
        not policy_figure(
            [row("e2", 2, change=-0.5)], "before", after="after", method="cat"
        )
        .axes[0]
        .patches
    )
    with pytest.raises(SystemExit):
        module.main([str(tmp_path), "--method", "cat"])
    assert "no rows of after after before under cat" in capsys.readouterr().err
