"""The update of a planner: grid search over its parameters on the round's adversarial and nominal scenes.

The paper tunes its lane-graph planner in this way. Progress has a floor, because standing still is the trivial
optimum of safety and comfort.
"""

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import Any

from tqdm import tqdm

from e2rl.evaluation.tuning import Objective
from e2rl.learning.attack import counted
from e2rl.learning.driving import Episodes, PoolDriver
from e2rl.learning.improvement import Improvement
from e2rl.learning.scheduler import CurriculumScheduler
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.run.settings import settings_of
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import Traffic

Parameters = dict[str, Any]


@dataclass
class Tuning:
    """Result: the best parameters, and one row per trial (parameters, metrics, objective, admissible), the present
    parameters first."""

    best: Parameters
    trials: list[dict]


def combinations(grid: Mapping[str, Sequence]) -> list[Parameters]:
    """Every combination of a grid {name: values}; raises InputError for a name without values."""
    empty = [name for name, values in grid.items() if not len(values)]
    if not grid or empty:
        raise InputError(f"learner.grid: {', '.join(empty) or 'it is empty'}; give each parameter a list of values")
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def tune(
    evaluate: Callable[[Parameters], Mapping[str, float]],
    present: Parameters,
    grid: Mapping[str, Sequence],
    objective: Objective | None = None,
) -> Tuning:
    """Try the present parameters, then the whole grid; keep the best admissible trial, the present one in a tie.

    evaluate(parameters) -> metrics with "collision" (rate), "comfort" (mean |acceleration|, m/s^2) and "progress" (m);
    further ones are logged. What is minimised and what is refused: `Objective`.
    """
    objective = objective or Objective()
    trials: list[dict] = []
    tried = [present]
    tried += [present | choice for choice in combinations(grid) if present | choice != present]
    for parameters in tqdm(tried, "planner tuning", unit="trial", leave=False, disable=None):
        metrics = dict(evaluate(parameters))
        value, excess = objective.judge(metrics, trials[0] if trials else metrics)
        trials.append({"parameters": parameters, **metrics, "objective": value, "admissible": excess == 0})
    if math.isnan(trials[0]["objective"]):
        lost = f" ({trials[0]['ended']:.0f} episodes ended for an error)" if trials[0].get("ended") else ""
        raise InputError(f"planner tuning: the present parameters yield NaN metrics{lost}; check planner and scenes")
    best = min((trial for trial in trials if trial["admissible"] or trial is trials[0]), key=lambda t: t["objective"])
    return Tuning(best["parameters"], trials)


class PlannerImprovement(Improvement):
    """Tunes a planner's parameters on the round's pool; `ego` is the planner with the best parameters so far."""

    def __init__(
        self,
        ego: Ego,
        parameters: Mapping[str, Any],
        scenes: SceneSet,
        sim: SimSettings,
        grid: Mapping[str, Sequence],
        tuning: Mapping[str, Any] | None = None,
        batch: int = 64,
        traffic: Traffic | None = None,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """parameters: those that `ego` was built with; grid: values to try for some of them; others:
        conf/learner/planner_tuning.yaml. Raises InputError for a grid that does not fit, or for live traffic."""
        unknown = sorted(set(grid) - set(parameters))
        if unknown:
            own = ", ".join(sorted(parameters))
            raise InputError(f"learner.grid: {', '.join(unknown)} are no parameters of the planner; it has {own}")
        if traffic is not None:
            raise InputError("learner.round.traffic=live: a planner is tuned on stored traffic; set it to replay")
        self.ego, self.present, self.grid = ego, dict(parameters), {key: list(grid[key]) for key in grid}
        self.objective = settings_of(Objective, tuning or {}, "learner.tuning")
        self.driver = PoolDriver(scenes, sim, batch, device)
        self.trials: list[dict] = []

    def __call__(self, pool: TrafficPool, curriculum: CurriculumScheduler) -> tuple[dict[str, float], Episodes]:
        """Drive the pool once with every combination of the grid; `trials` keeps all results."""
        driven: dict[str, Episodes] = {}
        lost: dict[str, list[dict]] = {}

        def evaluate(parameters: Parameters) -> dict[str, float]:
            key = repr(parameters)
            driven[key], lost[key] = self.driver.drive_all(type(self.ego)(**parameters), pool)
            summary = {"contact": nan, "acceleration": nan, "progress": nan} | driven[key].summary()
            named = {"collision": summary["contact"], "comfort": summary["acceleration"]}
            return named | summary | counted(lost[key])

        tuning = tune(evaluate, self.present, self.grid, self.objective)
        before, after = tuning.trials[0], next(t for t in tuning.trials if t["parameters"] == tuning.best)
        self.present, self.trials, self.ego = tuning.best, tuning.trials, type(self.ego)(**tuning.best)
        chosen = {key: value for key, value in self.present.items() if key in self.grid}
        metrics = {f"parameter_{key}": float(value) for key, value in chosen.items() if isinstance(value, int | float)}
        metrics |= {"objective_before": before["objective"], "objective": after["objective"]}
        episodes, ended = driven[repr(tuning.best)], lost[repr(tuning.best)]
        self.ended = [{"during": "tuning", **entry} for entry in ended]
        return metrics | {"trials": float(len(tuning.trials))} | episodes.summary() | counted(ended), episodes

    def outcome(self, folder: Path) -> str:
        """Write the trials of the last round to tuning.json; returns how to evaluate the tuned planner."""
        write_atomically(folder / "tuning.json", json.dumps({"best": self.present, "trials": self.trials}, indent=1))
        tuned = " ".join(f"ego.{key}={self.present[key]}" for key in self.grid)
        return f"every trial of the last round is in tuning.json; evaluate the tuned planner with: {tuned}"

    def state_dict(self) -> dict:
        """The best parameters so far."""
        return {"present": dict(self.present)}

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.present = dict(state["present"])
        self.ego = type(self.ego)(**self.present)
