"""Tuning on a budget of trials: studies that go on, ranges, ladders, what is written;
on a problem of known answer."""

import copy
import json
import math
import os
import sqlite3

import pytest
from omegaconf import OmegaConf

from e2rl.evaluation.trials import PlannerObjective
from e2rl.evaluation.tuning import SearchSettings, best_of, save, search, sweep, yaml_of
from e2rl.run.config import choices, load_choice
from e2rl.run.errors import InputError

SPACE = {"speed": [0.0, 20.0], "caution": [1.0, 3.0]}
PRESENT = {"speed": 10.0, "caution": 1.0, "other": "same"}
OBJECTIVE = PlannerObjective(
    comfort=0.1, progress=0.1, progress_floor=0.9, comfort_ceiling=math.inf
)


def road(parameters):
    """Faster collides more; caution helps and costs comfort; standing still is the
    safest of all."""
    speed = parameters["speed"]
    caution = parameters["caution"]
    assert parameters["other"] == "same"
    return {
        "collision": speed / 20 / caution,
        "comfort": caution,
        "progress": 8 * speed,
        "collision e2@2": speed / 20,
    }


def tried(
    space=SPACE,
    evaluate=road,
    present=PRESENT,
    objective=OBJECTIVE,
    file=None,
    about=None,
    **settings,
):
    settings = SearchSettings(**{"trials": 2, "startup": 10, "sweep": 0} | settings)
    return search(
        evaluate,
        present,
        space=space,
        settings=settings,
        objective=objective,
        file=file,
        about=about,
    )


def test_standing_still_and_rough_driving_are_refused_and_the_best_of_the_rest_is_kept():
    trials = tried(
        trials=25,
        startup=15,
        objective=PlannerObjective(0.1, 0.1, progress_floor=0.9, comfort_ceiling=2.0),
    )
    assert len(trials) == 25
    assert trials[0]["parameters"] == {name: PRESENT[name] for name in SPACE}
    for trial in trials:
        refused = (
            trial["metrics"]["progress"] < 0.9 * 80 or trial["metrics"]["comfort"] > 2
        )
        assert trial["admissible"] == (not refused)
    least = min(trials, key=lambda trial: trial["objective"])
    assert not least["admissible"]
    assert best_of(trials)["objective"] < trials[0]["objective"]
    admissible = [trial["objective"] for trial in trials if trial["admissible"]]
    assert best_of(trials)["objective"] == min(admissible)


def test_a_study_goes_on_as_if_it_had_not_stopped_nor_been_interrupted_in_a_trial(
    tmp_path,
):
    def run(name, trials, **more):
        return tried(trials=trials, startup=4, file=tmp_path / name / "study", **more)

    def dies(parameters):
        raise KeyboardInterrupt

    whole = run("whole", 9)
    part = run("parts", 5)
    with pytest.raises(KeyboardInterrupt):
        run("parts", 9, evaluate=dies)
    assert len(part) == 5
    assert run("parts", 9) == whole == run("whole", 9) == tried(trials=9, startup=4)
    for content, more in (
        ("space", {"space": {"speed": [5.0, 20.0]}}),
        (
            "objective",
            {
                "objective": PlannerObjective(
                    1.0, 0.1, progress_floor=0.9, comfort_ceiling=2.0
                )
            },
        ),
        ("scenes", {"about": {"scenes": ["a"]}}),
    ):
        with pytest.raises(
            InputError, match=f"differs in {content}; name another file"
        ):
            run("parts", 12, **more)


def test_a_file_that_is_no_study_stays_as_it_is(tmp_path):
    database = sqlite3.connect(tmp_path / "trips.sqlite")
    database.execute("create table trips (x)")
    database.executemany(
        "insert into trips values (?)", [(str(k) * 100,) for k in range(100)]
    )
    database.commit()
    database.close()
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("no line ends")
    (tmp_path / "notes.json").write_text('{"task": {}, "trials": [], "mine": 1}')
    (tmp_path / "link").symlink_to(tmp_path / "notes.json")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "empty").touch()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for path in [*tmp_path.iterdir(), tmp_path / "thesis" / "chapter.tex"]:
        with pytest.raises(
            InputError, match=rf"^tuning.study={path}: .*name another file$"
        ):
            tried(file=path)
    assert {
        path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()
    } == files


def replaced(value, odd):
    """Every content that differs from a JSON one in one node, which is odd, or missing."""
    if isinstance(value, dict | list):
        for name in value if isinstance(value, dict) else range(len(value)):
            for changed in replaced(value[name], odd):
                other = copy.deepcopy(value)
                other[name] = changed
                yield other
            other = copy.deepcopy(value)
            del other[name]
            yield other
    yield from odd


def test_every_damage_to_a_study_is_one_clear_line_or_changes_nothing_that_counts(
    tmp_path,
):
    file = tmp_path / "study"
    tried(trials=3, file=file)
    odd = [None, True, "x", "\ud800", -1, 10**400, 1e999, [], {}, [[1]], {"x": 1}]
    for content in replaced(json.loads(file.read_text()), odd):
        file.write_text(json.dumps(content))
        before = file.read_bytes()
        try:
            rows = tried(trials=4, file=file)
            save(rows, tmp_path)
        except InputError as error:
            assert str(error).startswith(f"tuning.study={file}: ")
            assert file.read_bytes() == before
        else:
            assert all(set(row["parameters"]) == set(SPACE) for row in rows)
    file.write_text("[" * 10**5)
    with pytest.raises(InputError, match="no study"):
        tried(file=file)


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
    assert (
        8
        <= sum(order < -1 for order in orders) + sum(order > 1 for order in orders)
        <= 32
    )


def test_nan_of_the_present_parameters_stops_and_that_of_others_is_refused():
    def evaluate(parameters, bad=True):
        return road(parameters) | {
            "comfort": math.nan if (parameters["speed"] == 10.0) == bad else 1.0
        }

    with pytest.raises(InputError, match="NaN"):
        tried(evaluate=evaluate)
    first, second = tried(evaluate=lambda parameters: evaluate(parameters, bad=False))
    assert first["admissible"]
    assert not second["admissible"]


def test_a_ladder_is_even_on_its_scale_and_leaves_the_others_as_they_are():
    """Ratios of a logarithmic sweep and differences of a linear one are constant; both
    ends are on it, the present value is not tried again."""
    space = {"speed": [0.5, 8.0, "log"], "caution": [1.0, 3.0]}
    rungs = sweep(PRESENT, space, count=5)
    assert [rung["speed"] for rung in rungs] == pytest.approx([0.5, 1, 2, 4, 8])
    assert {rung["caution"] for rung in rungs} == {PRESENT["caution"]}
    assert sweep(PRESENT, {"speed": [1, 4]}, count=4) == [
        {"speed": value} for value in (1, 2, 3, 4)
    ]
    assert sweep(PRESENT, space, count=0) == []
    assert [rung["speed"] for rung in sweep(PRESENT, SPACE, count=3)] == [0.0, 20.0]
    rungs = sweep(PRESENT, {"speed": [10 / 7.3, 10 * 7.3, "log"]}, count=3)
    assert [rung["speed"] for rung in rungs] == pytest.approx([10 / 7.3, 73])


def test_the_best_is_written_with_the_groups_of_dotted_names_and_none_where_there_is_none(
    tmp_path,
):
    rows = tried(trials=4)
    result = save([row | {"admissible": False} for row in rows], tmp_path)
    assert result["best"] is None
    assert not (tmp_path / "tuned.yaml").exists()
    save(rows, tmp_path)
    assert (
        json.loads((tmp_path / "tuning.json").read_text())["trials"][0]["parameters"]
        == rows[0]["parameters"]
    )
    best = best_of(rows)["parameters"]
    assert dict(OmegaConf.load(tmp_path / "tuned.yaml")) == {
        name: pytest.approx(best[name], rel=1e-3) for name in best
    }
    assert (
        yaml_of({"gain": 1.23456, "duty.patience": 2})
        == "gain: 1.235\nduty:\n  patience: 2\n"
    )


def test_every_planner_s_ranges_hold_its_present_values():
    tunable = []
    for name in set(choices("ego")) - {"class"}:  # which names no planner by itself
        present = load_choice("ego", name)
        module, _, kind = present["_target_"].rpartition(".")
        ranges = getattr(__import__(module, fromlist=[kind]), kind).tuned
        tunable += [name] * bool(ranges)
        for parameter, (low, high, *_) in ranges.items():
            assert low <= present[parameter] <= high, f"{name}.{parameter}"
    assert sorted(tunable) == ["bits", "lane_graph", "lane_graph_tuned", "sampling"]
