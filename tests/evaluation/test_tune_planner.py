"""Tuning a planner: refused trials, and a small real run."""

from dataclasses import replace

import pytest
import torch
from omegaconf import OmegaConf

from e2rl.evaluation.protocol import Method, Setup
from e2rl.evaluation.tune_planner import Trials, outcomes
from e2rl.evaluation.tuning import Objective, TuneSettings
from e2rl.evaluation.tuning_run import run_tuning, tuning_of
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.run import config as build_config
from e2rl.run.errors import InputError
from e2rl.sim.env import SimSettings
from e2rl.traffic.rule_based import Replay
from tests.evaluation.tuned_road import PRESENT, SPACE, quiet, road
from tests.traffic.e2.traffic_scenes import scenes, synthesizer


class Cruise(Ego):
    """Holds a share of its speed."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    def plan(self, world):
        speed = self.gain * world.states[:, 0, 3:]
        return MissionPath(world).drive(speed.expand(-1, PLAN_STEPS + 1))


def test_standing_still_and_rough_driving_are_refused(tmp_path):
    settings = TuneSettings(trials=25, startup=15)
    result = quiet(road, PRESENT, SPACE, settings, tmp_path, Objective(comfort_ceiling=2.0))
    trials = result["trials"]
    assert len(trials) == 25 and trials[0]["parameters"] == {name: PRESENT[name] for name in SPACE}
    slow = [trial for trial in trials if trial["metrics"]["progress"] < 0.9 * 80]
    rough = [trial for trial in trials if trial["metrics"]["comfort"] > 2]
    assert slow and rough and not any(trial["admissible"] for trial in slow + rough)
    least = min(trials, key=lambda trial: trial["objective"])
    assert not least["admissible"] and least["metrics"]["progress"] < 0.9 * 80
    best = next(trial for trial in trials if trial["parameters"] == result["best"])
    assert best["admissible"] and best["objective"] < trials[0]["objective"]


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


class Frail(Cruise):
    """Raises in scene 1 unless it holds its speed."""

    def plan(self, world):
        if self.gain < 1 and (world.scene["scene_index"] == 1).any():
            raise KeyError("lost")
        return super().plan(world)


def test_a_trial_that_loses_rollouts_is_counted_and_refused_and_the_tuning_goes_on(tmp_path):
    setup, methods = (
        Setup(scenes(2, steps=20), Cruise(), "cruise", SimSettings(), batch=4),
        [Method("replay", Replay())],
    )
    trials = Trials(setup, methods, [0], lambda parameters: Frail(**parameters))
    settings, limits = TuneSettings(trials=3, startup=1), Objective(progress_floor=0.0)
    result = quiet(trials, {"gain": 1.0}, {"gain": [0.9, 1.0]}, settings, tmp_path, limits)
    first, *others = result["trials"]
    assert first["metrics"]["ended"] == 0.0 and first["admissible"]
    for trial in others:
        assert trial["metrics"]["ended"] == 0.5 == trial["metrics"]["ended: raised KeyError"]
        assert not trial["admissible"] and trial["metrics"]["progress"] > 0
    assert "50.0% ended for an error" in Objective().text(others[0]["metrics"])


def test_a_trial_without_any_score_is_refused_but_the_first_stops(tmp_path):
    class Lost(Cruise):
        def plan(self, world):
            raise KeyError("lost") if self.gain < 1 else ValueError("lost")

    setup, methods = Setup(scenes(1, steps=10), Cruise(), "cruise", SimSettings()), [Method("replay", Replay())]

    def result(kinds):
        make = lambda parameters: kinds[parameters["gain"] < 1](**parameters)  # noqa: E731
        trials, settings = Trials(setup, methods, [0], make), TuneSettings(trials=2, startup=1)
        return quiet(trials, {"gain": 1.0}, {"gain": [0.5, 1.0]}, settings, tmp_path, Objective())

    first, second = result([Cruise, Lost])["trials"]
    assert first["admissible"] and not second["admissible"] and second["metrics"]["ended"] == 1.0
    with pytest.raises(InputError, match=r"NaN metrics .ended: raised ValueError"):
        result([Lost, Lost])


def tuned(config, *run):
    return run_tuning(config, tuning_of(config), *run)


def test_the_configuration_builds_the_planner_under_trial(tmp_path):
    config = build_config.load_config("evaluate", ["ego=lane_graph", "seeds=[0]", "processes=1"])
    tuning = {"group": "ego", "trials": 1, "seed": 0, "startup": 1, "study": None, "space": {"max_risk": [0.05, 0.2]}}
    config.tuning = OmegaConf.create(tuning)
    on = synthesizer()
    setup = Setup(scenes(1, steps=10), Cruise(), "lane_graph", SimSettings())
    result = tuned(config, setup, [Method("nominal", on)], on.prior, tmp_path)
    assert result["best"] == {"max_risk": 0.1} and (tmp_path / "tuned.yaml").read_text() == "max_risk: 0.1\n"
    config.tuning = OmegaConf.create(tuning | {"depth": 3})
    with pytest.raises(InputError, match="depth"):
        tuned(config, setup, [Method("nominal", on)], on.prior, tmp_path)


def test_every_planner_s_ranges_hold_its_present_values():
    """A trial of the present parameters is the planner of conf/ego."""
    spaces = OmegaConf.load(build_config.conf_folder() / "experiment" / "tune_planner.yaml").tuning.spaces
    assert set(spaces) == {"lane_graph", "lane_graph_tuned", "sampling", "bits"}
    for name, space in spaces.items():
        present = build_config.load_choice("ego", name)
        for parameter, (low, high, *_) in space.items():
            assert low <= present[parameter] <= high, f"{name}.{parameter}"
