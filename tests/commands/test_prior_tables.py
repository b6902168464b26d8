"""The prior's tables and the figure of the skeleton, by the commands of their own."""

import sys

import pytest
from hydra.core.global_hydra import GlobalHydra

from e2rl.commands import prior_tables
from e2rl.evaluation.rollout_files import read_metrics
from e2rl.metrics.catalogue import META_STAGE, OPEN_LOOP_STAGE, SPREAD_STAGE, STAGES
from e2rl.report import skeleton_figure
from tests.scripts import SHORT

pytestmark = pytest.mark.slow


def run(command, folder, world, monkeypatch, *options):
    given = [
        *SHORT,
        f"data.cache={world / 'bundled'}",
        f"hydra.run.dir={folder}",
        "seeds=[0]",
        *options,
    ]
    monkeypatch.setattr(sys, "argv", ["e2rl", *given])
    try:
        command.main()
    finally:
        GlobalHydra.instance().clear()


def test_the_prior_s_tables_have_rows_of_all_stages(
    world, tmp_path, monkeypatch, capsys
):
    """Open loop, spread, closed loop and meta-metric of two scenes."""
    run(
        prior_tables,
        tmp_path / "run",
        world,
        monkeypatch,
        "open_loop_samples=2",
        "spread_samples=2",
        "meta_rollouts=2",
    )
    assert "bundled/tune, 2 scenes, 1 seed." in capsys.readouterr().out, (
        "the closed loop's, not the samples"
    )
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    found = {
        stage: [row for row in rows if row.get("stage") == stage]
        for stage in (*STAGES, None)
    }
    methods = ["replay", "constant_velocity", "idm", "nominal"]
    assert {
        stage: [row["method"] for row in part] for stage, part in found.items()
    } == {
        OPEN_LOOP_STAGE: methods[1:],
        META_STAGE: methods,
        SPREAD_STAGE: ["nominal"],
        None: methods,
    }
    for stage, metrics in STAGES.items():
        known = [metric.name for metric in metrics if metric.name != "real_split_half"]
        assert all(set(known) <= set(row["metrics"]) for row in found[stage])
    meta = {
        row["method"]: row["metrics"]["meta_metric"]["mean"]
        for row in found[META_STAGE]
    }
    assert (
        max(meta, key=meta.get) == "replay"
        and "real_split_half" in found[META_STAGE][0]["metrics"]
    )
    assert found[None][0]["metrics"]["real"]["mean"] == 1, (
        "the replayed log is wholly like itself"
    )
    text = (tmp_path / "run" / "tables.md").read_text()
    assert all(
        word in text
        for word in (
            "min_ade_5",
            "meta_metric",
            "cfr_bg",
            "nominal",
            "constant_velocity",
        )
    )


def test_the_skeleton_is_drawn(world, tmp_path, monkeypatch, capsys):
    run(skeleton_figure, tmp_path / "run", world=world, monkeypatch=monkeypatch)
    drawn = {
        path.name
        for path in (tmp_path / "run").glob("*.p*")
        if path.suffix in (".png", ".pdf")
    }
    assert drawn == {
        f"{name}.{suffix}"
        for name in ("skeleton", "anchoring")
        for suffix in ("png", "pdf")
    }
