"""`--help` prints the comments of all options; an option that is none is refused with the nearest name."""

import sys

import pytest

from e2rl.run.config import added_by_mistake, choices, conf_folder, help_text, mistyped
from tests.scripts import call

MISTYPED = [
    ("evaluate", ["num_scene=3"], "num_scene: there is no such option; the nearest is num_scenes"),
    ("evaluate", ["ego.replan_evry=2"], "the nearest is ego.replan_every"),
    ("evaluate", ["sim.maxacceleration=2"], "the nearest is sim."),
    ("evaluate", ["ego=lanegraph"], "ego=lanegraph: there is no such option; the nearest is lane_graph"),
    ("train", ["curriculum=adaptiv", "rounds=2"], "the nearest is adaptive"),
    ("train", ["learner.ppo.gentl=1"], "the nearest is learner.ppo.gentle"),
    ("train", ["experiment=table1"], "experiment: there is no such option"),  # a group of evaluate.py alone
    ("evaluate", ["curriculum=linear"], "curriculum: there is no such option"),
    ("train", ["recipe=hardn"], "the nearest is harden"),
]


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_help_has_every_line_of_the_files_that_are_in_force(name):
    text = help_text(name, ["--help"])
    for file in ("data/bundled", "sim/default", "prior/default", "synthesizer/e2", name):
        assert (conf_folder() / f"{file}.yaml").read_text().strip() in text
    assert all(choice in text for choice in choices("ego"))


def test_help_follows_the_choices_on_the_command_line(tmp_path):
    text = help_text("train", ["--help", "learner=ppo_taught"])
    for file in ("ppo_taught", "ppo_bc"):  # and what it builds on
        assert (conf_folder() / "learner" / f"{file}.yaml").read_text().strip() in text
    (tmp_path / "ego").mkdir()
    (tmp_path / "ego" / "mine.yaml").write_text("gap: 3  # m\n")
    assert "gap: 3  # m" in help_text("evaluate", ["--config-dir", str(tmp_path), "ego=mine", "--help"])


@pytest.mark.parametrize(("name", "arguments", "told"), MISTYPED)
def test_the_nearest_name_is_told(name, arguments, told):
    (wrong,) = mistyped(name, arguments)
    assert told in wrong


RIGHT = [["num_scenes=3", "ego=idm", "sim.max_acceleration=2"], ["hydra.run.dir=x"], ["--config-dir=mine", "ego=mine"]]


@pytest.mark.parametrize("arguments", RIGHT)
def test_right_options_are_no_mistake(arguments):
    assert mistyped("evaluate", arguments) == []


def test_an_added_key_that_looks_like_one_there_is_would_do_nothing():
    assert "the nearest is num_scenes" in added_by_mistake("evaluate", ["+num_scene=1"])[0]
    kept = [
        "+variants.a={synthesizer.support: random}",
        "+egos.b={ego: idm}",
        "+experiment=table1",
        "+mine=1",
        "seeds=[0]",
    ]
    assert added_by_mistake("evaluate", kept) == []


@pytest.mark.parametrize(("script", "option"), [("evaluate.py", "num_scene=3"), ("train.py", "+round=3")])
def test_the_scripts_say_it_and_write_nothing(tmp_path, monkeypatch, capsys, script, option):
    status, said = call(script, [option, f"hydra.run.dir={tmp_path / 'run'}"], monkeypatch, capsys)
    assert status in (1, 2) and "the nearest is" in said.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def test_help_ends_well(monkeypatch, capsys):
    status, _ = call("evaluate.py", ["--help"], monkeypatch, capsys)
    assert status == 0 and "evaluate" in sys.argv[0]
