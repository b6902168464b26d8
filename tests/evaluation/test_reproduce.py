"""reproduce=RUN_DIR: the table of a run again, from its folder alone, with its configuration, scenes and weights."""

import json
import shutil
import zipfile

import pytest
from omegaconf import OmegaConf

from e2rl.evaluation.rollout_files import read_metrics, read_rows
from e2rl.scenes.scene_list import read_list
from tests.scripts import arguments, call, error_line, left_behind

QUICK = ["seeds=[0]", "processes=1", "methods=[constant_velocity,nominal]", "prior.sampler.steps=2"]


@pytest.fixture(scope="module")
def then(world, tmp_path_factory):
    """A run on two logs, in traffic of a prior's file, with a weight file for the ego."""
    folder = tmp_path_factory.mktemp("then")
    monkeypatch = pytest.MonkeyPatch()
    with monkeypatch.context():
        given = [*arguments(world, folder, "good", *QUICK), "data.build.steps=20"]
        status, said = call("evaluate.py", given, monkeypatch, Silent())
    assert status == 0, said
    return folder / "run"


class Silent:
    """In place of capsys, which a module's fixture cannot have."""

    class Said:
        out, err = "", ""

    def readouterr(self):
        return self.Said


def again(run, folder, *more):
    return [f"reproduce={run}", f"hydra.run.dir={folder}", f"data.cache={folder.parent / 'cache'}", *more]


def test_one_command_makes_the_same_table_in_a_new_folder(then, tmp_path, monkeypatch, capsys):
    before = {path: path.read_bytes() for path in then.rglob("*") if path.is_file()}
    status, said = call("evaluate.py", again(then, tmp_path / "now"), monkeypatch, capsys)
    assert status == 0, said
    found = json.loads((tmp_path / "now" / "reproduced.json").read_text())
    assert found["different"] == [] and found["close"] == 0 and found["equal"] > 50, found
    assert "versions differ" not in said and "not those listed" not in said
    rows = [read_rows(run / "rollouts.csv") for run in (then, tmp_path / "now")]
    for row, other in zip(*rows, strict=True):
        assert str({**row, "seconds": 0, "evasion_seconds": 0}) == str({**other, "seconds": 0, "evasion_seconds": 0})
    assert read_list(tmp_path / "now") == read_list(then)
    assert before == {path: path.read_bytes() for path in then.rglob("*") if path.is_file()}


def test_data_and_weights_may_lie_elsewhere_and_the_run_can_be_reproduced_and_resumed(
    world, then, tmp_path, monkeypatch, capsys
):
    """A colleague's: the folder was sent, data and weights have other paths."""
    sent, weights = tmp_path / "sent", tmp_path / "weights.safetensors"
    shutil.copytree(then, sent)
    shutil.copy(world / "prior.safetensors", weights)
    config = (sent / ".hydra" / "config.yaml").read_text()
    (sent / ".hydra" / "config.yaml").write_text(config.replace(str(world), "/nowhere"))
    inputs = (sent / "provenance.json").read_text()
    (sent / "provenance.json").write_text(inputs.replace(str(world), "/nowhere"))
    with zipfile.ZipFile(tmp_path / "data.zip", "w") as archive:
        for path in sorted((world / "good").iterdir()):
            archive.write(path, path.name)
    status, said = call("evaluate.py", again(sent, tmp_path / "a"), monkeypatch, capsys)
    assert status == 2 and "not there; say where the file lies that the run used, by prior.checkpoint=FILE" in said
    here = ["data=scenarionet", f"data.path={tmp_path / 'data.zip'}", f"prior.checkpoint={weights}"]
    status, said = call("evaluate.py", again(sent, tmp_path / "b", *here), monkeypatch, capsys)
    assert status == 0, said
    assert json.loads((tmp_path / "b" / "reproduced.json").read_text())["different"] == []
    assert {row["split"] for row in read_metrics(tmp_path / "b" / "metrics.json")} == {"good"}
    for command in (f"reproduce={tmp_path / 'b'}", f"resume={tmp_path / 'b'}"):
        (tmp_path / "b" / "reproduced.json").unlink()
        status, said = call("evaluate.py", [command, f"hydra.run.dir={tmp_path / 'c'}"], monkeypatch, capsys)
        assert status == 0, said
        folder = tmp_path / ("c" if command.startswith("reproduce") else "b")
        assert json.loads((folder / "reproduced.json").read_text())["different"] == []
        if folder == tmp_path / "c":
            shutil.copy(folder / "reproduced.json", tmp_path / "b")


def test_other_weights_are_refused_by_name(world, then, tmp_path, monkeypatch, capsys):
    other = tmp_path / "other.safetensors"
    other.write_bytes((world / "prior.safetensors").read_bytes() + b" ")
    given = again(then, tmp_path / "now", f"prior.checkpoint={other}")
    status, said = call("evaluate.py", given, monkeypatch, capsys)
    assert status == 2 and "prior.checkpoint is another file than the run's prior.checkpoint=" in error_line(said)
    assert not left_behind(tmp_path / "now")


def test_other_scenes_are_refused_by_name(world, then, tmp_path, monkeypatch, capsys):
    shutil.copytree(world / "good", tmp_path / "good")
    (tmp_path / "good" / "sd_00.pkl").write_bytes((world / "good" / "sd_01.pkl").read_bytes())
    given = again(then, tmp_path / "now", "data=scenarionet", f"data.path={tmp_path / 'good'}")
    status, said = call("evaluate.py", given, monkeypatch, capsys)
    assert status == 2 and "scenes are not" in error_line(said) and "scene-0" in error_line(said)


def test_other_versions_are_told_and_what_differs_is_named(then, tmp_path, monkeypatch, capsys):
    sent = tmp_path / "sent"
    shutil.copytree(then, sent)
    known = json.loads((sent / "provenance.json").read_text())
    known["versions"][-1] |= {"torch": "1.0.0", "e2rl": "0" * 64}
    known["inputs"]["synthesizer=nominal"] = {"name": "another"}
    (sent / "provenance.json").write_text(json.dumps(known))
    rows = json.loads((sent / "metrics.json").read_text())
    rows[0]["metrics"]["progress"]["mean"] += 1
    (sent / "metrics.json").write_text(json.dumps(rows))
    status, said = call("evaluate.py", again(sent, tmp_path / "now"), monkeypatch, capsys)
    assert status == 0 and "versions differ: " in said
    for part in ("torch 1.0.0 then, ", "e2rl 000000000000 then, ", "conf/synthesizer/nominal.yaml"):
        assert part in said
    different = json.loads((tmp_path / "now" / "reproduced.json").read_text())["different"]
    assert len(different) == 1 and different[0][0].endswith("progress: mean")


@pytest.mark.parametrize(
    ("more", "what"),
    [
        (["seeds=[1]"], "leave out seeds (only "),
        (["synthesizer=nominal"], "leave out synthesizer"),
        (["ego=idm"], "leave out ego"),
        (["prior.sampler.steps=4"], "leave out prior.sampler.steps"),
    ],
)
def test_what_would_be_another_table_is_refused(then, tmp_path, monkeypatch, capsys, more, what):
    status, said = call("evaluate.py", again(then, tmp_path / "now", *more), monkeypatch, capsys)
    assert status == 2 and what in error_line(said) and not left_behind(tmp_path / "now")


def test_a_stranger_s_run_runs_nothing(then, tmp_path, monkeypatch, capsys):
    sent = tmp_path / "sent"
    shutil.copytree(then, sent)
    file = sent / ".hydra" / "config.yaml"
    config = OmegaConf.load(file)
    for changes in (
        {"ego": {"_target_": "os.system", "command": f"touch {tmp_path / 'ran'}"}},
        {"ego": {"_target_": "e2rl.planners.external.ExternalEgo", "command": f"touch {tmp_path / 'ran'}"}},
        {"plugins": ["this"]},
    ):
        OmegaConf.save(OmegaConf.merge(config, changes), file)
        status, said = call("evaluate.py", again(sent, tmp_path / "now"), monkeypatch, capsys)
        assert status == 2 and "runs code that is no extension of e2rl" in error_line(said)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["metrics.json", "scenes.csv", "provenance.json", ".hydra/config.yaml"])
@pytest.mark.parametrize("content", [None, "[1]"])
def test_a_folder_that_is_no_run_with_a_table_is_named(then, tmp_path, monkeypatch, capsys, name, content):
    sent = tmp_path / "sent"
    shutil.copytree(then, sent)
    (sent / name).unlink() if content is None else (sent / name).write_text(content)
    status, said = call("evaluate.py", again(sent, tmp_path / "now"), monkeypatch, capsys)
    assert status == 2 and name.split("/")[-1] in error_line(said)


def test_scenes_of_a_list_are_those_of_the_run(then, world, tmp_path, monkeypatch, capsys):
    """Its second scene alone: the same noise as in the run of both."""
    lines = (then / "scenes.csv").read_text().splitlines()
    (tmp_path / "list.csv").write_text("\n".join([lines[0], lines[2]]) + "\n")
    more = [f"scenes={tmp_path / 'list.csv'}", *QUICK, "data.build.steps=20", "batch=1"]
    status, said = call("evaluate.py", arguments(world, tmp_path, "good", *more), monkeypatch, capsys)
    assert status == 0, said
    name = lines[2].split(",")[0]
    rows = [row for row in read_rows(then / "rollouts.csv") if row["scene_id"] == name]
    alone = read_rows(tmp_path / "run" / "rollouts.csv")
    assert [row["method"] for row in alone] == [row["method"] for row in rows] == ["constant_velocity", "nominal"]
    for row, other in zip(rows, alone, strict=True):
        assert row["progress"] == pytest.approx(other["progress"], rel=1e-5)
