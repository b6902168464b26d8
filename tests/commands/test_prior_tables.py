"""The prior's tables and the figure of the skeleton, by the commands of their own."""

import sys

import pytest
from hydra.core.global_hydra import GlobalHydra

from e2rl.commands import prior_tables, skeleton
from e2rl.evaluation.rollout_files import read_metrics
from e2rl.metrics.catalogue import SPREAD_STAGE, STAGES
from tests.scripts import SHORT

pytestmark = pytest.mark.slow


def run(command, folder, world, monkeypatch, options=()):
    arguments = [
        *SHORT,
        f"data.cache={world / 'bundled'}",
        f"hydra.run.dir={folder}",
        "seeds=[0]",
        *options,
    ]
    monkeypatch.setattr(sys, "argv", ["e2rl", *arguments])
    try:
        command.main()
    finally:
        GlobalHydra.instance().clear()


def test_the_prior_s_tables_have_rows_of_all_stages(
    world, tmp_path, monkeypatch, capsys
):
    """Spread and closed loop of two scenes."""
    folder = tmp_path / "run"
    run(
        prior_tables,
        folder,
        world=world,
        monkeypatch=monkeypatch,
        options=["spread_samples=2"],
    )
    printed = capsys.readouterr().out
    assert "bundled/tune, 2 scenes, 1 seed." in printed, "the closed loop's"
    rows = read_metrics(folder / "metrics.json")
    closed_loop = {
        row["method"]: row["metrics"] for row in rows if row.get("stage") is None
    }
    (spread,) = [row for row in rows if row.get("stage") == SPREAD_STAGE]
    assert list(closed_loop) == ["replay", "constant_velocity", "idm", "nominal"]
    assert closed_loop["replay"]["real"]["mean"] == 1, "the log is wholly like itself"
    assert spread["method"] == "nominal"
    assert set(spread["metrics"]) == {metric.name for metric in STAGES[SPREAD_STAGE]}
    text = (folder / "tables.md").read_text()
    for word in ("knot_variance", "cfr_bg", "nominal", "constant_velocity"):
        assert word in text


def test_the_skeleton_is_drawn(world, tmp_path, monkeypatch, capsys):
    run(skeleton, tmp_path / "run", world=world, monkeypatch=monkeypatch)
    drawn = {
        path.name
        for path in (tmp_path / "run").glob("*.p*")
        if path.suffix in (".png", ".pdf")
    }
    assert drawn == {"skeleton.png", "skeleton.pdf"}
