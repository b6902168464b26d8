"""Tuning on a budget of trials: studies that go on, ranges, ladders, what is written; on a problem of known answer."""

import json
import math

import pytest
from omegaconf import OmegaConf

from e2rl.evaluation.trials import PlannerObjective
from e2rl.evaluation.tuning import SearchSettings, best_of, save, search, sweep, yaml_of
from e2rl.run.config import choices, load_choice
from e2rl.run.errors import InputError

SPACE = {"speed": [0.0, 20.0], "caution": [1.0, 3.0]}
PRESENT = {"speed": 10.0, "caution": 1.0, "other": "same"}
OBJECTIVE = PlannerObjective(comfort=0.1, progress=0.1, progress_floor=0.9, comfort_ceiling=math.inf)


def road(parameters):
    """Faster collides more; caution helps and costs comfort; standing still is the safest of all."""
    speed, caution = parameters["speed"], parameters["caution"]
    assert parameters["other"] == "same"
    return {"collision": speed / 20 / caution, "comfort": caution, "progress": 8 * speed, "collision e2@2": speed / 20}


def tried(space=SPACE, evaluate=road, present=PRESENT, objective=OBJECTIVE, file=None, about=None, **settings):
    settings = SearchSettings(**{"trials": 2, "startup": 10, "sweep": 0} | settings)
    return search(evaluate, present, space, settings, objective, file, about)


def test_standing_still_and_rough_driving_are_refused_and_the_best_of_the_rest_is_kept():
    trials = tried(trials=25, startup=15, objective=PlannerObjective(0.1, 0.1, 0.9, comfort_ceiling=2.0))
    assert len(trials) == 25 and trials[0]["parameters"] == {name: PRESENT[name] for name in SPACE}
    for trial in trials:
        refused = trial["metrics"]["progress"] < 0.9 * 80 or trial["metrics"]["comfort"] > 2
        assert trial["admissible"] == (not refused)
    least = min(trials, key=lambda trial: trial["objective"])
    assert not least["admissible"] and best_of(trials)["objective"] < trials[0]["objective"]
    admissible = [trial["objective"] for trial in trials if trial["admissible"]]
    assert best_of(trials)["objective"] == min(admissible)


def test_a_study_goes_on_as_if_it_had_not_stopped(tmp_path):
    def run(name, trials, **more):
        return tried(trials=trials, startup=4, file=tmp_path / name / "study", **more)

    whole, part = run("whole", 9), run("parts", 5)
    assert len(part) == 5 and run("parts", 9) == whole == run("whole", 9) == tried(trials=9, startup=4)
    for what, more in (
        ("space", {"space": {"speed": [5.0, 20.0]}}),
        ("objective", {"objective": PlannerObjective(1.0, 0.1, 0.9, 2.0)}),
        ("scenes", {"about": {"scenes": ["a"]}}),
    ):
        with pytest.raises(InputError, match=f"differs in {what}; name another file"):
            run("parts", 12, **more)
    (tmp_path / "parts" / "study").write_text('{"task": {}, "trials": [{}]}')
    with pytest.raises(InputError, match="no study"):
        run("parts", 9)


def test_a_study_that_was_interrupted_in_the_midst_of_a_trial_equals_one_that_was_not(tmp_path):
    done = []
    for left in (6, 2, 100):
        limit = len(done) + left

        def evaluate(parameters, most=limit):
            if len(done) == most:
                raise KeyboardInterrupt
            done.append(dict(parameters))
            return road(parameters)

        try:
            found = tried(evaluate=evaluate, trials=9, startup=4, file=tmp_path / "study")
        except KeyboardInterrupt:
            assert left < 100
    assert found == tried(trials=9, startup=4) and len(done) == 9


@pytest.mark.parametrize(
    ("space", "what"),
    [
        ({}, "no ranges"),
        ({"speed": [10.1, 20.0]}, "leaves out the present value, 10"),
        ({"speed": [0.0, 20.0, "log"]}, "above 0"),
    ],
)
def test_ranges_are_checked(space, what):
    with pytest.raises(InputError, match=what):
        tried(space)


def test_whole_numbers_stay_whole_and_logarithmic_ranges_are_drawn_evenly_over_their_orders():
    whole = tried({"speed": [5, 15]}, present=PRESENT | {"speed": 10}, trials=5)
    assert all(type(trial["parameters"]["speed"]) is int for trial in whole)
    drawn = tried({"speed": [0.01, 100.0, "log"]}, trials=41, startup=41)[1:]
    orders = [math.log10(trial["parameters"]["speed"]) for trial in drawn]
    assert 8 <= sum(order < -1 for order in orders) + sum(order > 1 for order in orders) <= 32


def test_nan_of_the_present_parameters_stops_and_that_of_others_is_refused():
    def evaluate(parameters, bad=True):
        return road(parameters) | {"comfort": math.nan if (parameters["speed"] == 10.0) == bad else 1.0}

    with pytest.raises(InputError, match="NaN"):
        tried(evaluate=evaluate)
    first, second = tried(evaluate=lambda parameters: evaluate(parameters, bad=False))
    assert first["admissible"] and not second["admissible"]


def test_a_ladder_is_even_on_its_scale_and_leaves_the_others_as_they_are():
    """Ratios of a logarithmic sweep and differences of a linear one are constant; both ends are on it, the present
    value is not tried again."""
    space = {"speed": [0.5, 8.0, "log"], "caution": [1.0, 3.0]}
    rungs = sweep(PRESENT, space, 5)
    assert [rung["speed"] for rung in rungs] == pytest.approx([0.5, 1, 2, 4, 8])
    assert {rung["caution"] for rung in rungs} == {PRESENT["caution"]}
    assert sweep(PRESENT, {"speed": [1, 4]}, 4) == [{"speed": value} for value in (1, 2, 3, 4)]
    assert sweep(PRESENT, space, 0) == []
    assert [rung["speed"] for rung in sweep(PRESENT, SPACE, 3)] == [0.0, 20.0]
    rungs = sweep(PRESENT, {"speed": [10 / 7.3, 10 * 7.3, "log"]}, 3)
    assert [rung["speed"] for rung in rungs] == pytest.approx([10 / 7.3, 73])


def test_the_best_is_written_with_the_groups_of_dotted_names_and_none_where_there_is_none(tmp_path):
    rows = tried(trials=4)
    result = save([row | {"admissible": False} for row in rows], tmp_path)
    assert result["best"] is None and not (tmp_path / "tuned.yaml").exists()
    save(rows, tmp_path)
    assert json.loads((tmp_path / "tuning.json").read_text())["trials"][0]["parameters"] == rows[0]["parameters"]
    best = best_of(rows)["parameters"]
    assert dict(OmegaConf.load(tmp_path / "tuned.yaml")) == {name: pytest.approx(best[name], rel=1e-3) for name in best}
    assert yaml_of({"gain": 1.23456, "duty.patience": 2}) == "gain: 1.235\nduty:\n  patience: 2\n"


def test_every_planner_s_ranges_hold_its_present_values():
    tunable = []
    for name in choices("ego"):
        present = load_choice("ego", name)
        module, _, kind = present["_target_"].rpartition(".")
        ranges = getattr(__import__(module, fromlist=[kind]), kind).tuned
        tunable += [name] * bool(ranges)
        for parameter, (low, high, *_) in ranges.items():
            assert low <= present[parameter] <= high, f"{name}.{parameter}"
    assert tunable == ["bits", "lane_graph", "lane_graph_tuned", "sampling"]
