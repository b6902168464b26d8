"""resume=RUN_DIR: a run's own configuration goes on; a stranger's runs no code that the command line does not name."""

import json

import pytest
from e2rl.evaluation.provenance import outside_modules
from e2rl.evaluation.resume import check_code, saved_choices, saved_configuration
from omegaconf import OmegaConf

from e2rl.evaluation.protocol import Setup
from e2rl.evaluation.rollout_files import read_metrics, read_rows
from e2rl.run.config import load_choice, load_config
from e2rl.run.errors import InputError
from tests.scripts import ROOT, SHORT, call, error_line, left_behind

OURS, THEIRS = (OmegaConf.create(OmegaConf.to_container(load_config(name))) for name in ("train", "evaluate"))
POLICY_FILE = "e2rl.planners.policy_file.PolicyFileEgo"


def stranger(**changes):
    """A training configuration with changes at dotted keys."""
    config = OmegaConf.create(OmegaConf.to_container(OURS))
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value, force_add=True)
    return config


@pytest.mark.parametrize(
    ("group", "name"),
    [
        *(("learner", name) for name in ("ppo_bc", "planner_tuning")),
        *(("ego", name) for name in ("actor", "lane_graph", "sampling", "idm", "replay")),
        *(("data", name) for name in ("bundled", "scenarionet")),
        *(("curriculum", name) for name in ("adaptive", "bandit", "constant", "linear")),
        *(("synthesizer", name) for name in ("e2", "nominal", "replay", "idm", "constant_velocity")),
    ],
)
def test_every_group_of_ones_own_goes_on(group, name):
    check_code(stranger(**{group: load_choice(group, name)}), [], "resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"ego": {"_target_": "os.system", "command": "true"}},
        {"ego": {"_target_": "builtins.eval"}},
        {"data___target_": "torch.load"},
        {"learner__teacher": {"_target_": "subprocess.Popen", "args": "true"}},
        {"synthesizer__deep": [{"x": [{"_target_": "pickle.loads"}]}]},
        {"ego___target_": "e2rl.run.files.write_atomically"},  # a function of e2rl
        {"ego___target_": "e2rl.learning.memory.Memory"},  # a class of e2rl that is no extension
        {"ego___target_": "e2rl.evaluation.rollout_files.subprocess.Popen"},  # by way of a module that imports it
        {"ego___target_": "e2rl.learning.build.ActorEgo"},  # an extension, but not where it is defined
        {"ego___target_": "e2rl.scripts.train.run"},
        {"ego___target_": "e2rl.no.such.Class"},
        {"ego___target_": "${seed}"},
        {"ego__x": "${oc.decode:'{_target_: os.system}'}"},
        {"ego__x": r"\${oc.decode:'{_target_: os.system}'}"},
        {"plugins": ["this"]},
    ],
)
def test_code_from_elsewhere_needs_the_users_consent(changes):
    with pytest.raises(
        InputError, match=r"^resume=x: its configuration runs code that is no extension of e2rl: .*plugins="
    ):
        check_code(stranger(**changes), ["my_stack"], "resume=x")


def test_an_external_planner_of_ones_own_goes_on_by_the_command_that_the_run_names():
    config = OmegaConf.merge(THEIRS, {"ego": {**load_choice("ego", "external"), "command": "true"}})
    assert outside_modules(config) == {"e2rl.planners.external"}
    check_code(config, ["e2rl.planners.external"], "resume=x")


def test_a_policy_that_holds_arithmetic_goes_on():
    check_code(OmegaConf.merge(THEIRS, {"ego": {"_target_": POLICY_FILE, "file": "x.onnx"}}), [], "x")


def test_modules_that_the_command_line_names_take_part():
    config = stranger(ego___target_="my_stack.cruise.Cruise", plugins=["my_stack.hard_braking"])
    check_code(config, ["my_stack"], "resume=x")
    check_code(config, ["my_stack.cruise", "my_stack.hard_braking"], "resume=x")
    with pytest.raises(InputError, match="my_stack.hard_braking"):
        check_code(config, ["my_stack.cruise", "my_stack_of_others"], "resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"variants": {"x": {"synthesizer._target_": "os.system"}}},  # a change's key is a path
        {"variants": {"x": {"synthesizer[_target_]": "os.system"}}},
        {"variants": {"x": {"synthesizer": {"reasoner": {"_target_": "os.system"}}}}},
        {"egos": {"x": {"ego": "idm", "_target_": "os.system"}}},
        {"egos": {"x": {"ego": "idm", "teacher._target_": ["os.system"]}}},
        {"ego": {**load_choice("ego", "external"), "command": "true"}},  # a program of the stranger's
        {"ego": {**load_choice("ego", "external"), "command": ["true"]}},
        {"ego": {**load_choice("ego", "external"), "address": "else:1"}},
        {"egos": {"x": {"ego": "external", "command": "true"}}},
        {"ego": {"_target_": POLICY_FILE, "file": "policy.pt"}},  # a TorchScript file is a program
        {"ego": {"_target_": POLICY_FILE, "file": "${seeds}"}},
        {"egos": {"x": {"ego": "policy_file", "file": "policy.pt"}}},
        {"egos": {"x": {"ego": "external", "[address]": "else:1"}}},
        {"tuning": {"space": "${oc.env:HOME}"}},
        {"methods": ["${hydra:job.name}"]},
    ],
)
def test_an_evaluation_names_no_code_in_its_changes_either(changes):
    with pytest.raises(InputError, match="runs code that is no extension of e2rl"):
        check_code(OmegaConf.merge(THEIRS, changes), [], "resume=x")


@pytest.mark.parametrize("name", ["../../stranger/evil", "/tmp/evil", "a/../b", ".hidden", "nominal,e2", "${x}", ""])
def test_a_group_s_file_is_in_its_folder(name):
    """Methods and egos of a stranger's run name files of the user's own configuration only."""
    with pytest.raises(InputError, match="no name of a file in conf/synthesizer"):
        load_choice("synthesizer", name)


def folder_of(folder, config, choices):
    """A run's folder as Hydra writes it."""
    (folder / ".hydra").mkdir(parents=True)
    OmegaConf.save(config, folder / ".hydra" / "config.yaml")
    OmegaConf.save({"hydra": {"runtime": {"choices": choices}}}, folder / ".hydra" / "hydra.yaml")
    return folder


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"a: [", "damaged"),
        (b"\xff\xfe\x00", "damaged"),
        (b"!!python/object/apply:os.system ['true']", "damaged"),
        (b"a: " + b"[" * 5000, "damaged"),
        (b"[1, 2]", "no configuration of a run"),
        (b"", "missing"),
        (b"stage: prior\nseed: 0\n", "missing"),
    ],
)
def test_a_configuration_that_is_none_is_named(tmp_path, content, what):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_bytes(content)
    config = OmegaConf.merge(OURS, {"resume": str(tmp_path)})
    with pytest.raises(InputError, match=rf"config\.yaml: .*{what}"):
        saved_configuration(config, tmp_path, {}, "resume=x")


def test_a_run_of_the_other_command_is_named(tmp_path):
    folder_of(tmp_path, OURS, {})
    with pytest.raises(InputError, match=r"of the other command.* methods"):
        saved_configuration(OmegaConf.merge(THEIRS, {"resume": str(tmp_path)}), tmp_path, {}, "resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"synthesizer": {"reasoner": {"base_url": "http://else"}}},
        {"variants": {"x": {"synthesizer.reasoner.base_url": "http://else"}}},
        {"variants": {"x": {"synthesizer": {"reasoner": {"base_url": "http://else"}}}}},
    ],
)
def test_an_endpoint_gets_no_key_unasked(tmp_path, changes):
    folder_of(tmp_path, OmegaConf.merge(THEIRS, changes), {})
    given = OmegaConf.merge(THEIRS, {"resume": str(tmp_path)})
    with pytest.raises(InputError, match="sends your API key to http://else"):
        saved_configuration(given, tmp_path, {}, "resume=x")
    agreed = OmegaConf.merge(given, {"synthesizer": {"reasoner": {"base_url": "http://else"}}})
    assert saved_configuration(agreed, tmp_path, {}, "resume=x")


def test_a_run_goes_on_with_its_own_files_of_the_groups(tmp_path):
    """Not with those of the command line, which names none."""
    space = "${tuning.spaces.${hydra:runtime.choices.ego}}"
    config = OmegaConf.merge(THEIRS, {"tuning": {"space": space, "spaces": {"sampling": {"margin": [0, 1]}}}})
    folder_of(tmp_path, config, {"ego": "sampling", "experiment": None})
    choices = saved_choices("x", tmp_path)
    saved = saved_configuration(OmegaConf.merge(THEIRS, {"resume": str(tmp_path)}), tmp_path, choices, "resume=x")
    assert choices["ego"] == "sampling" and OmegaConf.to_container(saved.tuning.space) == {"margin": [0, 1]}


SMALL_RUN = [*SHORT, "seeds=[0]", "batch=1", "processes=1", "methods=[constant_velocity,replay]"]


def test_an_evaluation_that_was_interrupted_goes_on_by_the_command_that_it_names(world, tmp_path, monkeypatch, capsys):
    """In its own folder, with its own configuration and ego; what changes its meaning is refused."""
    score, left = Setup.score, [3]

    def stopped(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return score(*arguments)

    given = [*SMALL_RUN, f"data.cache={world / 'bundled'}", "ego=idm"]
    status, said = call("evaluate.py", [*given, f"hydra.run.dir={tmp_path / 'whole'}"], monkeypatch, capsys)
    assert status == 0, said
    monkeypatch.setattr(Setup, "score", stopped)
    run = tmp_path / "run"
    status, said = call("evaluate.py", [*given, f"hydra.run.dir={run}"], monkeypatch, capsys)
    assert status == 130 and f"interrupted (SIGINT); go on with: python {ROOT}/evaluate.py resume={run}" in said
    begun = json.loads((run / "provenance.json").read_text())
    left[0] = 1
    again = [f"resume={run}", f"hydra.run.dir={tmp_path / 'other'}"]
    status, said = call("evaluate.py", [*again, "seeds=[1]"], monkeypatch, capsys)
    assert status == 2 and "leave out seeds (only processes, launcher, share can change)" in error_line(said)
    status, said = call("evaluate.py", [*again, "processes=1"], monkeypatch, capsys)
    assert status == 0 and left == [0], said
    rows = [read_rows(folder / "rollouts.csv") for folder in (tmp_path / "whole", run)]
    timed = ("seconds", "evasion_seconds")
    for row, other in zip(*rows, strict=True):
        assert row["ego_policy"] == "idm" and str({**row, **dict.fromkeys(timed)}) == str(
            {**other, **dict.fromkeys(timed)}
        )
    assert {row["command"] for row in read_metrics(run / "metrics.json")} == {begun["command"]}
    assert left_behind(tmp_path / "other") == []
