"""The headline: counted once from the rows, and the same number wherever a reader meets
it."""

import csv
import json
import os
import re
import subprocess
import sys

import pytest

from e2rl.evaluation.rollout_files import METRICS_FILE, TABLE, read_metrics, read_rows
from e2rl.evaluation.summary import headline
from e2rl.metrics.errored import errored_row
from e2rl.report.answer import errored_lines, headline_text, touched_lines
from e2rl.search.tries import TRIES
from tests.evaluation.constructed_runs import row_of
from tests.scripts import ROOT

PLANNER = """
from e2rl.planners.lane_graph_planner import LaneGraphEgo


class Fragile(LaneGraphEgo):
    def plan(self, world):
        fast = (world.scene["start"][:, 0, 3] - 10.45).abs() < 0.01
        if bool(fast.any() and (world.step > 20).any()):
            raise RuntimeError("no feasible trajectory")
        return super().plan(world)
"""
SMALL = [
    "num_scenes=4",
    "data.build.steps=40",
    "prior.sampler.steps=2",
    "seeds=[0]",
    "tries=2",
    "processes=1",
    "data.workers=1",
    "compile=false",
]


def errored(scene, seed=0, raised_by="ego", detail="lane"):
    return errored_row(
        row_of(scene, seed)
        | {"reason": "raised KeyError", "detail": detail, "raised_by": raised_by}
    )


def test_scenes_count_once_however_often_they_fail_and_errors_stand_apart():
    rows = [row_of(0, seed, hit=True) for seed in range(3)] + [
        row_of(1),
        row_of(2, hit={"cfr_preventable": 0.0}),
    ]
    rows += [
        errored(2, 1),
        errored(3),
        errored(4, raised_by="traffic"),
        row_of(5, hit={"approach": "rear"}),
    ]
    counts = headline(rows, searched=False)
    assert (counts.scenes, counts.preventable, counts.raised, counts.failed) == (
        5,
        2,
        2,
        4,
    )
    assert headline_text(counts, "a", traffic="e2") == (
        "a under e2: preventable failures, or it raised, in 4 of 5 scenes; preventable "
        "failures in 2 of 5, in 2 ways; "
        "it raised in 2 of 5."
    )
    whole = headline_text(headline(rows[:5], searched=False), "a", traffic="e2")
    assert whole == "a under e2: preventable failures in 1 of 3 scenes, in 1 way."


def test_tries_are_counted_a_scene_and_search():
    rows = [
        row_of(scene, seed * TRIES + k, nfe=100.0)
        for scene in range(4)
        for seed in range(2)
        for k in range(3)
    ]
    counts = headline(rows + [errored(0, 3)], searched=True)
    assert (counts.searches, counts.tries, counts.nfe) == (2, 25 / 8, 300.0)


@pytest.mark.parametrize("named", [0, 2])
def test_every_errored_rollout_is_named_or_counted(named):
    rows = [row_of(k) for k in range(5)] + [
        errored(k // 2, k % 2, detail=f"lane {k % 8 // 2}") for k in range(24)
    ]
    text = " ".join(errored_lines(rows, named))
    assert "The planner raised in 24 of 29 rollouts" in text
    for k in range(12):
        assert (f"scene_{k} (seeds 0, 1)" in text) == (
            not named or k in (0, 1, 2, 4, 5, 6)
        )
    assert text.count("and 1 other scene in errored.json") == (3 if named else 0)
    assert ("and 1 other message in errored.json" in text) == bool(named)


def test_people_and_objects_are_told_by_traffic_and_kind():
    rows = [row_of(k, cfr_vru=float(k < 2)) for k in range(3)] + [
        errored(3),
        errored(4, raised_by="traffic"),
    ]
    assert touched_lines(rows[2:]) == []
    assert touched_lines(rows) == [
        "a touched a pedestrian or cyclist in 2 of 3 rollouts under e2 at η=2: "
        "scene_0 (seed 0), scene_1 (seed 0)."
    ]
    rows += [
        row_of(k, method="nominal", eta=0.0, cfr_object=float(k == 0)) for k in range(3)
    ]
    ends = "0 of 3 rollouts under nominal: e2 at η=2 in scene_0 (seed 0), scene_1 (seed 0)."
    assert touched_lines(rows)[0].endswith(ends)
    people, objects = touched_lines(rows, shown=True)
    assert people == (
        "a touched a pedestrian or cyclist in 2 of 3 rollouts under e2 at η=2, 0 of 3 "
        "rollouts under nominal; the "
        "failure report lacks them, see cfr_vru in rollouts.csv."
    )
    assert objects.startswith(
        "a touched an object in 0 of 3 rollouts under e2 at η=2, 1 of 3 rollouts under nominal;"
    )


def test_of_many_methods_those_are_told_in_which_somebody_was_touched():
    rows = [
        row_of(k, method=f"m{m}", cfr_vru=float(m == 1))
        for m in range(4)
        for k in range(9)
    ]
    (line,) = touched_lines(rows)
    assert "in 9 of 9 rollouts under m1 at η=2: " in line
    assert "m2" not in line
    assert "scene_2 (seed 0) and 6 other scenes in rollouts.csv" not in line
    assert "scene_8" in line
    (line,) = touched_lines([row | {"cfr_vru": 1.0} for row in rows])
    assert line.count("and 6 other scenes in rollouts.csv") == 4


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The folder of a small search against a planner that raises in one scene, and what
    the command printed."""
    folder = tmp_path_factory.mktemp("answered")
    (folder / "planners_of_mine.py").write_text(PLANNER)
    settings = (ROOT / "conf" / "ego" / "lane_graph.yaml").read_text()
    (folder / "conf" / "ego").mkdir(parents=True)
    changed = settings.replace(
        "e2rl.planners.lane_graph_planner.LaneGraphEgo", "planners_of_mine.Fragile"
    )
    (folder / "conf" / "ego" / "fragile.yaml").write_text(changed)
    run = folder / "run"
    command = [
        sys.executable,
        str(ROOT / "evaluate.py"),
        "--config-dir",
        str(folder / "conf"),
        "ego=fragile",
        *SMALL,
    ]
    path = os.pathsep.join([str(ROOT), str(folder)])
    process = subprocess.run(
        [*command, f"hydra.run.dir={run}"],
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert process.returncode == 0, process.stderr
    return run, process.stdout


@pytest.fixture(scope="module")
def derived(answered, tmp_path_factory):
    """The folder of what gate and compare make of the run, and what they print."""
    run, _ = answered
    folder = tmp_path_factory.mktemp("derived")
    rules = ["search:preventable<=1", "search:contacts<=0.1"]
    reports = ["--json", folder / "gate.json", "--junit", folder / "gate.xml"]
    gated = cli("gate", run, *rules, *reports)
    return folder, gated, cli("compare", run, run, "--out", folder / "compare.html")


def cli(*arguments):
    """What a command of e2rl prints."""
    process = subprocess.run(
        [sys.executable, "-m", "e2rl.commands.cli", *map(str, arguments)],
        capture_output=True,
    )
    return process.stdout.decode()


@pytest.mark.slow
def test_screen_page_rows_json_gate_and_comparison_say_the_same(answered, derived):
    run, printed = answered
    folder, gated, compared = derived
    rows = [row for row in read_rows(run / TABLE) if row["method"] == "search"]
    scenes = {row["scene_id"] for row in rows}
    preventable = {row["scene_id"] for row in rows if row["cfr_preventable"] == 1}
    raised = {row["scene_id"] for row in rows if row["errored"] == 1}
    assert len(scenes) == 4
    assert raised == {"arterial_015_0280"}
    assert len(rows) <= 2 * 4
    sentence = headline_text(
        headline(rows, searched=True), "fragile", traffic="search at η=2"
    )
    assert (
        f"preventable failures, or it raised, in {len(preventable | raised)} of 4 scenes"
        in sentence
    )
    assert f"; preventable failures in {len(preventable)} of 4" in sentence
    assert sentence.endswith(f"; it raised in {len(raised)} of 4.")
    (metrics,) = [
        row for row in read_metrics(run / METRICS_FILE) if row["method"] == "search"
    ]
    assert metrics["headline"] == headline(rows, searched=True)._asdict()
    rate = metrics["metrics"]["cfr_preventable"]
    assert (rate["n"], round(rate["mean"] * 4)) == (4, len(preventable | raised))
    page = (run / "failures.html").read_text()
    (group,) = [
        group
        for group in json.loads(data_of(page))["groups"]
        if group["method"] == "search"
    ]
    assert group["summary"][0] == sentence
    rule, _ = json.loads((folder / "gate.json").read_text())
    assert rule["headline"] == metrics["headline"]
    assert rule["value"] == rate["mean"]
    for text in (printed, gated, compared.replace(f"fragile of {run}", "fragile")):
        assert sentence in " ".join(text.split())


def data_of(page: str) -> str:
    return re.search(
        r'<script type="application/json" id="report">(.*?)</script>', page, re.DOTALL
    )[1]


@pytest.mark.slow
def test_a_planner_that_raises_is_named_everywhere(answered, derived):
    run, printed = answered
    folder, _, compared = derived
    names = ("arterial_015_0280", "RuntimeError: no feasible trajectory")
    with (run / "failures.csv").open(newline="") as file:
        listed = [row for row in csv.DictReader(file) if row["errored"] == "1"]
    assert listed
    assert all((row["scene_id"], row["error"]) == names for row in listed)
    files = [
        run / "failures.html",
        *(folder / name for name in ("gate.json", "gate.xml", "compare.html")),
    ]
    for text in (printed, compared, *(file.read_text() for file in files)):
        assert all(name in " ".join(text.split()) for name in names)
