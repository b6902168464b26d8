"""The best admissible trial wins, standing still does not, and the whole grid is reported."""

import pytest

from e2rl.evaluation.tuning import Objective
from e2rl.learning.planner_tuning import combinations, tune
from e2rl.run.errors import InputError

PRESENT = {"speed": 10.0, "caution": 1.0, "other": "kept"}


def road(parameters):
    """Faster collides more; caution helps and costs comfort; standing still is the safest of all."""
    speed, caution = parameters["speed"], parameters["caution"]
    return {"collision": speed / 20 / caution, "comfort": 0.5 * caution, "progress": 8 * speed, "speed": speed}


def test_standing_still_is_refused_though_its_objective_is_the_least():
    tuning = tune(road, PRESENT, {"speed": [0.0, 9.5, 10.0, 15.0], "caution": [1.0, 2.0]})
    least = min(tuning.trials, key=lambda trial: trial["objective"])
    assert least["parameters"]["speed"] == 0.0 and not least["admissible"]
    assert tuning.best == {"speed": 9.5, "caution": 2.0, "other": "kept"}


def test_every_combination_is_tried_once_the_present_one_first():
    seen = []
    tuning = tune(
        lambda p: seen.append((p["speed"], p["caution"])) or road(p),
        PRESENT,
        {"speed": [5.0, 10.0], "caution": [1.0, 2.0]},
    )
    assert seen[0] == (10.0, 1.0) and len(seen) == len(set(seen)) == len(tuning.trials) == 4
    columns = {"parameters", "collision", "comfort", "progress", "speed", "objective", "admissible"}
    assert set(tuning.trials[0]) == columns


def test_objective_is_collision_comfort_and_lost_progress():
    trial = tune(road, PRESENT, {"speed": [5.0]}, Objective(comfort=0.2, progress=0.4)).trials[1]
    assert trial["objective"] == pytest.approx(0.25 + 0.2 * 0.5 + 0.4 * 0.5)


def test_the_present_parameters_stay_where_nothing_is_better():
    worse = tune(
        lambda p: {"collision": p["speed"] - 10, "comfort": 0.0, "progress": 1.0}, PRESENT, {"speed": [10, 11]}
    )
    assert worse.best == PRESENT
    nan = tune(
        lambda p: {"collision": 0.1 if p["speed"] == 10.0 else float("nan"), "comfort": 0.0, "progress": 1.0},
        PRESENT,
        {"speed": [10.0, 11.0]},
    )
    assert nan.best == PRESENT and not nan.trials[1]["admissible"]


def test_grids_and_metrics_are_checked():
    assert combinations({"a": [1, 2], "b": [3]}) == [{"a": 1, "b": 3}, {"a": 2, "b": 3}]
    with pytest.raises(InputError, match="caution"):
        combinations({"speed": [1.0], "caution": []})
    with pytest.raises(InputError, match="progress"):
        tune(lambda p: {"collision": 0.0, "comfort": 0.0}, PRESENT, {"speed": [1.0]})
