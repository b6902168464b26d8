"""Tuning of a planner in closed loop: optuna proposes parameters, and every trial meets traffic made anew against it.

A replay of stored attacks would not do: it does not react to the planner under trial. `python evaluate.py
experiment=tune_planner ego=NAME` calls this.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.evaluation.files import nulls
from e2rl.evaluation.objective import Objective
from e2rl.evaluation.processes import in_processes
from e2rl.evaluation.protocol import Method, Setup, Task
from e2rl.files import write_atomically
from e2rl.metrics.score import score_rollouts
from e2rl.sim.drivable import off_road

Parameters = dict[str, Any]
REFUSED = 10.0  # added to the objective of refused trials, so that the sampler leaves their region
STUDY = "planner"  # name of the study in its file


@dataclass(frozen=True)
class TuneSettings:
    """Fields: conf/experiment/tune_planner.yaml."""

    trials: int = 40
    seed: int = 0
    study: str | None = None
    startup: int = 10
    objective: Objective = field(default_factory=Objective)


@dataclass
class Trials:
    """evaluate(parameters) of a planner: mean metrics of rollouts of every method, scene and seed with that planner."""

    setup: Setup
    methods: Sequence[Method]
    seeds: Sequence[int]
    make: Callable[[Parameters], Ego]
    processes: int = 1

    def __call__(self, parameters: Parameters) -> dict[str, float]:
        """collision: share of rollouts with a contact of the ego, or with the ego off the road; comfort: mean
        |acceleration|, m/s^2; progress: m. Each also of every method alone, as NAME@ETA."""
        setup = replace(self.setup, ego=self.make(parameters))
        tasks = [(scene, seed) for seed in self.seeds for scene in range(len(setup.scenes))]
        parts = [tasks[k : k + setup.batch] for k in range(0, len(tasks), setup.batch)]
        jobs = [(number, part) for number in range(len(self.methods)) for part in parts]

        def work(job: tuple[int, list[Task]]) -> list[dict[str, float]]:
            return outcomes(setup, self.methods[job[0]], job[1])

        found: dict[int, list[dict[str, float]]] = {}
        results = in_processes(work, jobs, self.processes, cost=lambda job: self.methods[job[0]].eta)
        for (number, _), rows in zip(jobs, results, strict=True):
            found.setdefault(number, []).extend(rows)
        metrics = means([row for rows in found.values() for row in rows])
        for number, method in enumerate(self.methods):
            label = f"{method.name}@{method.eta:g}"
            metrics |= {f"{name} {label}": value for name, value in means(found[number]).items()}
        return metrics


def outcomes(setup: Setup, method: Method, tasks: Sequence[Task]) -> list[dict[str, float]]:
    """Collision, comfort and progress of each rollout of tasks, made anew against `setup.ego`."""
    rollouts = setup.roll_out(method, tasks)
    scene = setup.scenes.batch([index for index, _ in tasks])
    beyond = off_road(rollouts["states"][:, :, 0, :2], scene["field"], scene["field_origin"]) > 0
    left = (beyond & (~beyond).cummax(1).values & rollouts["valid"][:, :, 0]).any(1).tolist()
    rows, _ = score_rollouts(rollouts)
    return [
        {
            "collision": float(bool(row["cfr"] or row["cfr_vru"] or off)),
            "comfort": float(row["macc"]),
            "progress": float(row["progress"]),
        }
        for row, off in zip(rows, left, strict=True)
    ]


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each column, over the rows that know it (that are not NaN)."""
    return {name: torch.tensor([row[name] for row in rows]).nanmean().item() for name in rows[0]}


def tune_planner(
    evaluate: Callable[[Parameters], Mapping[str, float]],
    present: Parameters,
    space: Mapping[str, Sequence[float]],
    settings: TuneSettings,
    folder: Path,
    about: Mapping | None = None,
    say: Callable[[str], None] = print,
) -> dict:
    """Try the present parameters, then `settings.trials` - 1 proposals of optuna; returns what tuning.json holds.

    space: {name: [low, high]} of some of the present parameters; two whole numbers stand for whole numbers. The best is
    the admissible trial of the least objective. tuning.json and tuned.yaml in `folder` are written after every trial.
    With `settings.study` a study goes on where it stopped; its proposals are those of a study in one go. about: what
    else such a study must agree in, such as its scenes.
    """
    optuna = _optuna()
    ranges = distributions(optuna, present, space)
    task = {"space": {name: list(space[name]) for name in space}, "present": present, **(about or {})}
    study = open_study(optuna, settings, task)
    done = _finished(study)
    for number in range(len(done), settings.trials):
        study.sampler = optuna.samplers.TPESampler(seed=settings.seed + number, n_startup_trials=settings.startup)
        trial = study.ask(ranges) if number else None
        parameters = trial.params if trial else {name: present[name] for name in space}
        metrics = dict(evaluate(present | parameters))
        value, excess = settings.objective.judge(metrics, done[0].user_attrs["metrics"] if done else metrics)
        if math.isinf(excess):
            raise InputError(f"tuning: {parameters} yield NaN metrics; check the scenes")
        outcome = {"metrics": metrics, "objective": value, "admissible": excess == 0}
        value += REFUSED + excess if excess else 0
        if trial:
            for name, item in outcome.items():
                trial.set_user_attr(name, item)
            study.tell(trial, value)
        else:
            study.add_trial(
                optuna.create_trial(params=parameters, distributions=ranges, value=value, user_attrs=outcome)
            )
        done = _finished(study)
        say(line_of(number, parameters, outcome))
        save(done, folder)
    return save(done, folder)


def save(done: Sequence, folder: Path) -> dict:
    """Write tuning.json and tuned.yaml of finished trials; returns what tuning.json holds."""
    rows = [{"parameters": trial.params, **trial.user_attrs} for trial in done]
    best = min((row for row in rows if row["admissible"]), key=lambda row: row["objective"])
    result = {"best": best["parameters"], "trials": rows}
    write_atomically(folder / "tuning.json", json.dumps(nulls(result), indent=1))
    write_atomically(folder / "tuned.yaml", yaml_of(best["parameters"]))
    return result


def yaml_of(parameters: Parameters) -> str:
    """The lines of the ego's file in conf/ego, to keep."""
    return "".join(f"{name}: {value:.4g}\n" for name, value in parameters.items())


def line_of(number: int, parameters: Parameters, outcome: Mapping) -> str:
    """A trial in one line."""
    metrics = outcome["metrics"]
    shares = ", ".join(
        f"{name.split()[1]} {100 * value:.1f}%" for name, value in metrics.items() if name.startswith("collision ")
    )
    values = " ".join(f"{name}={value:.3g}" for name, value in parameters.items())
    verdict = "" if outcome["admissible"] else ", refused"
    return (
        f"trial {number}: objective {outcome['objective']:.3f}{verdict}; collisions {shares}; "
        f"{metrics['comfort']:.2f} m/s^2, {metrics['progress']:.1f} m; {values}"
    )


# --- optuna


def _optuna():
    try:
        import optuna
    except ImportError as error:
        reason = "optuna is not installed; install e2rl with its extra: pip install 'e2rl[tune]'"
        raise InputError(f"experiment=tune_planner: {reason}") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def distributions(optuna, present: Parameters, space: Mapping[str, Sequence[float]]) -> dict:
    """optuna's distributions of a space; InputError for a name that is no parameter, and for a range that is none or
    leaves out the present value."""
    if not space:
        raise InputError("tuning.space: it is empty; name a range of each parameter to tune, [low, high]")
    found = {}
    for name, bounds in space.items():
        if name not in present:
            raise InputError(
                f"tuning.space: {name} is no parameter of the planner; it has {', '.join(sorted(present))}"
            )
        if len(bounds) != 2 or not bounds[0] < bounds[1]:
            raise InputError(f"tuning.space.{name}={list(bounds)}: expected [low, high]")
        low, high = bounds
        if not low <= present[name] <= high:
            raise InputError(f"tuning.space.{name}={list(bounds)}: leaves out the present value, {present[name]}")
        whole = all(isinstance(bound, int) for bound in bounds)
        kind = optuna.distributions.IntDistribution if whole else optuna.distributions.FloatDistribution
        found[name] = kind(low, high)
    return found


def open_study(optuna, settings: TuneSettings, task: Mapping):
    """The study in the file `settings.study`, a new one where there is none; InputError for one of another task."""
    storage = None
    if settings.study is not None:
        Path(settings.study).parent.mkdir(parents=True, exist_ok=True)
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(settings.study))
    study = optuna.create_study(storage=storage, study_name=STUDY, load_if_exists=True)
    task = json.loads(json.dumps(task))
    if study.user_attrs.get("task", task) != task:
        raise InputError(f"tuning.study={settings.study}: made with another planner, space or data; name another file")
    study.set_user_attr("task", task)
    return study


def _finished(study) -> list:
    """Its complete trials, in order."""
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
