"""Tuning on a budget of trials: studies that go on, ranges, ladders, what is written."""

import builtins
import json
import math
import os

import pytest
from omegaconf import OmegaConf

from e2rl.evaluation import tuning
from e2rl.evaluation.tuning import Objective, TuneSettings, ladder, tune, yaml_of
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from tests.evaluation.tuned_road import PRESENT, SPACE, quiet, road


def test_a_study_goes_on_as_if_it_had_not_stopped(tmp_path):
    def run(name, trials, space=SPACE):
        settings = TuneSettings(trials=trials, startup=4, study=str(tmp_path / name / "study"))
        return quiet(road, PRESENT, space, settings, tmp_path)

    whole, part = run("whole", 9), run("parts", 5)
    assert len(part["trials"]) == 5
    assert run("parts", 9) == whole == run("whole", 9)
    assert json.loads((tmp_path / "tuning.json").read_text())["best"] == whole["best"]
    lines = OmegaConf.load(tmp_path / "tuned.yaml")
    assert {name: pytest.approx(value, rel=1e-3) for name, value in whole["best"].items()} == dict(lines)
    with pytest.raises(InputError, match="differs in space; name"):
        run("parts", 12, {"speed": [5.0, 20.0]})


def test_ranges_are_checked(tmp_path):
    for space, what in (
        ({}, "empty"),
        ({"depth": [1, 2]}, "depth is none of the parameters"),
        ({"speed": [12.0, 20.0]}, "leaves out the present value, 10"),
        ({"speed": [20.0, 0.0]}, r"expected \[low, high\]"),
        ({"speed": [0.0, 20.0, "log"]}, "begins above 0"),
        ({"speed": [1.0, 20.0, "wide"]}, r"or \[low, high, log\]"),
    ):
        with pytest.raises(InputError, match=what):
            quiet(road, PRESENT, space, TuneSettings(), tmp_path)


def test_whole_numbers_stay_whole(tmp_path):
    seen = []

    def evaluate(parameters):
        seen.append(parameters["speed"])
        return road(parameters)

    quiet(evaluate, PRESENT | {"speed": 10}, {"speed": [5, 15]}, TuneSettings(trials=4), tmp_path)
    assert all(isinstance(value, int) for value in seen)


def test_nan_stops(tmp_path):
    with pytest.raises(InputError, match="NaN"):
        quiet(lambda p: road(p) | {"comfort": float("nan")}, PRESENT, SPACE, TuneSettings(), tmp_path)


def test_without_optuna_it_says_what_to_install(tmp_path, monkeypatch):
    load = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "optuna":
            raise ImportError(name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"pip install 'e2rl\[tune\]'"):
        quiet(road, PRESENT, SPACE, TuneSettings(), tmp_path)


def test_another_objective_or_other_scenes_are_another_study(tmp_path):
    settings = TuneSettings(trials=1, study=str(tmp_path / "study"))
    quiet(road, PRESENT, SPACE, settings, tmp_path, about={"scenes": ["a"]})
    for what, more in (
        ("objective", {"objective": Objective(comfort=1.0), "about": {"scenes": ["a"]}}),
        ("scenes", {}),
    ):
        with pytest.raises(InputError, match=f"differs in {what}; name another file"):
            quiet(road, PRESENT, SPACE, settings, tmp_path, **more)


def test_a_ladder_is_even_on_its_scale_and_leaves_the_others_as_they_are():
    """Ratios of a logarithmic ladder and differences of a linear one are constant; both ends are on it."""
    space = {"speed": [0.5, 8.0, "log"], "caution": [1.0, 3.0]}
    rungs = ladder(PRESENT, space, 5)
    assert [rung["speed"] for rung in rungs] == pytest.approx([0.5, 1, 2, 4, 8])
    assert {rung["caution"] for rung in rungs} == {PRESENT["caution"]}
    assert [rung["speed"] for rung in ladder(PRESENT, SPACE, 2)] == [0.0, 20.0]
    assert ladder(PRESENT, {"speed": [1, 4]}, 4) == [{"speed": value} for value in (1, 2, 3, 4)]
    assert ladder(PRESENT, space, 0) == []


def test_a_ladder_does_not_try_the_present_value_again():
    """On a linear and on a logarithmic scale, where the middle of a range is not met to the last bit."""
    assert [rung["speed"] for rung in ladder(PRESENT, SPACE, 3)] == [0.0, 20.0]
    rungs = ladder(PRESENT, {"speed": [10 / 7.3, 10 * 7.3, "log"]}, 3)
    assert [rung["speed"] for rung in rungs] == pytest.approx([10 / 7.3, 73])


def test_the_ladder_comes_first_and_counts_as_trials(tmp_path):
    space = {"speed": [1.0, 16.0, "log"], "caution": [1.0, 3.0]}
    trials = quiet(road, PRESENT, space, TuneSettings(trials=7, startup=7, ladder=5), tmp_path)["trials"]
    assert [trial["parameters"]["speed"] for trial in trials[:6]] == pytest.approx([10, 1, 2, 4, 8, 16])
    assert len(trials) == 7 and trials[6]["parameters"]["caution"] != PRESENT["caution"]


def test_a_logarithmic_range_is_drawn_evenly_over_its_orders_of_magnitude(tmp_path):
    space = {"speed": [0.01, 100.0, "log"]}
    trials = quiet(road, PRESENT, space, TuneSettings(trials=41, startup=41), tmp_path)["trials"][1:]
    orders = [math.log10(trial["parameters"]["speed"]) for trial in trials]
    assert 8 <= sum(order < -1 for order in orders) + sum(order > 1 for order in orders) <= 32


def test_where_no_trial_is_admissible_nothing_is_kept(tmp_path):
    class Strict(Objective):
        def judge(self, metrics, reference):
            return super().judge(metrics, reference)[0], 1.0

    result = quiet(road, PRESENT, SPACE, TuneSettings(trials=2), tmp_path, Strict())
    assert result["best"] is None and len(result["trials"]) == 2
    assert json.loads((tmp_path / "tuning.json").read_text())["best"] is None
    assert not (tmp_path / "tuned.yaml").exists()


def test_dotted_names_are_written_as_groups():
    assert yaml_of({"gain": 1.23456, "care.patience": 2}) == "gain: 1.235\ncare:\n  patience: 2\n"


@pytest.mark.parametrize("study", [None, "study"])
@pytest.mark.parametrize("stops", [(0,), (3,), (6, 2)])
def test_a_tuning_that_was_interrupted_equals_one_that_was_not(tmp_path, study, stops):
    """In the midst of a trial; in a file of one's own the study even holds the trial that was begun."""

    def run(name, stops):
        folder, done = tmp_path / name, []
        file = None if study is None else str(tmp_path / name / study)
        for left in (*stops, 100):
            begun = len(done)

            def evaluate(parameters, most=begun + left):
                if len(done) == most:
                    raise KeyboardInterrupt
                done.append(dict(parameters))
                return road(parameters)

            settings = TuneSettings(trials=9, startup=4, study=file)
            try:
                found = tune(
                    evaluate, PRESENT, SPACE, settings, Objective(), folder, say=lambda line: None, kept=Parts(folder)
                )
            except KeyboardInterrupt:
                assert left < 100
        return found, done, (folder / "tuning.json").read_bytes()

    whole, parts = run("whole", ()), run("parts", stops)
    assert parts == whole and len(parts[1]) == 9


def test_a_study_is_read_though_its_last_writer_was_killed(tmp_path, monkeypatch):
    """Half a line is cut off, the lock of the dead is broken, also by a relative path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tuning, "LOCK_GRACE", 3)
    settings = [TuneSettings(trials=trials, startup=2, study="runs/study") for trials in (3, 4)]
    first = quiet(road, PRESENT, SPACE, settings[0], tmp_path)
    with (tmp_path / "runs" / "study").open("a") as file:
        file.write('{"op_code":4,"worker')
    os.symlink(tmp_path / "runs" / "study", tmp_path / "runs" / "study.lock")
    found = quiet(road, PRESENT, SPACE, settings[1], tmp_path)
    assert found["trials"][:3] == first["trials"] and len(found["trials"]) == 4
    whole = TuneSettings(trials=4, startup=2, study=None)
    assert quiet(road, PRESENT, SPACE, whole, tmp_path) == found
