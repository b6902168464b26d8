"""reproduce=RUN_DIR: the table of a run again, from its folder alone, with its
configuration, scenes and weights."""

import csv
import json
import math
import shlex
import shutil
import zipfile
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from e2rl.driving.setup import Setup
from e2rl.evaluation.reproduce import compare_tables
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.scenes.scene_list import read_list
from e2rl.sim.rollout_file import rollout_key
from tests.evaluation.test_protocol import same_runs
from tests.scripts import arguments, call, error_line, left_behind

QUICK = [
    "seeds=[0]",
    "processes=1",
    "methods=[constant_velocity,nominal]",
    "prior.sampler.steps=2",
]


def table(eta=1.0):
    """A row of metrics.json."""

    def numbers(mean):
        return {"mean": mean, "low": 0.1, "high": math.nan, "n": 4}

    metrics = {
        "cfr": numbers(0.25),
        "real": numbers(0.75),
        "seconds_per_rollout": numbers(1.5),
    }
    row = {
        "dataset": "d",
        "split": "s",
        "method": "e2",
        "ego": "idm",
        "eta": eta,
        "n_rollouts": 4,
        "git": "abc",
    }
    paired = {
        "nominal": {
            "cfr": {"difference": 0.2},
            "seconds_per_rollout": {"difference": 1.0},
        }
    }
    return [row | {"metrics": metrics, "paired": paired}]


def test_tables_are_equal_but_for_wall_times_and_where_they_were_made():
    current = table()
    current[0]["git"], current[0]["metrics"]["seconds_per_rollout"]["mean"] = (
        "other",
        9.0,
    )
    result = compare_tables(table(), current)
    assert (result.equal, result.close, result.different) == (1 + 2 * 4 + 1, 0, [])
    assert result.text() == "all 10 numbers of its tables are equal"


def test_each_number_that_differs_is_named_with_both_values():
    current = table()
    (
        current[0]["metrics"]["cfr"]["mean"],
        current[0]["paired"]["nominal"]["cfr"]["difference"],
    ) = 0.5, math.nan
    result = compare_tables(table(), current)
    assert [entry[0].split(": ")[1] for entry in result.different] == [
        "cfr.mean",
        "paired.nominal.cfr.difference",
    ]
    assert "d s e2 idm 1.0: cfr.mean: 0.25 then, 0.5 now" in result.text()
    assert "8 of 10" in result.text()
    for first, other, place in (
        (table(), table(2.0) + table(), 1),
        (table(2.0) + table(), table(), 2),
    ):
        result = compare_tables(first, other)
        assert result.equal == len(result.different) == 10
        assert {entry[place] for entry in result.different} == {"missing"}


@pytest.mark.parametrize(("factor", "close"), [(1 + 1e-9, 1), (1 + 2e-6, 0)])
def test_rounding_is_told_apart(factor, close):
    current = table()
    current[0]["metrics"]["cfr"]["mean"] *= factor
    result = compare_tables(table(), current)
    assert (result.close, len(result.different)) == (close, 1 - close)


# --- through evaluate.py


@pytest.fixture(scope="module")
def then(world, tmp_path_factory):
    """A run on two logs, in traffic of a prior's file."""
    folder = tmp_path_factory.mktemp("then")
    monkeypatch = pytest.MonkeyPatch()
    said = SimpleNamespace(
        readouterr=lambda: SimpleNamespace(out="", err="")
    )  # capsys is none for a module
    with monkeypatch.context():
        inputs = [*arguments(world, folder, "good", *QUICK), "data.build.steps=20"]
        status, _ = call("evaluate.py", inputs, monkeypatch=monkeypatch, capsys=said)
    assert status == 0
    return folder / "run"


def again(run, folder, *more):
    return [
        f"reproduce={run}",
        f"hydra.run.dir={folder}",
        f"data.cache={folder.parent / 'cache'}",
        *more,
    ]


@pytest.fixture
def sent(then, tmp_path):
    """A copy of the run's folder."""
    shutil.copytree(then, tmp_path / "sent")
    return tmp_path / "sent"


def test_one_command_makes_the_same_table_in_a_new_folder(
    then, tmp_path, monkeypatch, capsys
):
    before = {path: path.read_bytes() for path in then.rglob("*") if path.is_file()}
    status, said = call(
        "evaluate.py",
        again(then, tmp_path / "now"),
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 0, said
    result = json.loads((tmp_path / "now" / "reproduced.json").read_text())
    assert result["different"] == []
    assert result["close"] == 0
    assert result["equal"] > 50, result
    same_runs(then, tmp_path / "now")
    assert read_list(tmp_path / "now") == read_list(then)
    assert before == {
        path: path.read_bytes() for path in then.rglob("*") if path.is_file()
    }


@pytest.mark.slow
def test_data_and_weights_may_lie_elsewhere(world, sent, tmp_path, monkeypatch, capsys):
    """A colleague's: the folder was sent, data and weights have other paths."""
    weights = tmp_path / "weights.safetensors"
    shutil.copy(world / "prior.safetensors", weights)
    for name in (".hydra/config.yaml", "provenance.json"):
        (sent / name).write_text(
            (sent / name).read_text().replace(str(world), "/nowhere")
        )
    with zipfile.ZipFile(tmp_path / "data.zip", "w") as archive:
        for path in sorted((world / "good").iterdir()):
            archive.write(path, path.name)
    other = again(sent, tmp_path / "a", f"prior.checkpoint={sent / 'provenance.json'}")
    status, said = call("evaluate.py", other, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 2
    assert (
        "prior.checkpoint is another file than the run's prior.checkpoint="
        in error_line(said)
    )
    status, said = call(
        "evaluate.py",
        again(sent, tmp_path / "a"),
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 2
    assert (
        "not there; say where the file lies that the run used, by prior.checkpoint=FILE"
        in said
    )
    here = [
        "data=scenarionet",
        f"data.path={tmp_path / 'data.zip'}",
        f"prior.checkpoint={weights}",
    ]
    status, said = call(
        "evaluate.py",
        again(sent, tmp_path / "b", *here),
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 0, said
    assert (
        json.loads((tmp_path / "b" / "reproduced.json").read_text())["different"] == []
    )


@pytest.mark.slow
def test_other_scenes_are_refused_by_name(world, then, tmp_path, monkeypatch, capsys):
    shutil.copytree(world / "good", tmp_path / "good")
    (tmp_path / "good" / "sd_00.pkl").write_bytes(
        (world / "good" / "sd_01.pkl").read_bytes()
    )
    inputs = again(
        then, tmp_path / "now", "data=scenarionet", f"data.path={tmp_path / 'good'}"
    )
    status, said = call("evaluate.py", inputs, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 2
    assert "scenes are not" in error_line(said)
    assert "scene-0" in error_line(said)
    assert not left_behind(tmp_path / "now")


def test_what_would_be_another_table_is_refused(then, tmp_path, monkeypatch, capsys):
    status, said = call(
        "evaluate.py",
        again(then, tmp_path / "now", "seeds=[1]"),
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 2
    assert "leave out seeds (only" in error_line(said)
    assert not left_behind(tmp_path / "now")


def test_a_failure_that_the_run_does_not_have_is_refused(
    then, tmp_path, monkeypatch, capsys
):
    for inputs in (again(then, tmp_path / "now", "failure=none"), ["failure=none"]):
        status, said = call(
            "evaluate.py", inputs, monkeypatch=monkeypatch, capsys=capsys
        )
        assert status == 2
        assert "none of the 0 failures" in said or "reproduce=RUN_DIR" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        ["tries=1", "methods=[nominal,e2]", "eta=[1,2]"],
        ["budget=640", "methods=[search]"],
    ],
)
def test_the_command_of_a_failure_drives_the_same_contact(
    more, tmp_path, monkeypatch, capsys
):
    """In its folder's failures.csv; also that of the run that it makes."""
    (tmp_path / "list.csv").write_text("scene_id,number\nallway_stop_043_0200,7\n")
    inputs = [
        f"scenes={tmp_path / 'list.csv'}",
        "prior.sampler.steps=4",
        "seeds=[0]",
        "processes=1",
        *more,
    ]
    assert (
        call(
            "evaluate.py",
            [*inputs, f"hydra.run.dir={tmp_path / 'then'}"],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )[0]
        == 0
    )
    rows = {rollout_key(row): row for row in read_rows(tmp_path / "then" / TABLE)}
    lines = list(csv.DictReader((tmp_path / "then" / "failures.csv").open(newline="")))
    assert lines
    for number, line in enumerate([lines[0], lines[-1]]):
        folder = tmp_path / str(number)
        program, command, *options = shlex.split(line["again"])
        assert (program, command) == ("e2rl", "evaluate")
        assert (
            call(
                "evaluate.py",
                [*options, f"hydra.run.dir={folder}"],
                monkeypatch=monkeypatch,
                capsys=capsys,
            )[0]
            == 0
        )
        (row,) = read_rows(folder / TABLE)
        certain = rows[line["failure"]]
        for name in (
            "scene_id",
            "method",
            "eta",
            "seed",
            "partner",
            "contact_step",
            "contact_type",
        ):
            assert row[name] == certain[name]
        (twin,) = csv.DictReader((folder / "failures.csv").open(newline=""))
        assert twin["again"] == line["again"]


def test_a_stranger_s_run_runs_nothing(sent, tmp_path, monkeypatch, capsys):
    file = sent / ".hydra" / "config.yaml"
    config = OmegaConf.load(file)
    for target in ("os.system", "e2rl.planners.external.ExternalEgo"):
        ego = {"_target_": target, "command": f"touch {tmp_path / 'ran'}"}
        OmegaConf.save(OmegaConf.merge(config, {"ego": ego}), file)
        status, said = call(
            "evaluate.py",
            again(sent, tmp_path / "now"),
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        assert status == 2
        assert "runs code that is no extension of e2rl" in error_line(said)
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_an_interrupted_evaluation_goes_on_by_the_command_that_it_names(
    world, tmp_path, monkeypatch, capsys
):
    """In its own folder, with its own configuration; what changes its meaning is
    refused."""
    score = Setup.score
    left = [3]

    def stopped(*tasks, **settings):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return score(*tasks, **settings)

    small = [
        "seeds=[0]",
        "batch=1",
        "processes=1",
        "methods=[constant_velocity,replay]",
        "data.build.steps=20",
    ]
    inputs = [*arguments(world, tmp_path, "good", *small), "ego=idm"]
    status, said = call(
        "evaluate.py",
        [*inputs, f"hydra.run.dir={tmp_path / 'whole'}"],
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 0, said
    monkeypatch.setattr(Setup, "score", stopped)
    run = tmp_path / "run"
    status, said = call("evaluate.py", inputs, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 130
    assert f"evaluate.py resume={run}" in said
    assert "interrupted (SIGINT)" in said
    left[0], named = 1, shlex.split(said.rpartition("evaluate.py ")[2])
    status, said = call(
        "evaluate.py", [*named, "seeds=[1]"], monkeypatch=monkeypatch, capsys=capsys
    )
    assert status == 2
    assert "leave out seeds (only processes, shard can change)" in error_line(said)
    status, said = call("evaluate.py", named, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 0
    assert left == [0], said
    same_runs(tmp_path / "whole", run)
