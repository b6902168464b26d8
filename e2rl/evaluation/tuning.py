"""Tuning: optuna proposes parameters, every trial is measured, the best is kept.

What a trial is and what its metrics are worth is told by `e2rl.evaluation.trials`.
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from omegaconf import OmegaConf

from e2rl.evaluation.rollout_files import nans, nulls, write_json
from e2rl.run.config import configured, library, setting
from e2rl.run.errors import InputError
from e2rl.run.files import check_format, misfit, read_regular, write_atomically
from e2rl.run.run import changed

Parameters = dict[str, Any]
# {name: (low, high) or (low, high, "log")} of some parameters; whole numbers stay whole
Space = Mapping[str, Sequence]
Evaluate = Callable[[Parameters], Mapping[str, float]]  # the metrics of a trial
# added to the objective of refused trials, so that the sampler leaves their region
REFUSED = 10.0
UNKNOWN = 2 * REFUSED  # of trials in which no rollout has a score
NUMBER = int | float
FORMAT = "e2rl-study/1"
FIRST = "e2rl-study/1"  # of a file that does not say its format
STUDY = {  # its file
    "task": dict,
    "trials": [{"parameters": {...: NUMBER}, "metrics": {...: NUMBER | None}}],
}
MAX_STUDY = 1 << 24  # bytes of it
STUDY_FILE = "study.json"
TUNING_FILE = "tuning.json"
TUNED_FILE = "tuned.yaml"


class Objective(Protocol):
    """The objective of metrics; shown: names of those in a trial's line."""

    shown: ClassVar[tuple[str, ...]]

    def judge(
        self,
        metrics: Mapping[str, float],
        reference: Mapping[str, float],
    ) -> tuple[float, float]:
        """Returns (objective, excess) of a trial's metrics.

        reference: metrics of the present parameters; excess: by how much limits are
        missed, 0 for an admissible trial, inf for metrics that are NaN.
        """


@configured("tune", "tuning")
@dataclass(frozen=True)
class SearchSettings:
    """How many trials there are, and what proposes them (conf/tune.yaml)."""

    trials: int = setting(low=1)
    seed: int = setting(low=0)
    startup: int = setting(low=1)
    sweep: int = setting(low=0)


def search(
    evaluate: Evaluate,
    present: Parameters,
    *,
    space: Space,
    settings: SearchSettings,
    objective: Objective,
    file: Path | None = None,
    about: Mapping | None = None,
    after_trial: Callable[[list[dict]], None] = lambda rows: None,
) -> list[dict]:
    """Returns a row a trial: parameters, metrics, objective, admissible.

    The present parameters come first, then a sweep over the first one of the space,
    then optuna's proposals.

    Args:
        evaluate: parameters -> metrics.
        present: all parameters, as they are.
        space: low and high of those that are varied.
        settings: how many trials, and what proposes them.
        objective: what is lowered, and what is admissible.
        file: of the study; one that is there goes on, as it would have gone on without
            the interruption.
        about: what the study must agree in besides, such as its scenes.
        after_trial: called with all rows.

    Raises:
        InputError: for a space that does not fit, for a study of another task, and
            where the present parameters have no metrics.
    """
    ranges = distributions(present, space)
    planned = [
        {name: present[name] for name in space},
        *sweep(present, space, count=settings.sweep),
    ]
    task = {
        "space": {name: list(limits) for name, limits in space.items()},
        "parameters": present,
        "sweep": settings.sweep,
        "objective": vars(objective),
        **(about or {}),
    }
    task = json.loads(json.dumps(nulls(task)))
    rows = read_study(file, task, ranges=ranges, objective=objective)
    while len(rows) < settings.trials:
        if len(rows) < len(planned):
            parameters = planned[len(rows)]
        else:
            parameters = proposal(rows, ranges, settings=settings, objective=objective)
        metrics = dict(evaluate(present | parameters))
        row, excess = judged(parameters, metrics, rows=rows, objective=objective)
        if math.isinf(excess) and not rows:
            reasons = [
                name
                for name, value in metrics.items()
                if name.startswith(("errored: ", "errored_")) and value
            ]
            raise InputError(
                f"tuning: {parameters} yield NaN metrics "
                f"({', '.join(reasons) or 'check the scenes'})"
            )
        rows.append(row)
        if file is not None:
            study = {"format": FORMAT, "task": task, "trials": rows}
            write_atomically(file, json.dumps(nulls(study)))
        after_trial(rows)
    return rows


def judged(
    parameters: Parameters,
    metrics: Mapping[str, float],
    rows: Sequence[dict],
    objective: Objective,
) -> tuple[dict, float]:
    """Returns the row of a trial, and its excess.

    Args:
        parameters: of the trial.
        metrics: of the trial.
        rows: of the trials before it, the first one the present parameters'.
        objective: that judges.
    """
    reference = rows[0]["metrics"] if rows else metrics
    value, excess = objective.judge(metrics, reference)
    row = {
        "parameters": parameters,
        "metrics": metrics,
        "objective": value,
        "admissible": excess == 0,
    }
    return row, excess


def read_study(
    file: Path | None,
    task: Mapping,
    ranges: Mapping,
    objective: Objective,
) -> list[dict]:
    """Returns the rows of a study's file, none where there is none.

    Args:
        file: of the study.
        task: that it must be of.
        ranges: that its parameters must be in.
        objective: that judges its trials.

    Raises:
        InputError: where it is no study, or of another task.
    """
    if file is None or not os.path.lexists(file):
        return []
    rows: list[dict] = []
    try:
        study = json.loads(read_regular(file, MAX_STUDY))
        written = study.get("format", FIRST)
        where = f"tuning.study={file}"
        check_format(where, written, expected=FORMAT, mend="name another file")
        if reason := misfit(study, STUDY):
            raise ValueError(reason)
        differing = changed(study["task"], task)
        if not differing:
            for trial in map(nans, study["trials"]):
                parameters = trial["parameters"]
                check_inside(parameters, ranges)
                metrics = trial["metrics"]
                list(map(float, metrics.values()))  # OverflowError of endless numbers
                row, _ = judged(parameters, metrics, rows=rows, objective=objective)
                rows.append(row)
    except InputError:
        raise
    except (
        OSError,
        ValueError,
        AttributeError,
        LookupError,
        TypeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        raise InputError(
            f"tuning.study={file}: no study, or a damaged one ({error}); name another file"
        ) from error
    if differing:
        raise InputError(
            f"tuning.study={file}: a study that differs in {', '.join(differing)}; "
            "name another file"
        )
    return rows


def check_inside(parameters: Parameters, ranges: Mapping) -> None:
    """Raises ValueError for parameters that are not those of the ranges, or out of
    them."""
    if parameters.keys() != ranges.keys():
        raise ValueError("a trial of other parameters")
    for name, value in parameters.items():
        limits = ranges[name]
        number = isinstance(value, type(limits.low) | int)
        if not (number and limits.low <= value <= limits.high):
            raise ValueError("a trial out of its ranges")


def best_of(rows: Sequence[dict]) -> dict | None:
    """Returns the admissible row of the least objective, the first of equals; None
    where there is none."""
    return min(
        (row for row in rows if row["admissible"]),
        key=lambda row: row["objective"],
        default=None,
    )


def save(rows: Sequence[dict], folder: Path) -> dict:
    """Write tuning.json, and tuned.yaml where there is a best; returns what tuning.json
    holds."""
    best = best_of(rows)
    result = {"best": best and best["parameters"], "trials": list(rows)}
    write_json(folder / TUNING_FILE, result)
    if best:
        write_atomically(folder / TUNED_FILE, yaml_of(best["parameters"]))
    return result


def yaml_of(parameters: Parameters) -> str:
    """Returns the lines of the file in conf/, to keep; a dotted name is in the group
    before its dot."""
    tree = OmegaConf.create()
    for name, value in parameters.items():
        short = float(f"{value:.4g}") if isinstance(value, float) else value
        OmegaConf.update(tree, name, short)
    return OmegaConf.to_yaml(tree)


def line_of(rows: Sequence[dict], objective: Objective) -> str:
    """Returns the last trial in one line."""
    row = rows[-1]
    values = " ".join(
        f"{name}={value:.3g}" for name, value in row["parameters"].items()
    )
    verdict = f"{row['objective']:.3f}{'' if row['admissible'] else ', refused'}"
    metrics = ", ".join(
        f"{name} {row['metrics'].get(name, math.nan):.3g}" for name in objective.shown
    )
    return f"trial {len(rows) - 1}: objective {verdict}; {metrics}; {values}"


def sweep(present: Parameters, space: Space, count: int) -> list[Parameters]:
    """Returns the present parameters with `count` values of the space's first one,
    evenly spaced over its range (on its scale), both ends included; without the present
    value itself, which is the first trial."""
    name, (low, high, *scale) = next(iter(space.items()))
    first, last = map(math.log, (low, high)) if scale else (low, high)
    values = []
    for step in range(count):
        value = first + step / max(count - 1, 1) * (last - first)
        values.append(min(max(math.exp(value) if scale else value, low), high))
    if is_whole(low, high, scale):
        values = list(map(round, values))
    start = {key: present[key] for key in space}
    return [
        start | {name: value}
        for value in values
        if not math.isclose(value, present[name], rel_tol=1e-9)
    ]


def is_whole(low: float, high: float, scale: Sequence[str]) -> bool:
    """Returns whether the values of a range are whole numbers."""
    return not scale and isinstance(low, int) and isinstance(high, int)


def distributions(present: Parameters, space: Space) -> dict:
    """Returns optuna's distributions of a space; InputError for a name that is no
    parameter, and for a range that is none or leaves out the present value."""
    kinds = optuna_library().distributions
    if not space:
        raise InputError(
            "tuning.space: no ranges; name one of each parameter to tune, {NAME: [low, high]}"
        )
    ranges = {}
    for name, (low, high, *scale) in space.items():
        where = f"tuning.space.{name}={[low, high, *scale]}"
        if name not in present:
            raise InputError(
                f"{where}: none of the parameters, {', '.join(sorted(present))}"
            )
        if not low < high or scale not in ([], ["log"]) or (scale and low <= 0):
            raise InputError(
                f"{where}: expected [low, high], or [low, high, log] above 0"
            )
        if not low <= present[name] <= high:
            raise InputError(f"{where}: leaves out the present value, {present[name]}")
        if is_whole(low, high, scale):
            ranges[name] = kinds.IntDistribution(low, high)
        else:
            ranges[name] = kinds.FloatDistribution(low, high, log=bool(scale))
    return ranges


def proposal(
    rows: Sequence[dict],
    ranges: Mapping,
    settings: SearchSettings,
    objective: Objective,
) -> Parameters:
    """Returns optuna's next parameters, which depend on nothing but the finished trials
    and the seed.

    Args:
        rows: of the finished trials.
        ranges: optuna's distributions.
        settings: of the search.
        objective: that judges the trials.
    """
    optuna = optuna_library()
    sampler = optuna.samplers.TPESampler(
        seed=settings.seed + len(rows), n_startup_trials=settings.startup
    )
    study = optuna.create_study(sampler=sampler)
    for row in rows:
        value, excess = objective.judge(row["metrics"], rows[0]["metrics"])
        if math.isinf(excess):
            value = UNKNOWN
        elif excess:
            value += REFUSED + excess
        trial = optuna.create_trial(
            params=row["parameters"],
            distributions=ranges,
            value=value,
        )
        study.add_trial(trial)
    return study.ask(dict(ranges)).params


def optuna_library() -> Any:
    """Returns the module optuna, which is silent."""
    optuna = library("optuna", "tuning", extra="tune")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
