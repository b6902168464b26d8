"""`e2rl cross` on two short bundled scenes."""

import json
import shutil

import pytest

from e2rl.commands.export import main as export
from e2rl.evaluation.attack_set import AttackSet
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.evaluation.transfer import CROSS_FILE
from e2rl.report.html import CHOSEN, PAGE
from tests.report.test_html import data_of
from tests.scripts import SHORT, call, error_line

EGOS = [
    "+egos.fast={ego: class, _target_: tests.planners.planners.Faster}",
    "+egos.lane_graph={ego: lane_graph}",
]
SMALL = [
    *EGOS,
    "num_scenes=null",
    "data.build.steps=25",
    "methods=[nominal]",
    "tries=1",
    "seeds=[0,1]",
    "keep=hit",
    "processes=1",
]
CONTACT = ("scene_id", "cfr", "contact_step", "partner", "cfr_preventable", "duty")


@pytest.fixture
def cross(tmp_path, monkeypatch, capsys):
    """Runs the command; returns its error, or nothing."""
    scenes = tmp_path / "scenes.csv"
    scenes.write_text("scene_id\ncurved_road_023_0280\npriority_cross_040_0720\n")

    def run(*options):
        if not any(option.startswith("resume") for option in options):
            options = [*SHORT, *SMALL, f"scenes={scenes}", *options]
        status, output = call(
            "e2rl/commands/cli.py",
            ["cross", *options],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        assert status in (0, 2), output
        return error_line(output) if status else ""

    return run


def test_failures_found_are_driven_by_all_resumed_and_carried(cross, tmp_path):
    run = tmp_path / "run"
    assert not cross(f"hydra.run.dir={run}", "again=true")
    found = [row for row in read_rows(run / "found" / TABLE) if row["cfr"] == 1]
    crossed = read_rows(run / TABLE)
    assert found
    for mode in ("against", "again"):  # with the same noise it is the same attack
        for name in {row["ego_policy"] for row in found}:
            expected = [row for row in found if row["ego_policy"] == name]
            result = [
                row
                for row in crossed
                if (row["method"], row["ego_policy"]) == (f"{mode}-{name}", name)
            ]
            result.sort(key=lambda row: row["seed"])
            for column in CONTACT:
                assert [row[column] for row in result] == [
                    row[column] for row in expected
                ]
    content = (run / CROSS_FILE).read_bytes()
    matrix = json.loads(content)
    own = [cell for cell in matrix["cells"] if cell["ego"] == cell["set"] != ""]
    assert {cell["hit"]["mean"] for cell in own} == {1}
    assert "#group=against-" in (run / PAGE).read_text()
    assert (run / "cross.png").stat().st_size
    assert "| others" in (run / "cross.md").read_text()

    shutil.rmtree(run / "parts" / "crossed")
    (run / CROSS_FILE).unlink()
    assert not cross(f"resume={run}", "plugins=[tests.planners.planners]")
    assert (run / CROSS_FILE).read_bytes() == content

    groups = data_of((run / PAGE).read_text())["groups"]
    assert all(group["plain"] is None for group in groups), "chosen failures: no rate"
    assert all(group["summary"][-1] == CHOSEN for group in groups)
    export([str(run), "--to", "attacks"])
    hits = [row for row in crossed if row["cfr"] == 1 and row["ego_policy"] == "fast"]
    exported = AttackSet.read(run / "export" / "attacks" / "fast.attacks")
    assert len(exported.rows) == len(hits)

    files = sorted((run / "attacks").iterdir())
    carried = tmp_path / "carried"
    names = ",".join(map(str, files))
    assert not cross(f"hydra.run.dir={carried}", f"attacks=[{names}]")
    replayed = [cell for cell in matrix["cells"] if cell["mode"] == "replay"]
    result = json.loads((carried / CROSS_FILE).read_text())["cells"]
    order = ("set", "ego")
    for cells in (result, replayed):
        cells.sort(key=lambda cell: [cell[name] for name in order])
    assert result == replayed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["keep=scratches"], "keep=scratches: choose one of preventable, hit, all"),
        (["keep=all", "again=true"], "again=true: makes failures anew"),
        (["shard=[0,2]"], "shard=[0, 2]: e2rl cross does not use it"),
        (["reproduce=RUN"], "reproduce=RUN: e2rl cross does not use it"),
        (["attacks=[nowhere.attacks]"], "nowhere.attacks: no set of attacks"),
        (
            ["data.build.steps=5", "seeds=[0]"],
            "keep=hit: no such rollout of fast, lane_graph",
        ),
    ],
)
def test_what_cannot_be_crossed_is_refused(cross, tmp_path, options, message):
    assert message in cross(f"hydra.run.dir={tmp_path / 'run'}", *options)
