"""A run goes on with what it was begun with: changed scenes, weights and settings are
refused, other code is told."""

import shlex
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from omegaconf import OmegaConf

from e2rl.commands.merge import merge
from e2rl.prior.checkpoint import save_prior
from e2rl.run import run as runs
from e2rl.run.command import new_folder
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.files import seal
from e2rl.run.parts import Parts
from e2rl.run.run import PROVENANCE, Run, assigned, inputs, origin_of, read_provenance
from e2rl.run.trust import CONFIG
from tests.prior.small import small_prior
from tests.scripts import call, error_line

SCENES = {"scenes": ("scene_id\na\n", "abc")}


def begin(folder, resume=False, scenes=SCENES, free=("processes",), **changes):
    arguments = {"resume": str(folder) if resume else None}
    run = Run(
        OmegaConf.merge(load_config("evaluate"), arguments, changes),
        folder,
        choices={"ego": "lane_graph"},
        free=free,
    )
    run.begin(scenes)
    return run


@pytest.fixture
def weights(tmp_path):
    path = save_prior(small_prior(0), tmp_path / "priors", origin={})
    return path.rename(path.with_name("prior.safetensors"))


def test_the_same_run_goes_on(tmp_path, weights):
    run = begin(tmp_path, prior={"checkpoint": str(weights)})
    Parts(run.folder).save("a", [], 1)
    start = (tmp_path / PROVENANCE).read_bytes()
    again = begin(
        tmp_path,
        resume=True,
        prior={"checkpoint": str(weights)},
        processes=3,
        plugins=["json"],
    )
    assert (tmp_path / PROVENANCE).read_bytes() == start
    assert Parts(again.folder).load("a", []) == 1
    assert OmegaConf.load(tmp_path / CONFIG) == run.config
    assert (tmp_path / "scenes.csv").read_text() == SCENES["scenes"][0]
    assert read_provenance(tmp_path)["files"] == {"scenes": "abc"}


CHANGED = [
    ({"synthesizer": {"support": "random"}}, "synthesizer"),
    ({"scenes": {"scenes": ("scene_id\nb\n", "abc")}}, "scenes"),
]


@pytest.mark.parametrize(("changes", "name"), CHANGED)
def test_changed_settings_and_scenes_are_refused(tmp_path, changes, name):
    begin(tmp_path)
    with pytest.raises(InputError, match=f": {name} changed since the run began"):
        begin(tmp_path, resume=True, **changes)


def test_changed_weights_and_files_of_methods_are_refused(
    tmp_path, weights, monkeypatch
):
    prior = {"checkpoint": str(weights)}
    begin(tmp_path, prior=prior)
    monkeypatch.setattr(
        runs,
        "load_choice",
        lambda group, name: OmegaConf.create({"name": name, "gain": 2}),
    )
    with pytest.raises(InputError, match="synthesizer=nominal changed"):
        begin(tmp_path, resume=True, prior=prior)
    monkeypatch.undo()
    save_prior(small_prior(1), tmp_path / "priors", origin={}).rename(weights)
    with pytest.raises(
        InputError,
        match=r"prior\.checkpoint=.*prior\.safetensors changed since the run began",
    ):
        begin(tmp_path, resume=True, prior=prior)


def test_of_a_run_s_folder_the_newest_whole_checkpoint_is_hashed(tmp_path):
    for number, content in ((1, "one"), (2, "two"), (3, "cut off")):
        folder = tmp_path / "checkpoints" / f"round-{number:06}"
        folder.mkdir(parents=True)
        (folder / "actor.safetensors").write_text(content)
        if number < 3:
            seal(folder)
    config = OmegaConf.create(
        {"ego": {"checkpoint": str(tmp_path)}, "egos": {}, "variants": {}}
    )
    before = dict(inputs(config))
    (tmp_path / "checkpoints" / "round-000001" / "actor.safetensors").write_text(
        "other"
    )
    assert dict(inputs(config)) == before
    (tmp_path / "checkpoints" / "round-000002" / "actor.safetensors").write_text(
        "other"
    )
    assert dict(inputs(config)) != before


def test_other_code_is_told_and_named_in_the_rows(tmp_path, monkeypatch, capsys):
    command = origin_of(begin(tmp_path).folder)["command"]
    current = runs.versions(load_config("evaluate")) | {"git": "abc", "e2rl": "123"}
    monkeypatch.setattr(runs, "versions", lambda config: current)
    for _ in range(2):
        begin(tmp_path, resume=True)
    assert "other versions than before (e2rl, git)" in capsys.readouterr().err
    assert len(read_provenance(tmp_path)["versions"]) == 2
    assert origin_of(tmp_path)["command"] == command
    assert origin_of(tmp_path)["git"].endswith(", abc")


@pytest.mark.parametrize("content", ["{", '{"command": 1}', "[" * 5000])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / PROVENANCE).write_text(content)
    with pytest.raises(InputError, match=f"{PROVENANCE}: damaged"):
        begin(tmp_path, resume=True)


@pytest.mark.parametrize(
    "name", ["thesis.tex", "metrics.json", "parts/a.pt", PROVENANCE]
)
def test_a_new_run_begins_in_an_empty_folder(tmp_path, name):
    """Logs may be there, and what was left where a run was killed as it began."""
    config = load_config("evaluate")
    for ours in ("job.log", "job.err", str(CONFIG), "scenes.csv"):
        (tmp_path / ours).parent.mkdir(exist_ok=True)
        (tmp_path / ours).write_text("")
        Run(config, tmp_path, choices={}).enter()
    (tmp_path / CONFIG).unlink()
    (tmp_path / CONFIG).parent.rmdir()
    (tmp_path / "scenes.csv").unlink()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match="name another folder by hydra.run.dir=FOLDER"):
        Run(config, tmp_path, choices={}).enter()


def test_a_run_that_is_refused_leaves_everything_as_it_was(
    tmp_path, monkeypatch, capsys
):
    begin(tmp_path / "run")
    before = {
        path: path.read_bytes()
        for path in (tmp_path / "run").rglob("*")
        if path.is_file()
    }
    monkeypatch.chdir(tmp_path)
    for script in ("evaluate.py", "train.py"):
        status, said = call(
            script,
            [f"hydra.run.dir={tmp_path / 'run'}"],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        assert status == 2
        assert (
            f"has a run already; go on with it by resume={tmp_path / 'run'}"
            in error_line(said)
        )
        assert call(script, ["batch=0"], monkeypatch=monkeypatch, capsys=capsys)[0] == 2
    assert {
        path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()
    } == before


def test_runs_that_begin_in_one_second_have_a_folder_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        built = list(pool.map(new_folder, ["runs/x"] * 40))
    assert len(set(built)) == 40
    assert all(not list((tmp_path / name).iterdir()) for name in built)
    (tmp_path / "file").touch()
    assert new_folder("file/x").startswith("file/x/"), (
        "Hydra says that it cannot be made"
    )


def test_options_for_hydra_and_the_shell_are_quoted(tmp_path, monkeypatch):
    assert assigned("resume", "runs/a-1") == "resume=runs/a-1"
    assert assigned("resume", "it's, a=run") == r"resume='it\'s, a=run'"
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "prior.checkpoint=$(touch x)"])
    command = origin_of(begin(tmp_path).folder)["command"]
    assert command == "python evaluate.py 'prior.checkpoint=$(touch x)'"
    assert shlex.split(command)[-1] == "prior.checkpoint=$(touch x)"


def test_shards_are_joined_and_those_of_another_run_are_refused(tmp_path):
    free = ("processes", "shard")
    for number in range(2):
        run = begin(tmp_path / str(number), free=free, shard=[number, 2])
        Parts(run.folder).save(f"rollouts-{number:06}", [number], number)
    assert merge([tmp_path / "0", tmp_path / "1"], tmp_path / "all") == 2
    whole = begin(tmp_path / "all", resume=True, free=free)
    assert [
        Parts(whole.folder).load(f"rollouts-{number:06}", [number])
        for number in range(2)
    ] == [0, 1]
    begin(tmp_path / "other", free=free, shard=[1, 2], eta=1)
    with pytest.raises(InputError, match="began with another eta"):
        merge([tmp_path / "0", tmp_path / "other"], tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()


def test_the_files_of_a_search_s_families_are_inputs_of_a_run_that_searches():
    searched, plain = (
        {name for name, _ in inputs(load_config("evaluate", [arguments]))}
        for arguments in ("tries=4", "tries=1")
    )
    assert {"synthesizer=ccdiff", "synthesizer=e2_pursuit"} <= searched - plain
