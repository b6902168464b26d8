"""Tuning of a planner in closed loop: optuna proposes parameters, and every trial meets traffic made anew against it.

A replay of stored attacks would not do: it does not react to the planner under trial. `python evaluate.py
experiment=tune_planner ego=NAME` calls this.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import nan
from typing import Any

import torch

from e2rl.evaluation.protocol import Method, Setup, Task
from e2rl.evaluation.tuning import Parameters
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.run.processes import Processes, in_processes
from e2rl.scenes.drivable_area import off_road
from e2rl.traffic.attempt import attempt, count_reasons

COLUMNS = ("collision", "comfort", "progress", "ended")


@dataclass
class Trials:
    """evaluate(parameters) of a planner: mean metrics of rollouts of every method, scene and seed with that planner."""

    setup: Setup
    methods: Sequence[Method]
    seeds: Sequence[int]
    make: Callable[[Parameters], Ego]
    processes: Processes = 1

    def __call__(self, parameters: Parameters) -> dict[str, float]:
        """collision: share of rollouts with a contact of the ego, or with the ego off the road; comfort: mean
        |acceleration|, m/s^2; progress: m; ended: share without a score, `ended: REASON` for each reason. Each but the
        last also of every method alone, as NAME@ETA."""
        setup = replace(self.setup, ego=self.make(parameters))
        tasks = [(scene, seed) for seed in self.seeds for scene in range(len(setup.scenes))]
        parts = [tasks[k : k + setup.batch] for k in range(0, len(tasks), setup.batch)]
        jobs = [(number, part) for number in range(len(self.methods)) for part in parts]

        def work(job: tuple[int, list[Task]]) -> list[dict[str, Any]]:
            return outcomes(setup, self.methods[job[0]], job[1])

        found: dict[int, list[dict[str, Any]]] = {}
        results = in_processes(work, jobs, self.processes, cost=lambda job: self.methods[job[0]].eta)
        for (number, _), rows in zip(jobs, results, strict=True):
            found.setdefault(number, []).extend(rows)
        every = [row for rows in found.values() for row in rows]
        metrics = means(every)
        for number, method in enumerate(self.methods):
            label = f"{method.name}@{method.eta:g}"
            metrics |= {f"{name} {label}": value for name, value in means(found[number]).items()}
        reasons = count_reasons([row for row in every if row["ended"]])
        return metrics | {f"ended: {reason}": count / len(every) for reason, count in reasons.items()}


def outcomes(setup: Setup, method: Method, tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """Collision, comfort and progress of each rollout of tasks, made anew against `setup.ego`; ended: 1 for one without
    a score, whose reason stands beside it."""
    parts, lost = attempt(partial(setup.roll_out, method), tasks)
    found: list[dict[str, Any]] = []
    for done, rollouts in parts:
        scene = setup.scenes.batch([index for index, _ in done])
        beyond = off_road(rollouts["states"][:, :, 0, :2], scene["field"], scene["field_origin"]) > 0
        left = (beyond & (~beyond).cummax(1).values & rollouts["valid"][:, :, 0]).any(1).tolist()
        rows, _ = score_rollouts(rollouts)
        found += [
            {
                "collision": float(bool(row["cfr"] or row["cfr_vru"] or off)),
                "comfort": float(row["macc"]),
                "progress": float(row["progress"]),
                "ended": 0.0,
            }
            for row, off in zip(rows, left, strict=True)
        ]
    nothing = dict.fromkeys(COLUMNS, nan)
    return found + [nothing | {"ended": 1.0, "reason": why["reason"]} for _, why in lost]


def means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The mean of each of COLUMNS, over the rows that know it (that are not NaN)."""
    return {name: torch.tensor([row[name] for row in rows]).nanmean().item() for name in COLUMNS}
