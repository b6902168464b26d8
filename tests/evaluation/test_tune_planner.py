"""Tuning a planner: refused trials, studies that go on, what is written, and a small real run."""

import builtins
import json
from dataclasses import replace

import pytest
import torch
from omegaconf import OmegaConf

from e2rl import build
from e2rl.ego.base import PLAN_STEPS, Ego
from e2rl.ego.path import MissionPath
from e2rl.errors import InputError
from e2rl.evaluation.objective import Objective
from e2rl.evaluation.protocol import Method, Setup
from e2rl.evaluation.tune_planner import Trials, TuneSettings, outcomes, tune_planner
from e2rl.sim.env import SimSettings
from tests.synthesizer.traffic_scenes import scenes, synthesizer

SPACE = {"speed": [0.0, 20.0], "caution": [1.0, 3.0]}
PRESENT = {"speed": 10.0, "caution": 1.0, "other": "kept"}


def road(parameters):
    """Faster collides more; caution helps and costs comfort; standing still is the safest of all."""
    speed, caution = parameters["speed"], parameters["caution"]
    assert parameters["other"] == "kept"
    return {"collision": speed / 20 / caution, "comfort": caution, "progress": 8 * speed, "collision e2@2": speed / 20}


class Cruise(Ego):
    """Holds a share of its speed."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    def plan(self, world):
        speed = self.gain * world.states[:, 0, 3:]
        return MissionPath(world).drive(speed.expand(-1, PLAN_STEPS + 1))


def quiet(*args, **kwargs):
    return tune_planner(*args, **kwargs, say=lambda line: None)


def test_standing_still_and_rough_driving_are_refused(tmp_path):
    settings = TuneSettings(trials=25, startup=15, objective=Objective(comfort_ceiling=2.0))
    result = quiet(road, PRESENT, SPACE, settings, tmp_path)
    trials = result["trials"]
    assert len(trials) == 25 and trials[0]["parameters"] == {name: PRESENT[name] for name in SPACE}
    slow = [trial for trial in trials if trial["metrics"]["progress"] < 0.9 * 80]
    rough = [trial for trial in trials if trial["metrics"]["comfort"] > 2]
    assert slow and rough and not any(trial["admissible"] for trial in slow + rough)
    least = min(trials, key=lambda trial: trial["objective"])
    assert not least["admissible"] and least["metrics"]["progress"] < 0.9 * 80
    best = next(trial for trial in trials if trial["parameters"] == result["best"])
    assert best["admissible"] and best["objective"] < trials[0]["objective"]


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
    with pytest.raises(InputError, match="another planner, space or data"):
        run("parts", 12, {"speed": [5.0, 20.0]})


def test_ranges_are_checked(tmp_path):
    for space, what in (
        ({}, "empty"),
        ({"depth": [1, 2]}, "depth is no parameter"),
        ({"speed": [12.0, 20.0]}, "leaves out the present value, 10"),
        ({"speed": [20.0, 0.0]}, r"expected \[low, high\]"),
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


def test_every_trial_meets_traffic_made_against_it(tmp_path):
    """Real rollouts: the present planner, then others; an ego that stands is refused, and no attack is replayed."""
    made = []

    class Watched(type(synthesizer())):
        def replan(self, state, world, ego_plan):
            made.append(ego_plan[:, -1, :2].clone())
            return super().replan(state, world, ego_plan)

    on = Watched(synthesizer().prior)
    setup = Setup(scenes(2, steps=20), Cruise(), "cruise", SimSettings(), batch=4)
    methods = [Method("nominal", on), Method("e2", on, 2.0)]
    trials = Trials(setup, methods, [0], lambda parameters: Cruise(**parameters))
    result = quiet(trials, {"gain": 1.0}, {"gain": [0.0, 1.0]}, TuneSettings(trials=3, startup=1), tmp_path)
    first, *others = result["trials"]
    assert {"collision", "comfort", "progress", "collision nominal@0", "collision e2@2"} <= set(first["metrics"])
    assert first["admissible"] and first["metrics"]["progress"] > 15
    assert not any(trial["admissible"] for trial in others if trial["parameters"]["gain"] < 0.5)
    assert len(made) >= 3 * 2 and not torch.allclose(made[0], made[-1])


def test_leaving_the_road_counts_as_a_collision():
    scene_set = scenes(1, steps=20)
    off = replace(scene_set, scenes=scene_set.scenes.clone())
    off.scenes["field"][:] = torch.where(torch.arange(off.scenes["field"].shape[1])[:, None] < 85, -1.0, 1.0)
    method = Method("nominal", synthesizer())
    for each, expected in ((scene_set, 0.0), (off, 1.0)):
        setup = Setup(each, Cruise(0.9), "cruise", SimSettings())
        assert outcomes(setup, method, [(0, 0)])[0]["collision"] == expected


def test_the_configuration_builds_the_planner_under_trial(tmp_path):
    config = build.load_config("evaluate", ["ego=lane_graph", "seeds=[0]", "processes=1"])
    tuning = {"trials": 1, "seed": 0, "startup": 1, "study": None, "space": {"max_risk": [0.05, 0.2]}}
    config.tuning = OmegaConf.create(tuning)
    on = synthesizer()
    setup = Setup(scenes(1, steps=10), Cruise(), "lane_graph", SimSettings())
    result = build.tune(config, setup, [Method("nominal", on)], tmp_path)
    assert result["best"] == {"max_risk": 0.1} and (tmp_path / "tuned.yaml").read_text() == "max_risk: 0.1\n"
    config.tuning = OmegaConf.create(tuning | {"depth": 3})
    with pytest.raises(InputError, match="depth"):
        build.tune(config, setup, [Method("nominal", on)], tmp_path)
