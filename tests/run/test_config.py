"""Files of conf/ and the classes that they name are found and built; the nearest option
is told."""

import pytest

from e2rl.planners.ego import Ego
from e2rl.run.config import CONF, built, choices, load_choice, load_config
from e2rl.run.errors import InputError
from e2rl.run.options import help_text
from e2rl.traffic.traffic import keep_velocity
from tests.scripts import call, error_line

HERE = __name__  # where `_target_` finds the classes below


def test_help_has_every_line_of_the_files_that_are_chosen(tmp_path):
    (tmp_path / "ego").mkdir()
    (tmp_path / "ego" / "mine.yaml").write_text("gap: 3  # m\n")
    text = help_text(
        "train",
        ["--config-dir", str(tmp_path), "ego=mine", "curriculum=linear", "--help"],
    )
    for file in (
        "data/bundled",
        "sim/default",
        "synthesizer/e2",
        "curriculum/linear",
        "train",
    ):
        assert (CONF / f"{file}.yaml").read_text().strip() in text
    assert "gap: 3  # m" in text
    assert all(choice in text for choice in choices("ego"))


@pytest.mark.parametrize(
    ("script", "option", "told"),
    [
        (
            "evaluate.py",
            "num_scene=3",
            "num_scene: there is no such option; did you mean num_scenes?",
        ),
        ("evaluate.py", "sim.maxacceleration=2", "did you mean sim.max_acceleration?"),
        (
            "evaluate.py",
            "ego=lanegraph",
            "ego=lanegraph: there is no such option; did you mean ego=lane_graph?",
        ),
        ("evaluate.py", "ego=cruise", "ego/cruise.yaml, with --config-dir FOLDER"),
        ("evaluate.py", "data=waymo", "did you mean data=scenarionet?"),
        (
            "evaluate.py",
            "data.path=x.zip",
            "data.path with data=argoverse2, data=commonroad, data=scenar",
        ),
        (
            "evaluate.py",
            "egos={mine:{ego:idm}}",
            "egos: what it does not have yet is added by +: '+egos=...'",
        ),
        ("evaluate.py", "eta=50", "eta=50"),
        ("evaluate.py", "curriculum=linear", "curriculum: there is no such option"),
        ("train.py", "eta=2", "or measure.eta?"),
        (
            "train.py",
            "+round=3",
            "round: there is no such option; did you mean rounds?",
        ),  # would do nothing
        (
            "train.py",
            "experiment=table1",
            "methods: there is no such option",
        ),  # of evaluate.py
    ],
)
def test_wrong_options_are_refused_with_the_nearest_name(
    tmp_path, monkeypatch, capsys, script, option, told
):
    status, said = call(
        script,
        [option, f"hydra.run.dir={tmp_path / 'run'}"],
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 2
    assert told in error_line(said)
    assert not list(tmp_path.rglob("*.json"))


def test_a_choice_is_its_file_and_an_unknown_one_lists_those_there_are():
    assert (
        load_choice("synthesizer", "e2")
        == load_config("evaluate", ["synthesizer=e2"]).synthesizer
    )
    with pytest.raises(
        InputError, match="ego=taxi: none of actor, bits, .*, sampling; add"
    ):
        load_choice("ego", "taxi")


class Cruise(Ego):
    """An ego of somebody else."""

    def __init__(self, replan_every=1, *, speed):
        super().__init__(replan_every)
        self.speed = speed

    def plan(self, world):
        return keep_velocity(world.states[:, 0])


class Unfinished(Ego):
    """It has neither `plan` nor `act`."""


class Unlicensed(Cruise):
    """Its constructor raises."""

    def __init__(self, **settings):
        raise KeyError("no licence file")


def ego_of(target):
    config = load_config(
        "evaluate",
        ["~ego", f"+ego._target_={target}", "+ego.replan_every=2", "+ego.speed=3"],
    )
    return built(config.ego, "ego", kind=Ego)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("no.such.Ego", "(?s)ego=no.such.Ego: cannot be built: .*conf/ego"),
        (
            f"{HERE}.Unfinished",
            "Unfinished: cannot be built: TypeError: Unfinished overrides neither plan nor act",
        ),
        (
            f"{HERE}.Unlicensed",
            "ego=tests.run.test_config.Unlicensed: cannot be built: KeyError: 'no licence file'; ",
        ),
        (
            "builtins.dict",
            "ego=builtins.dict: is no e2rl.planners.ego.Ego; subclass it",
        ),
    ],
)
def test_a_class_from_outside_is_built_or_named_with_the_reason(target, message):
    ego = ego_of(f"{HERE}.Cruise")
    assert isinstance(ego, Cruise)
    assert (ego.replan_every, ego.speed) == (2, 3)
    with pytest.raises(InputError, match=message):
        ego_of(target)
