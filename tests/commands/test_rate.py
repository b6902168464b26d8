"""`e2rl rate` on two short bundled scenes, and the gate on what it writes."""

import csv
import json

import pytest

from tests.scripts import SHORT, call, error_line

SMALL = [
    "rate.first=8",
    "rate.particles=8",
    "rate.rollouts=16",
    "rate.repetitions=2",
    "rate.target=contact",
    "processes=1",
]
TRUSTED = "plugins=[tests.planners.planners]"


@pytest.fixture
def rate(tmp_path, monkeypatch, capsys):
    """Runs the command in a folder of its own; returns it, or if `wrong` the error."""
    folder = tmp_path / "run"

    def run(*options, wrong=False):
        options = [*SHORT, *SMALL, f"hydra.run.dir={folder}", *options]
        status, output = call(
            "e2rl/commands/cli.py",
            ["rate", *options],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        assert status == (2 if wrong else 0), output
        return error_line(output) if wrong else folder

    return run


def test_two_egos_are_rated_gated_and_reported(rate, tmp_path, monkeypatch, capsys):
    scenes = tmp_path / "scenes.csv"
    scenes.write_text("scene_id\ncurved_road_023_0280\npriority_cross_040_0720\n")
    run = rate(
        "+egos.a={ego: class, _target_: tests.planners.planners.Faster}",
        "+egos.b={ego: lane_graph}",
        f"scenes={scenes}",
        "num_scenes=null",
        "data.build.steps=25",
    )
    entries = json.loads((run / "rates.json").read_text())
    assert [entry["ego"] for entry in entries] == ["a", "b"]
    assert all(len(entry["scenes"]) == 2 for entry in entries)
    assert "ratio per km" in (run / "rates.md").read_text()
    with (run / "tail.csv").open() as file:
        weights = {}
        for row in csv.DictReader(file):
            key = (row["ego_policy"], row["scene_id"])
            weights[key] = weights.get(key, 0) + float(row["weight"])
    for entry in entries:
        for scene in entry["scenes"]:
            weight = weights.get((entry["ego"], scene["scene_id"]), 0)
            assert weight == pytest.approx(scene["probability"])
    parts = {part.name.split("-")[0] for part in (run / "parts").iterdir()}
    assert parts == {"a", "b"}  # none in another's place, so that the run can go on
    page = (run / "failures.html").read_text()
    assert "contacts per 1,000 km" in page
    for command, expected in (
        (["gate", str(run), "--ego", "a", "contact_per_scene<=1"], 3),  # two places
        (["report", str(run), "--out", str(run / "again.html")], 0),
        (["replay", str(run), "--failures", "1"], 0),
        (["export", str(run), "--to", "scenarionet"], 0),
        (["evaluate", f"resume={run}", TRUSTED], 2),
        (["evaluate", f"reproduce={run}", TRUSTED], 2),
    ):
        status, output = call(
            "e2rl/commands/cli.py", command, monkeypatch=monkeypatch, capsys=capsys
        )
        assert status == expected, output
        if command[0] == "evaluate":
            assert "is a run of another command, which has rate; it began as" in output
    assert (run / "again.html").read_text() == page


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("methods=[nominal,e2]", "methods=[nominal, e2]: rates are of the prior's own"),
        ("methods=[search]", "methods=[search]: rates are of the prior's own traffic"),
        ("tries=3", "tries=3: rollouts are rate.rollouts"),
        ("seeds=[0,1]", "one seed gives all draws"),
        ("rate.target=scratch", "rate.target=scratch"),
        ("rate.killed=1.5", "rate.killed=1.5"),
        ("rate.first=7", "rate.first=7: fewer than rate.particles=8"),
        ("rate.rollouts=0", "error: rate.rollouts=0: expected"),
        ("shard=[0,2]", "shard=[0, 2]: e2rl rate does not use it"),
        ("reproduce=RUN", "reproduce=RUN: e2rl rate does not use it"),
    ],
)
def test_what_cannot_be_rated_is_refused(rate, option, message):
    assert message in rate(option, wrong=True)


def test_without_rollouts_there_is_no_page(rate, tmp_path):
    scenes = tmp_path / "scenes.csv"
    scenes.write_text("scene_id\npriority_cross_040_0720\n")
    run = rate(
        "+egos.a={ego: class, _target_: tests.planners.planners.Faster}",
        f"scenes={scenes}",
        "num_scenes=null",
        "data.build.steps=25",
        "save_rollouts=false",
    )
    assert (run / "rates.md").exists()
    assert len((run / "tail.csv").read_text().splitlines()) > 1, "it failed"
    assert not (run / "failures.html").exists()
    assert not (run / "rollouts").exists()
