"""A run goes on with what it was begun with: changed scenes, weights and settings are refused, other code is told."""

import json
import sys

import pytest
from e2rl.evaluation.provenance import PROVENANCE, begin_run, origin_of, read_provenance
from omegaconf import OmegaConf

from e2rl.evaluation import provenance
from e2rl.prior.checkpoint import save_prior
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from tests.learning.small import small_scenes
from tests.prior.small import small_prior

FREE = ("processes",)


def run_of(folder, resume=False, prior=None, **changes):
    """The configuration of an evaluation, resumed or not."""
    overrides = {"resume": str(folder) if resume else None, "prior": {"checkpoint": str(prior or "bundled")}}
    return OmegaConf.merge(load_config("evaluate"), overrides, changes)


def begin(folder, scenes=None, **options):
    begin_run(folder, run_of(folder, **options), FREE, {"scenes": scenes or small_scenes(2)})


@pytest.fixture
def prior(tmp_path):
    path = save_prior(small_prior(0), tmp_path / "priors", {})
    return path.rename(path.with_name("prior.safetensors"))


def test_the_same_run_goes_on(tmp_path, prior, capsys):
    begin(tmp_path, prior=prior)
    begun = (tmp_path / PROVENANCE).read_bytes()
    Parts(tmp_path).save("a", [], 1)
    begin(tmp_path, prior=prior, resume=True, processes=3, plugins=["json"])
    assert (tmp_path / PROVENANCE).read_bytes() == begun and Parts(tmp_path).load("a", []) == 1


def test_a_run_that_ended_before_its_file_was_written_keeps_its_command(tmp_path, monkeypatch):
    overrides = {
        "task": ["batch=4", "methods=[replay, ${synthesizer.name}]"],
        "hydra": ["hydra.run.dir=run", "hydra.mode=RUN"],
    }
    (tmp_path / ".hydra").mkdir()
    OmegaConf.save({"hydra": {"overrides": overrides}}, tmp_path / ".hydra" / "hydra.yaml")
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "resume=run"])
    begin(tmp_path, resume=True)
    assert origin_of(tmp_path)["command"] == (
        "python evaluate.py batch=4 'methods=[replay, ${synthesizer.name}]' hydra.run.dir=run"
    )


@pytest.mark.parametrize(
    "saved", [{}, {"hydra": 1}, {"hydra": {"overrides": "x"}}, {"hydra": {"overrides": {"task": 3}}}]
)
def test_damaged_overrides_are_named(tmp_path, saved):
    (tmp_path / ".hydra").mkdir()
    OmegaConf.save(saved, tmp_path / ".hydra" / "hydra.yaml")
    with pytest.raises(InputError, match=r"hydra\.yaml: damaged"):
        begin(tmp_path, resume=True)


def test_changed_weights_are_refused(tmp_path, prior):
    begin(tmp_path, prior=prior)
    save_prior(small_prior(1), tmp_path / "priors", {}).rename(prior)
    with pytest.raises(InputError, match=r"prior\.checkpoint=.*prior\.safetensors changed since the run began"):
        begin(tmp_path, prior=prior, resume=True)


def test_changed_scenes_are_refused(tmp_path):
    begin(tmp_path)
    moved = small_scenes(2)
    moved.scenes["logged"][1, 3, 2, 0] += 0.01
    with pytest.raises(InputError, match="scenes changed since the run began"):
        begin(tmp_path, moved, resume=True)


@pytest.mark.parametrize(
    ("changes", "name"), [({"batch": 16}, "batch"), ({"synthesizer": {"support": "random"}}, "synthesizer")]
)
def test_changed_settings_are_refused(tmp_path, changes, name):
    begin(tmp_path)
    with pytest.raises(InputError, match=f": {name} changed since the run began"):
        begin(tmp_path, resume=True, **changes)


def test_a_changed_file_of_a_method_is_refused(tmp_path, monkeypatch):
    begin(tmp_path)
    monkeypatch.setattr(provenance, "method_config", lambda config, name: OmegaConf.create({"name": name, "gain": 2}))
    with pytest.raises(InputError, match="synthesizer=nominal changed"):
        begin(tmp_path, resume=True)


def test_other_code_is_told_and_named_in_the_rows(tmp_path, monkeypatch, capsys):
    begin(tmp_path)
    command = origin_of(tmp_path)["command"]
    now = provenance.versions(run_of(tmp_path)) | {"git": "abc", "e2rl": "123"}
    monkeypatch.setattr(provenance, "versions", lambda config: now)
    for _ in range(2):
        begin(tmp_path, resume=True)
    assert "other versions than before (e2rl, git)" in capsys.readouterr().err
    assert len(read_provenance(tmp_path)["versions"]) == 2
    assert origin_of(tmp_path)["command"] == command and origin_of(tmp_path)["git"].endswith(", abc")


def test_a_new_run_in_an_old_folder_keeps_nothing_of_it(tmp_path):
    begin(tmp_path)
    Parts(tmp_path, "before").save("a", [], 1)
    begin(tmp_path)
    assert Parts(tmp_path, "before").load("a", []) is None


NO_GIT = {"command": "x", "versions": [{}], "inputs": {}, "settings": {}}


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"command": 1}', json.dumps({"command": "x", "versions": []}), json.dumps(NO_GIT)]
)
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / PROVENANCE).write_text(content)
    with pytest.raises(InputError, match=f"{PROVENANCE}: damaged"):
        begin(tmp_path, resume=True)
