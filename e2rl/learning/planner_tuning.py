"""Update of a planner: grid search over its parameters on adversarial and nominal scenes.

The paper tunes its lane-graph planner by grid search; method_and_baselines.md 12.17 says why progress needs a guard:
standing still is the trivial optimum of safety and comfort.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tqdm import tqdm

from e2rl.errors import InputError

Parameters = dict[str, object]
NEEDED = ("collision", "comfort", "progress")


@dataclass(frozen=True)
class TuningSettings:
    """Fields: conf/learner/planner_tuning.yaml."""

    comfort: float = 0.1
    progress: float = 0.1
    progress_floor: float = 0.9


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
    settings: TuningSettings | None = None,
) -> Tuning:
    """Try the present parameters, then the whole grid; keep the best admissible trial, the present one in a tie.

    evaluate(parameters) -> metrics with "collision" (rate), "comfort" (mean |acceleration|, m/s^2) and "progress" (m);
    further ones are logged. Objective: collision + comfort weight * comfort + progress weight * share of the present
    progress that is lost. Inadmissible: less than progress_floor of the present progress, or a metric that is NaN.
    """
    settings = settings or TuningSettings()
    trials, reference, tried = [], None, [present]
    tried += [present | choice for choice in combinations(grid) if present | choice != present]
    for parameters in tqdm(tried, "planner tuning", unit="trial", leave=False):
        metrics = dict(evaluate(parameters))
        missing = [name for name in NEEDED if name not in metrics]
        if missing:
            raise InputError(f"planner tuning: evaluate() returned no {', '.join(missing)}")
        reference = metrics["progress"] if reference is None else reference
        kept = metrics["progress"] / max(reference, 1e-6)
        objective = (
            metrics["collision"] + settings.comfort * metrics["comfort"] + settings.progress * max(0.0, 1 - kept)
        )
        admissible = not math.isnan(objective) and kept >= settings.progress_floor
        trials.append({"parameters": parameters, **metrics, "objective": objective, "admissible": admissible})
    if math.isnan(trials[0]["objective"]):
        raise InputError("planner tuning: the present parameters yield NaN metrics; check the scenes")
    best = min((trial for trial in trials if trial["admissible"] or trial is trials[0]), key=lambda t: t["objective"])
    return Tuning(best["parameters"], trials)
