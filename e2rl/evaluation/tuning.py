"""Tuning on one budget of trials: optuna proposes parameters, every trial is rolled out anew, the best is kept.

What a trial is rolled out as, and what its metrics are worth, is the caller's: `tune_planner`, `tune_traffic`.

What a planner's tuning minimises, and the trials that it refuses.
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from omegaconf import OmegaConf

from e2rl.evaluation.rollout_files import nulls
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.run.parts import NO_PARTS, Parts

NEEDED = ("collision", "comfort", "progress")


@dataclass(frozen=True)
class Objective:
    """comfort, progress: weights of the mean |acceleration| in m/s^2 and of the lost share of progress against the
    collision rate; progress_floor: share of the reference's progress below which a trial is refused, as standing still
    is the trivial optimum of safety; comfort_ceiling: multiple of the reference's |acceleration| above which it is."""

    comfort: float = 0.1
    progress: float = 0.1
    progress_floor: float = 0.9
    comfort_ceiling: float = math.inf

    def judge(self, metrics: Mapping[str, float], reference: Mapping[str, float]) -> tuple[float, float]:
        """(objective, excess) of metrics "collision" (rate), "comfort" (mean |acceleration|, m/s^2) and "progress" (m).

        reference: metrics of the present parameters. excess: the share by which a guard is missed; 0 for an admissible
        trial, inf for a metric that is NaN. A trial in which more rollouts ended for an error ("ended") than of the
        reference is not admissible. Raises InputError where a metric is missing.
        """
        ended = metrics.get("ended", 0.0) - reference.get("ended", 0.0)  # share or number, of both the same
        missing = [name for name in NEEDED if name not in metrics]
        if missing:
            raise InputError(f"planner tuning: evaluate() returned no {', '.join(missing)}")
        kept = metrics["progress"] / max(reference["progress"], 1e-6)
        rougher = metrics["comfort"] / max(reference["comfort"], 1e-6)
        lost = self.progress * max(0.0, 1 - kept)
        value = metrics["collision"] + self.comfort * metrics["comfort"] + lost
        excess = max(0.0, self.progress_floor - kept) + max(0.0, rougher - self.comfort_ceiling) + max(0.0, ended)
        return value, math.inf if math.isnan(value) else excess

    def text(self, metrics: Mapping[str, float]) -> str:
        """The metrics of a trial in a few words."""
        shares = ", ".join(
            f"{name.split()[1]} {100 * value:.1f}%" for name, value in metrics.items() if name.startswith("collision ")
        )
        lost = f"; {100 * metrics['ended']:.1f}% ended for an error" if metrics.get("ended") else ""
        return f"collisions {shares}; {metrics['comfort']:.2f} m/s^2, {metrics['progress']:.1f} m{lost}"


Parameters = dict[str, Any]
REFUSED = 10.0  # added to the objective of refused trials, so that the sampler leaves their region
UNKNOWN = 2 * REFUSED  # of trials in which no rollout has a score
STUDY = "trials"  # name of the study in its file
LOCK_GRACE = 5  # s after which the lock of a writer that does nothing more is broken
LOG = "log"  # third entry of a range that is searched on a logarithmic scale
TUNING_FILE, TUNED_FILE = "tuning.json", "tuned.yaml"


class Judge(Protocol):
    """What metrics are worth."""

    def judge(self, metrics: Mapping[str, float], reference: Mapping[str, float]) -> tuple[float, float]:
        """(objective, excess) of a trial's metrics; reference: those of the present parameters; excess: 0 for an
        admissible trial, inf for metrics that are NaN."""

    def text(self, metrics: Mapping[str, float]) -> str:
        """The metrics in a few words."""


@dataclass(frozen=True)
class TuneSettings:
    """Fields: conf/experiment/tune.yaml."""

    trials: int = 40
    seed: int = 0
    study: str | None = None
    startup: int = 10
    ladder: int = 0


def tune(
    evaluate: Callable[[Parameters], Mapping[str, float]],
    present: Parameters,
    space: Mapping[str, Sequence],
    settings: TuneSettings,
    objective: Judge,
    folder: Path,
    about: Mapping | None = None,
    say: Callable[[str], None] = print,
    kept: Parts = NO_PARTS,
) -> dict:
    """Try the present parameters, a ladder over the space's first one, then optuna's proposals, `settings.trials` in
    all; returns what tuning.json holds.

    space: {name: [low, high] or [low, high, log]} of some of the present parameters; two whole numbers stand for whole
    numbers. The best is the admissible trial of the least objective, the first of equals; there may be none. After
    every trial tuning.json and, where there is a best, tuned.yaml are written into `folder`. With `settings.study` a
    study goes on where it stopped; its proposals are those of a study in one go. about: what else such a study must
    agree in, such as its scenes. kept: trials of this run that are finished; they are told to the study again.
    """
    optuna = _optuna()
    ranges = distributions(optuna, present, space)
    given = [{name: present[name] for name in space}, *ladder(present, space, settings.ladder)]
    task = {"space": {name: list(space[name]) for name in space}, "parameters": present, "ladder": settings.ladder}
    study = open_study(optuna, settings, task | {"objective": vars(objective)} | dict(about or {}))
    done = _finished(study)
    for number in range(len(done), settings.trials):
        parameters = given[number] if number < len(given) else proposal(optuna, done, ranges, settings)
        measure = partial(evaluate, present | parameters)
        metrics = dict(kept.result(f"trial-{number:05}", list(parameters.items()), measure))
        value, excess = objective.judge(metrics, done[0].user_attrs["metrics"] if done else metrics)
        if math.isinf(excess) and not done:
            lost = [name for name, part in metrics.items() if name.startswith("ended: ") and part]
            raise InputError(f"tuning: {parameters} yield NaN metrics ({', '.join(lost) or 'check the scenes'})")
        outcome = {"metrics": metrics, "objective": value, "admissible": excess == 0}
        value = UNKNOWN if math.isinf(excess) else value + (REFUSED + excess if excess else 0)
        study.add_trial(optuna.create_trial(params=parameters, distributions=ranges, value=value, user_attrs=outcome))
        done = _finished(study)
        say(line_of(number, parameters, outcome, objective))
        save(done, folder)
    return save(done, folder)


def ladder(present: Parameters, space: Mapping[str, Sequence], count: int) -> list[Parameters]:
    """The present parameters with `count` values of the space's first one, evenly spaced over its range, both ends
    included (on its scale); without the present value itself, which is the first trial."""
    name, (low, high, *scale) = next(iter(space.items()))
    ends = (math.log(low), math.log(high)) if scale else (low, high)
    shares = [step / max(count - 1, 1) for step in range(count)]
    values = [ends[0] + share * (ends[1] - ends[0]) for share in shares]
    values = [min(max(math.exp(value) if scale else value, low), high) for value in values]
    if isinstance(low, int) and isinstance(high, int) and not scale:
        values = [round(value) for value in values]
    others = [value for value in values if not math.isclose(value, present[name], rel_tol=1e-9)]
    return [{each: present[each] for each in space} | {name: value} for value in others]


def save(done: Sequence, folder: Path) -> dict:
    """Write tuning.json and tuned.yaml of finished trials; returns what tuning.json holds."""
    rows = [{"parameters": trial.params, **trial.user_attrs} for trial in done]
    admissible = [row for row in rows if row["admissible"]]
    best = min(admissible, key=lambda row: row["objective"])["parameters"] if admissible else None
    result = {"best": best, "trials": rows}
    write_atomically(folder / TUNING_FILE, json.dumps(nulls(result), indent=1))
    if best is not None:
        write_atomically(folder / TUNED_FILE, yaml_of(best))
    return result


def yaml_of(parameters: Parameters) -> str:
    """The lines of the file in conf/, to keep; a dotted name is in the group before its dot."""
    tree = OmegaConf.create()
    for name, value in parameters.items():
        OmegaConf.update(tree, name, float(f"{value:.4g}") if isinstance(value, float) else value)
    return OmegaConf.to_yaml(tree)


def line_of(number: int, parameters: Parameters, outcome: Mapping, objective: Judge) -> str:
    """A trial in one line."""
    values = " ".join(f"{name}={value:.3g}" for name, value in parameters.items())
    verdict = "" if outcome["admissible"] else ", refused"
    return (
        f"trial {number}: objective {outcome['objective']:.3f}{verdict}; {objective.text(outcome['metrics'])}; {values}"
    )


# --- optuna


def _optuna():
    try:
        import optuna
    except ImportError as error:
        raise InputError(
            "tuning: optuna is not installed; install e2rl with its extra: pip install 'e2rl[tune]'"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def distributions(optuna, present: Parameters, space: Mapping[str, Sequence]) -> dict:
    """optuna's distributions of a space; InputError for a name that is no parameter, and for a range that is none or
    leaves out the present value."""
    if not space:
        raise InputError("tuning.space: it is empty; name a range of each parameter to tune, [low, high]")
    found = {}
    for name, bounds in space.items():
        if name not in present:
            raise InputError(f"tuning.space: {name} is none of the parameters, {', '.join(sorted(present))}")
        where = f"tuning.space.{name}={list(bounds)}"
        if len(bounds) not in (2, 3) or not bounds[0] < bounds[1] or list(bounds[2:]) not in ([], [LOG]):
            raise InputError(f"{where}: expected [low, high], or [low, high, log]")
        low, high = bounds[:2]
        logarithmic = len(bounds) == 3
        if logarithmic and low <= 0:
            raise InputError(f"{where}: a logarithmic range begins above 0")
        if not low <= present[name] <= high:
            raise InputError(f"{where}: leaves out the present value, {present[name]}")
        whole = not logarithmic and all(isinstance(bound, int) for bound in (low, high))
        kind = optuna.distributions.IntDistribution if whole else optuna.distributions.FloatDistribution
        found[name] = kind(low, high, log=logarithmic)
    return found


def proposal(optuna, done: Sequence, ranges: Mapping, settings: TuneSettings) -> Parameters:
    """optuna's next parameters after the finished trials. They depend on nothing else, as a study holds no others."""
    sampler = optuna.samplers.TPESampler(seed=settings.seed + len(done), n_startup_trials=settings.startup)
    study = optuna.create_study(sampler=sampler)
    study.add_trials(done)
    return study.ask(dict(ranges)).params


def open_study(optuna, settings: TuneSettings, task: Mapping):
    """The study in the file `settings.study`, a new one where there is none; InputError for one of another task."""
    storage = None if settings.study is None else journal(optuna, Path(settings.study))
    study = optuna.create_study(storage=storage, study_name=STUDY, load_if_exists=True)
    task = json.loads(json.dumps(nulls(dict(task))))
    known = study.user_attrs.get("task", task)
    if known != task:
        differ = ", ".join(sorted(name for name in {*known, *task} if known.get(name) != task.get(name)))
        raise InputError(f"tuning.study={settings.study}: a study that differs in {differ}; name another file")
    study.set_user_attr("task", task)
    return study


def journal(optuna, file: Path):
    """optuna's storage in a file. The half line of a writer that was killed is cut off; its lock is broken after
    LOCK_GRACE seconds."""
    file = file.absolute()  # optuna's lock is a link to this path, from the file's own folder
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    lock = optuna.storages.journal.JournalFileSymlinkLock(str(file), LOCK_GRACE)
    lock.acquire()
    try:
        if tail := len(file.read_bytes().rpartition(b"\n")[2]):
            os.truncate(file, file.stat().st_size - tail)
    finally:
        lock.release()
    return optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(file), lock))


def _finished(study) -> list:
    """Its complete trials, in order."""
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
