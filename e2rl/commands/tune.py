"""`e2rl tune synthesizer=NAME`, or `e2rl tune tuning.group=ego ego=NAME`: parameters of
most, or fewest, failures.

Writes tuning.json and tuned.yaml (the lines to keep in conf/). The ranges are those of
the class (`tuned`), or tuning.space (docs/guide/adversary.md, docs/guide/planner.md).
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from e2rl.driving.batches import Batch
from e2rl.driving.setup import Method
from e2rl.evaluation.build import (
    build_ego,
    build_search,
    build_traffic,
    method_config,
)
from e2rl.evaluation.plan import Evaluation, begin
from e2rl.evaluation.trials import (
    NOMINAL,
    AttackObjective,
    AttackTrials,
    PlannerObjective,
    PlannerTrials,
)
from e2rl.evaluation.tuning import (
    STUDY_FILE,
    Objective,
    Parameters,
    SearchSettings,
    line_of,
    save,
    search,
    yaml_of,
)
from e2rl.run.command import run_command
from e2rl.run.config import check_choice, resolved, settings_of, with_changes
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from e2rl.search.tries import SEARCH, TRIES_FILE
from e2rl.search.tries_file import failures_of

MAY_CHANGE = ("processes",)  # when a run is resumed
GROUPS = ("synthesizer", "ego")


def tune(run: Run) -> dict:
    """Do the trials that are left; returns what tuning.json holds."""
    config = run.config
    folder = run.folder
    tuning = config.tuning
    check_choice("tuning.group", tuning.group, choices=GROUPS)
    names = [field.name for field in fields(SearchSettings)]
    settings = settings_of(
        SearchSettings,
        {name: tuning[name] for name in names},
        where="tuning",
    )
    plan = begin(
        run,
        f"once a scene and seed in each of {settings.trials} trials",
        times=settings.trials,
    )
    objective: Objective
    trials: PlannerTrials | AttackTrials
    failures: list[Batch] = []
    if tuning.group == "ego":
        objective = settings_of(
            PlannerObjective,
            tuning.planner,
            where="tuning.planner",
        )
        failures = tuned_failures(config, plan)
        trials = planner_trials(config, plan, failures)
        ranges = plan.setups[0].ego.tuned
        methods = [f"{method.name}@{method.eta:g}" for method in plan.methods]
    else:
        objective = settings_of(AttackObjective, tuning.attack, where="tuning.attack")
        trials, ranges = attack_trials(config, plan)
        methods = [NOMINAL]

    def show(rows: list[dict]) -> None:
        save(rows, folder)
        print(line_of(rows, objective))

    about: dict[str, Any] = {
        name: resolved(config[name]) for name in ("ego", "prior", "sim")
    }
    about |= {
        "rows": methods,
        "seeds": list(plan.settings.seeds),
        "failures": [[list(task) for task in batch.tasks] for batch in failures],
        "scenes": plan.scenes.scene_id,
        "eta": list(plan.settings.eta),
    }
    rows = search(
        trials,
        flat(resolved(config[tuning.group])),
        space=resolved(tuning.space) or ranges,
        settings=settings,
        objective=objective,
        file=Path(tuning.study or folder / STUDY_FILE),
        about=about,
        after_trial=show,
    )
    result = save(rows, folder)
    best = "no trial keeps within the limits\n"
    if result["best"]:
        best = (
            f"best of {len(rows)} trials, for conf/{tuning.group}:\n"
            f"{yaml_of(result['best'])}"
        )
    print(f"\n{best}written to {folder}")
    return result


def tuned_failures(config: DictConfig, plan: Evaluation) -> list[Batch]:
    """Returns the tries of `tuning.failures` that hit the planner."""
    if config.tuning.failures is None:
        return []
    method = build_search(SEARCH, config, plan.prior, eta=max(plan.settings.eta))
    return failures_of(
        Path(config.tuning.failures) / TRIES_FILE,
        plan.setups[0].ego_name,
        method=method,
        setup=plan.setups[0],
    )


def planner_trials(
    config: DictConfig,
    plan: Evaluation,
    failures: list[Batch],
) -> PlannerTrials:
    """Returns trials of the group `ego` against all of `config.methods`, and in the
    tries `failures`."""

    def make(parameters: Parameters) -> Any:
        ego = with_changes(config.ego, parameters, where="tuning.space", group="ego")
        return build_ego(OmegaConf.create({"ego": ego}))

    return PlannerTrials(
        plan.setups[0],
        plan.methods,
        seeds=plan.settings.seeds,
        make=make,
        processes=plan.settings.processes,
        failures=failures,
    )


def attack_trials(config: DictConfig, plan: Evaluation) -> tuple[AttackTrials, Mapping]:
    """Returns trials of the group `synthesizer` at `config.eta` beside nominal traffic,
    and the ranges of its class."""
    etas = plan.settings.eta
    if len(etas) != 1 or not etas[0]:
        raise InputError(
            f"eta={config.eta}: an adversary is tuned at one intensity above 0"
        )

    def make(parameters: Parameters) -> Any:
        return build_traffic(
            with_changes(
                config.synthesizer,
                parameters,
                where="tuning.space",
                group="synthesizer",
            ),
            plan.prior,
        )

    present = make({})
    if not present.adversarial:
        raise InputError(
            f"synthesizer={config.synthesizer.name}: no adversary, so there is no attack to tune"
        )
    nominal = Method(NOMINAL, build_traffic(method_config(config, NOMINAL), plan.prior))
    trials = AttackTrials(
        plan.setups[0],
        nominal,
        eta=etas[0],
        seeds=plan.settings.seeds,
        make=make,
        processes=plan.settings.processes,
    )
    return trials, present.tuned


def flat(group: Mapping[str, Any], before: str = "") -> Parameters:
    """Returns {dotted name: value} of nested settings."""
    settings: Parameters = {}
    for name, value in group.items():
        if isinstance(value, dict):
            settings |= flat(value, f"{before}{name}.")
        else:
            settings[f"{before}{name}"] = value
    return settings


def main() -> None:
    """The command."""
    run_command("tune", tune, may_change=MAY_CHANGE)
