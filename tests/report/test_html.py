"""The failure report: every failure once, its rates those of the tables, what a run
lacks is said, nothing from elsewhere, no markup from files."""

import csv
import json
import re
import shlex

import pytest

from e2rl.commands import export, replay, report
from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.rollout_files import read_rows
from e2rl.metrics.atlas import CELL, atlas_of
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.html import replay_order, write_report
from e2rl.sim.rollout_file import ROLLOUTS, Rollout
from tests.metrics.random_rollouts import random_rollouts
from tests.report.failed_run import SCENE, failed_run, preventable_run, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return failed_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(run):
    return write_report(run).read_text()


def data_of(page: str) -> dict:
    return json.loads(
        re.search(
            r'<script type="application/json" id="report">(.*?)</script>',
            page,
            re.DOTALL,
        )[1]
    )


def test_every_failure_is_in_the_index_with_its_replay(run, page):
    data = data_of(page)
    failures = [row for row in read_rows(run / "rollouts.csv") if is_failure(row)]
    assert (
        len(data["failures"])
        == len(failures)
        == read_modes(run / "modes.json")["failures"]
        > 5
    )
    for entry, row in zip(data["failures"], failures, strict=True):
        assert (entry["scene_id"], entry["method"], entry["seed"]) == (
            row["scene_id"],
            row["method"],
            row["seed"],
        )
        assert entry["ego_speed"] == pytest.approx(row["ego_speed"], abs=1e-4)
        assert entry["avoidable"] is None
        replay = data["replays"][entry["replay"]]
        assert replay["contact"] == row["contact_step"]
        assert 0 <= replay["map"] < len(data["maps"])
    assert sum(group["failures"] for group in data["groups"]) == len(failures)
    assert data["tables"][0]["head"] == ["", "e2 η=2", "planned η=2"]


def test_the_list_has_every_failure_once_as_the_table_has_it(run, page):
    failures = [row for row in read_rows(run / "rollouts.csv") if is_failure(row)]
    names = {
        mode["mode"]: mode["name"] for mode in read_modes(run / "modes.json")["modes"]
    }
    with (run / "failures.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(failures) == len({line["failure"] for line in lines})
    for line, row in zip(lines, failures, strict=True):
        rollout = Rollout.read(run / ROLLOUTS / f"{line['failure']}.npz")
        assert (rollout.scene_id, rollout.method, rollout.eta) == (
            line["scene_id"],
            line["method"],
            float(line["eta"]),
        )
        for name in (
            "scene_id",
            "location",
            "method",
            "ego_policy",
            "duty",
            "contact_type",
            "approach",
        ):
            assert line[name] == row[name]
        for name in (
            "seed",
            "partner",
            "contact_time",
            "counted",
            "at_fault",
            "preventable",
            "cfr_clean",
            "relvel",
        ):
            assert float(line[name] or "nan") == pytest.approx(
                row[name], abs=1e-4, nan_ok=True
            )
        assert line["mode"] == names.get(row["mode"], "other")
        assert line["link"] == f"failures.html#failure={line['failure']}"


def test_a_failure_s_commands_are_about_it_alone(run, page, tmp_path):
    commands = data_of(page)["commands"]
    name = data_of(page)["failures"][2]["key"]
    words = shlex.split(commands["Its video"].replace("@NAME@", name))
    assert words[:2] == ["e2rl", "replay"]
    replay.main([*words[2:], "--pixels=100", f"--out={tmp_path}"])
    assert [path.stem for path in tmp_path.glob("*.gif")] == [name]
    words = shlex.split(commands["Export it"].replace("@NAME@", name))
    assert (
        words[:2] == ["e2rl", "export"] and "Drive it again" not in commands
    )  # no configuration, no command
    export.main([*words[2:], "--to=npz", "--no-scene"])
    (written,) = (run / "export").rglob("exported.csv")
    assert [path.stem for path in written.parent.rglob("*.npz")] == [name]
    with pytest.raises(SystemExit):
        export.main([str(run), "--to=npz", "--no-scene", "--failure=none"])


def test_the_first_lines_say_what_the_tables_say(tmp_path):
    """Of each traffic, with the interval where there are places enough for one."""
    driven = random_rollouts(24, seed=21)
    driven.location = [f"place_{index // 2}" for index in range(24)]
    run = write_run(tmp_path, {"e2": driven, "other": random_rollouts(12, seed=20)})
    data = data_of(write_report(run).read_text())
    head = data["tables"][0]["head"]
    lines = {line[0]: line for line in data["tables"][0]["rows"]}
    result = 0
    for group in data["groups"]:
        for name, text in group["rates"].items():
            hits, of, rate, *interval = map(
                float, re.findall(r"[\d.]+", text.replace("95% interval", ""))
            )
            cell, _, certain = lines[f"{name} [%]"][
                head.index(group["label"])
            ].partition(" (")
            mean, *bounds = map(float, re.findall(r"[\d.]+", cell))
            result += len(bounds) == 2
            assert of == float(certain.strip(")") or group["rollouts"])
            assert hits / of == pytest.approx(mean / 100, abs=5.1e-4)
            assert [rate, *interval] == pytest.approx([mean, *bounds], abs=0.51)
    assert result >= 3
    assert len(data["groups"]) == 2


def test_a_training_has_a_page_for_what_it_measured(tmp_path, capsys):
    with pytest.raises(SystemExit):
        report.main([str(tmp_path)])
    assert "give a run of evaluate.py" in capsys.readouterr().err
    stages = [
        failed_run(tmp_path / "run" / stage) for stage in ("before", "after/search")
    ]
    report.main([str(tmp_path / "run")])
    assert capsys.readouterr().out.split() == [
        str(stage / "failures.html") for stage in stages
    ]
    with pytest.raises(SystemExit):
        report.main([str(tmp_path / "run"), "--out", str(tmp_path / "one.html")])
    report.main([str(stages[0]), "--out", str(tmp_path / "one.html")])
    assert "one.html#failure=" in (tmp_path / "one.csv").read_text()


def test_a_limit_and_a_method_keep_their_own(run, tmp_path):
    single = data_of(
        write_report(
            run, replays=1, methods=["e2"], path=tmp_path / "one.html"
        ).read_text()
    )
    assert (
        {entry["method"] for entry in single["failures"]}
        == {group["method"] for group in single["groups"]}
        == {"e2"}
    )
    assert len(single["replays"]) == 1


def test_the_page_knows_the_atlas_and_replays_its_likeliest_failures_first(tmp_path):
    run = preventable_run(tmp_path)
    rows = [row for row in read_rows(run / "rollouts.csv") if is_failure(row)]
    data = data_of(write_report(run).read_text())
    entries = data["failures"]
    typical = sum(entry["typical"] for entry in entries)
    for method in (None, "e2", "planned"):
        ours = [k for k, row in enumerate(rows) if method in (None, row["method"])]
        result = {}
        for k in sorted(ours, key=lambda k: entries[k]["rank"]):
            result.setdefault(
                tuple(data["cells"][entries[k]["cell"]][name] for name in CELL), k
            )
        atlas = atlas_of([rows[k] for k in ours])
        assert len(atlas) == 3
        assert list(result) == list(atlas)
        assert [rows[k] for k in result.values()] == [
            failures[0] for failures in atlas.values()
        ]
        first = replay_order(entries)[: typical + 6]
        assert all(entries[k]["typical"] for k in first[:typical])
        assert set(result.values()) <= set(first)


def test_the_page_loads_nothing_and_files_cannot_add_markup(page):
    assert page.count("</script") == 2
    assert SCENE not in page
    assert "<img" not in page
    outside = re.sub(r"http://www\.w3\.org/2000/svg", "", page)
    assert not re.search(r"https?://|@import|url\(|\bsrc=(?!x onerror)|<link", outside)
