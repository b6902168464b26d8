"""The update of a planner: optuna searches its parameters on the round's adversarial
and nominal scenes.

The paper tunes its lane-graph planner. Progress has a floor, because standing still is
the trivial optimum of safety and comfort.
"""

import json
from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

from e2rl.evaluation.trials import PlannerObjective
from e2rl.evaluation.tuning import Parameters, SearchSettings, best_of, search
from e2rl.learning.attack import counted
from e2rl.learning.driving import Episodes, PoolDriver
from e2rl.learning.improvement import Improvement
from e2rl.learning.scheduler import CurriculumScheduler
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.run.settings import configured, settings_of
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.traffic.attempt import EGO
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import Traffic


@configured("learner/planner_tuning")
class PlannerImprovement(Improvement):
    """Tunes a planner's parameters on the round's pool; `ego` is the planner with the
    best parameters so far."""

    def __init__(
        self,
        ego: Ego,
        parameters: Mapping[str, Any],
        scenes: SceneSet,
        sim: SimSettings,
        search: Mapping[str, int],
        space: Mapping[str, Sequence],
        objective: Mapping[str, float],
        batch: int,
        traffic: Traffic | None = None,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """parameters: those that `ego` was built with. Raises InputError for live
        traffic."""
        if traffic is not None:
            raise InputError(
                "learner.round.traffic=live: a planner is tuned on stored traffic; set it to replay"
            )
        self.ego = ego
        self.present = dict(parameters)
        self.space = dict(space) or dict(ego.tuned)
        self.search = settings_of(
            SearchSettings,
            {"seed": seed, "sweep": 0} | dict(search),
            where="learner.search",
        )
        self.objective = settings_of(
            PlannerObjective, objective, where="learner.objective"
        )
        self.driver = PoolDriver(scenes, sim, batch=batch, device=device)
        self.trials: list[dict] = []

    def __call__(
        self, pool: TrafficPool, curriculum: CurriculumScheduler
    ) -> tuple[dict[str, float], Episodes]:
        """Drive the pool once with the parameters of every trial; `trials` keeps all
        results."""
        driven: list[tuple[Parameters, Episodes, list[dict]]] = []

        def evaluate(parameters: Parameters) -> dict[str, float]:
            episodes, errored = self.driver.drive_all(
                type(self.ego)(**parameters), pool
            )
            driven.append((parameters, episodes, errored))
            summary = {
                "contact": nan,
                "acceleration": nan,
                "progress": nan,
            } | episodes.summary()
            named = {
                "collision": summary["contact"],
                "comfort": summary["acceleration"],
            }
            own = sum(entry["raised_by"] == EGO for entry in errored)
            return named | summary | counted(errored) | {"errored": float(own)}

        self.trials = search(
            evaluate,
            self.present,
            space=self.space,
            settings=self.search,
            objective=self.objective,
        )
        first = self.trials[0]
        best = best_of(self.trials) or self.trials[0]
        self.present, episodes, errored = driven[self.trials.index(best)]
        self.ego = type(self.ego)(**self.present)
        metrics = {
            f"parameter_{name}": float(value)
            for name, value in best["parameters"].items()
        }
        metrics |= {
            "objective_before": first["objective"],
            "objective": best["objective"],
        }
        self.errored = [{"during": "tuning", **entry} for entry in errored]
        return metrics | {"trials": float(len(driven))} | episodes.summary() | counted(
            errored
        ), episodes

    def outcome(self, folder: Path) -> str:
        """Write the trials of the last round to tuning.json; returns how to evaluate
        the tuned planner."""
        write_atomically(
            folder / "tuning.json",
            json.dumps({"best": self.present, "trials": self.trials}, indent=1),
        )
        tuned = " ".join(f"ego.{name}={self.present[name]}" for name in self.space)
        return f"every trial of the last round is in tuning.json; evaluate the tuned planner with: {tuned}"

    def state_dict(self) -> dict:
        """The best parameters so far."""
        return {"present": dict(self.present)}

    def load_state_dict(self, state: dict) -> None:
        self.present = dict(state["present"])
        self.ego = type(self.ego)(**self.present)
