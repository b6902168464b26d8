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
from e2rl.run.config import library
from e2rl.run.errors import InputError
from e2rl.run.files import misfit, read_regular, write_atomically
from e2rl.run.settings import configured, setting

Parameters = dict[str, Any]
Space = Mapping[
    str, Sequence
]  # {name: (low, high) or (low, high, "log")} of some parameters; whole numbers stay whole
Evaluate = Callable[[Parameters], Mapping[str, float]]  # the metrics of a trial
REFUSED = 10.0  # added to the objective of refused trials, so that the sampler leaves their region
UNKNOWN = 2 * REFUSED  # of trials in which no rollout has a score
STUDY = {
    "task": dict,
    "trials": [
        {"parameters": {...: int | float}, "metrics": {...: int | float | None}}
    ],
}  # its file
MAX_STUDY = 1 << 24  # bytes of it
STUDY_FILE = "study.json"
TUNING_FILE = "tuning.json"
TUNED_FILE = "tuned.yaml"


class Objective(Protocol):
    """The objective of metrics; shown: names of those in a trial's line."""

    shown: ClassVar[tuple[str, ...]]

    def judge(
        self, metrics: Mapping[str, float], reference: Mapping[str, float]
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
    then optuna's proposals. Raises InputError for a space that does not fit, for a
    study of another task, and where the present parameters have no metrics.

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
    """
    ranges = distributions(present, space)
    fixed = [
        {name: present[name] for name in space},
        *sweep(present, space, count=settings.sweep),
    ]
    task = {
        "space": {name: list(space[name]) for name in space},
        "parameters": present,
        "sweep": settings.sweep,
    }
    task = json.loads(
        json.dumps(nulls(task | {"objective": vars(objective)} | dict(about or {})))
    )
    rows = read_study(file, task, ranges=ranges, objective=objective)
    for number in range(len(rows), settings.trials):
        parameters = (
            fixed[number]
            if number < len(fixed)
            else proposal(rows, ranges, settings=settings, objective=objective)
        )
        metrics = dict(evaluate(present | parameters))
        value, excess = objective.judge(
            metrics, rows[0]["metrics"] if rows else metrics
        )
        if math.isinf(excess) and not rows:
            reasons = [
                name
                for name, part in metrics.items()
                if name.startswith(("errored: ", "errored_")) and part
            ]
            raise InputError(
                f"tuning: {parameters} yield NaN metrics "
                f"({', '.join(reasons) or 'check the scenes'})"
            )
        rows.append(
            {
                "parameters": parameters,
                "metrics": metrics,
                "objective": value,
                "admissible": excess == 0,
            }
        )
        if file is not None:
            write_atomically(file, json.dumps(nulls({"task": task, "trials": rows})))
        after_trial(rows)
    return rows


def read_study(
    file: Path | None, task: Mapping, ranges: Mapping, objective: Objective
) -> list[dict]:
    """Returns the rows of a study's file, none where there is none; InputError where it
    is no study, or of another task."""
    if file is None or not os.path.lexists(file):
        return []
    try:
        study = json.loads(read_regular(file, MAX_STUDY))
        if wrong := misfit(study, STUDY):
            raise ValueError(wrong)
        known = study["task"]
        rows = [nans(row) for row in study["trials"]]
        if differ := sorted(
            name for name in {*known, *task} if known.get(name) != task.get(name)
        ):
            raise InputError(
                f"tuning.study={file}: a study that differs in {', '.join(differ)}; "
                "name another file"
            )
        return [
            _row(
                row["parameters"],
                row["metrics"],
                reference=rows[0]["metrics"],
                ranges=ranges,
                objective=objective,
            )
            for row in rows
        ]
    except InputError:
        raise
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        raise InputError(
            f"tuning.study={file}: no study, or a damaged one ({error}); name another file"
        ) from error


def _row(
    parameters: Parameters,
    metrics: Mapping,
    reference: Mapping,
    ranges: Mapping,
    objective: Objective,
) -> dict:
    """The row of a trial in a study's file; ValueError for parameters out of their
    ranges."""
    inside = parameters.keys() == ranges.keys() and all(
        isinstance(value, type(ranges[name].low) | int)
        and ranges[name].low <= value <= ranges[name].high
        for name, value in parameters.items()
    )
    if not inside:
        raise ValueError("a trial out of its ranges")
    list(map(float, metrics.values()))  # raises OverflowError for an endless number
    value, excess = objective.judge(metrics, reference)
    return {
        "parameters": parameters,
        "metrics": metrics,
        "objective": value,
        "admissible": excess == 0,
    }


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
        OmegaConf.update(
            tree, name, float(f"{value:.4g}") if isinstance(value, float) else value
        )
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
    ends = (math.log(low), math.log(high)) if scale else (low, high)
    values = [
        ends[0] + step / max(count - 1, 1) * (ends[1] - ends[0])
        for step in range(count)
    ]
    values = [
        min(max(math.exp(value) if scale else value, low), high) for value in values
    ]
    if isinstance(low, int) and isinstance(high, int) and not scale:
        values = [round(value) for value in values]
    others = [
        value
        for value in values
        if not math.isclose(value, present[name], rel_tol=1e-9)
    ]
    return [{each: present[each] for each in space} | {name: value} for value in others]


def distributions(present: Parameters, space: Space) -> dict:
    """Returns optuna's distributions of a space; InputError for a name that is no
    parameter, and for a range that is none or leaves out the present value."""
    optuna = _optuna()
    if not space:
        raise InputError(
            "tuning.space: no ranges; name one of each parameter to tune, {NAME: [low, high]}"
        )
    values_of = {}
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
        whole = not scale and isinstance(low, int) and isinstance(high, int)
        kind = (
            optuna.distributions.IntDistribution
            if whole
            else optuna.distributions.FloatDistribution
        )
        values_of[name] = kind(low, high, log=bool(scale))
    return values_of


def proposal(
    rows: Sequence[dict],
    ranges: Mapping,
    settings: SearchSettings,
    objective: Objective,
) -> Parameters:
    """Returns optuna's next parameters, which depend on nothing but the finished trials
    and the seed."""
    optuna = _optuna()
    sampler = optuna.samplers.TPESampler(
        seed=settings.seed + len(rows), n_startup_trials=settings.startup
    )
    study = optuna.create_study(sampler=sampler)
    for row in rows:
        value, excess = objective.judge(row["metrics"], rows[0]["metrics"])
        value = (
            UNKNOWN
            if math.isinf(excess)
            else value + (REFUSED + excess if excess else 0)
        )
        study.add_trial(
            optuna.create_trial(
                params=row["parameters"], distributions=ranges, value=value
            )
        )
    return study.ask(dict(ranges)).params


def _optuna() -> Any:
    optuna = library("optuna", "tuning", extra="tune")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
