"""`--help` prints the comments of all options; an option that is none is refused with the nearest name; classes of
others are built or named."""

import pytest

from e2rl.planners.ego import Ego
from e2rl.run.config import (
    added_by_mistake,
    built,
    choices,
    conf_folder,
    help_text,
    load_choice,
    load_config,
    mistyped,
    of_another_command,
)
from e2rl.run.errors import InputError
from e2rl.traffic.traffic import keep_velocity
from tests.scripts import call

HERE = __name__  # where `_target_` finds the classes below
MISTYPED = [
    ("evaluate", ["num_scene=3"], "num_scene: there is no such option; the nearest is num_scenes"),
    ("evaluate", ["ego.replan_evry=2"], "the nearest is ego.replan_every"),
    ("evaluate", ["sim.maxacceleration=2"], "the nearest is sim."),
    ("evaluate", ["ego=lanegraph"], "ego=lanegraph: there is no such option; the nearest is lane_graph"),
    ("evaluate", ["curriculum=linear"], "curriculum: there is no such option"),
    ("train", ["curriculum=adaptiv", "rounds=2"], "the nearest is adaptive"),
    ("prior_tables", ["meta_rolouts=2"], "the nearest is meta_rollouts"),
]


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_help_has_every_line_of_the_files_that_are_in_force(name):
    text = help_text(name, ["--help"])
    for file in ("data/bundled", "sim/default", "prior/default", "synthesizer/e2", name):
        assert (conf_folder() / f"{file}.yaml").read_text().strip() in text
    assert all(choice in text for choice in choices("ego"))


def test_help_follows_the_choices_on_the_command_line(tmp_path):
    text = help_text("train", ["--help", "curriculum=bandit"])
    assert (conf_folder() / "curriculum" / "bandit.yaml").read_text().strip() in text
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


def test_an_experiment_of_the_other_command_is_named():
    assert of_another_command("train", ["experiment=table1"]) == ["experiment=table1: of evaluate.py, not train.py"]
    assert of_another_command("evaluate", ["experiment=harden"]) == ["experiment=harden: of train.py, not evaluate.py"]
    assert not of_another_command("train", ["experiment=harden", "rounds=2"])
    assert not any(of_another_command("evaluate", [f"experiment={name}"]) for name in ("table1", "curves", "prior"))


def test_an_added_key_that_looks_like_one_there_is_would_do_nothing():
    assert "the nearest is num_scenes" in added_by_mistake("evaluate", ["+num_scene=1"])[0]
    right = ["+variants.a={synthesizer.support: random}", "+egos.b={ego: idm}", "+experiment=table1", "+mine=1"]
    assert added_by_mistake("evaluate", right) == []


@pytest.mark.parametrize(("script", "option"), [("evaluate.py", "num_scene=3"), ("train.py", "+round=3")])
def test_the_scripts_say_it_and_write_nothing(tmp_path, monkeypatch, capsys, script, option):
    status, said = call(script, [option, f"hydra.run.dir={tmp_path / 'run'}"], monkeypatch, capsys)
    assert status == 2 and "the nearest is" in said.splitlines()[-1] and not (tmp_path / "run").exists()


def test_a_choice_is_its_file_and_an_unknown_one_lists_those_there_are():
    assert load_choice("synthesizer", "e2") == load_config("evaluate", ["synthesizer=e2"]).synthesizer
    with pytest.raises(InputError, match="ego=taxi: none of actor, bits, .*, sampling; add"):
        load_choice("ego", "taxi")


class Cruise(Ego):
    """An ego of somebody else."""

    def __init__(self, replan_every=1, *, speed):
        super().__init__(replan_every)
        self.speed = speed

    def plan(self, world):
        return keep_velocity(world.states[:, 0])


class Unfinished(Ego):
    """It has no `plan`."""


class Refusing(Cruise):
    def __init__(self, speed):
        raise InputError(f"speed={speed}: too fast")


def test_classes_from_outside_are_built_from_their_settings():
    config = load_config("evaluate", ["~ego", f"+ego._target_={HERE}.Cruise", "+ego.replan_every=2", "+ego.speed=3"])
    ego = built(config.ego, "ego", Ego)
    assert isinstance(ego, Cruise) and (ego.replan_every, ego.speed) == (2, 3)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("no.such.Ego", "(?s)ego=no.such.Ego: cannot be built: .*conf/ego"),
        (f"{HERE}.Missing", f"ego={HERE}.Missing: cannot be built: "),
        (f"{HERE}.Unfinished", "Unfinished: cannot be built: .*"),
        (f"{HERE}.Refusing", "^speed=3: too fast"),
        ("builtins.dict", "ego=builtins.dict: is no e2rl.planners.ego.Ego; subclass it"),
    ],
)
def test_a_class_that_cannot_be_built_is_named_with_the_reason(target, message):
    config = load_config("evaluate", ["~ego", f"+ego._target_={target}", "+ego.speed=3"])
    with pytest.raises(InputError, match=message):
        built(config.ego, "ego", Ego)
