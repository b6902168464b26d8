"""Tuning of a planner or of an adversary as `config.tuning` says: experiment=tune_planner and experiment=tune."""

import copy
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.evaluation.methods import build_ego, build_traffic, intensities, processes_of
from e2rl.evaluation.protocol import Method, Setup
from e2rl.evaluation.tune_planner import Trials
from e2rl.evaluation.tune_traffic import AttackObjective, AttackTrials
from e2rl.evaluation.tuning import TUNING_FILE, Judge, Objective, Parameters, TuneSettings, tune, yaml_of
from e2rl.planners.ego import Ego
from e2rl.prior.prior import Prior
from e2rl.run.config import check_counts, resolved
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from e2rl.run.settings import check_choice, settings_of
from e2rl.traffic.traffic import Traffic

OBJECTIVES: dict[str, type] = {
    "ego": Objective,
    "synthesizer": AttackObjective,
}  # by the group whose parameters are tuned


class Task(NamedTuple):
    """What is tuned: the group whose parameters are, their ranges, what trials are worth, and how many there are."""

    group: str
    space: dict[str, list]
    objective: Judge
    settings: TuneSettings


def run_tuning(config: DictConfig, task: Task, setup: Setup, methods: list[Method], prior: Prior, folder: Path) -> dict:
    """Do the task and print the lines to keep; returns what tuning.json holds."""
    group = task.group
    trials = planner_trials(config, setup, methods) if group == "ego" else attack_trials(config, setup, methods, prior)
    present = flat({key: value for key, value in resolved(config[group]).items() if key != "_target_"})
    about = {
        "rows": [f"{method.name}@{method.eta:g}" for method in methods],
        "seeds": list(config.seeds),
        "scenes": setup.scenes.scene_id,
        **{name: OmegaConf.to_container(config[name], resolve=True) for name in ("ego", "prior", "sim")},
        "eta": intensities(config),
    }
    how = (task.space, task.settings, task.objective, folder, about)
    result = tune(trials, present, *how, kept=Parts(folder, "tuning"))
    print(f"\n{advice(result, group)}written to {folder}")
    return result


def advice(result: Mapping, group: str) -> str:
    """What to keep of a tuning's result."""
    count = len(result["trials"])
    if result["best"] is None:
        return f"none of {count} trials keeps within the limits of tuning.objective; {TUNING_FILE} has their metrics\n"
    return f"best of {count} trials, for conf/{group}:\n{yaml_of(result['best'])}"


def tuning_of(config: DictConfig) -> Task | None:
    """`config.tuning`, None where there is none; InputError for settings that are none."""
    if config.tuning is None:
        return None
    group = config.tuning.get("group")
    check_choice("tuning.group", group, OBJECTIVES)
    try:
        plain = resolved(config.tuning)
    except OmegaConfBaseException as error:
        reason = f"no ranges for this {group}; add them, such as '+tuning.spaces.NAME={{margin: [0.2, 1.5]}}'"
        raise InputError(f"tuning.spaces: {reason}") from error
    space, objective = plain.pop("space"), plain.pop("objective", {})
    given = {key: value for key, value in plain.items() if key not in ("group", "spaces")}
    if unknown := sorted(set(given) - {field.name for field in fields(TuneSettings)}):
        raise InputError(f"tuning: {', '.join(unknown)}: no such setting; compare it with conf/experiment")
    check_counts({"ladder": 0} | given, trials=1, seed=0, startup=1, ladder=0)
    objective = settings_of(OBJECTIVES[group], objective, "tuning.objective")
    return Task(group, space, objective, TuneSettings(**given))


def planner_trials(config: DictConfig, setup: Setup, methods: list[Method]) -> Trials:
    """Trials of the `ego` group in all rows of the table."""

    def make(parameters: Parameters) -> Ego:
        return build_ego(OmegaConf.create({"ego": changed(config.ego, parameters)}))

    return Trials(setup, methods, list(config.seeds), make, processes_of(config))


def attack_trials(config: DictConfig, setup: Setup, methods: list[Method], prior: Prior) -> AttackTrials:
    """Trials of the `synthesizer` group at `config.eta`, held against the one row of `config.methods`."""
    etas = intensities(config)
    if len(methods) != 1 or len(etas) != 1 or not etas[0]:
        raise InputError(
            f"methods={list(config.methods)}, eta={config.eta}: an adversary is tuned at one eta above 0, against one "
            "row; set methods=[nominal] and one eta"
        )

    def make(parameters: Parameters) -> Traffic:
        return build_traffic(changed(config.synthesizer, parameters), prior)

    if not make({}).adversarial:
        raise InputError(f"synthesizer={config.synthesizer.name}: no adversary, so there is no attack to tune")
    return AttackTrials(setup, methods[0], etas[0], list(config.seeds), make, processes_of(config))


def flat(group: Mapping[str, Any], before: str = "") -> Parameters:
    """{dotted name: value} of nested settings."""
    found: Parameters = {}
    for name, value in group.items():
        found |= flat(value, f"{before}{name}.") if isinstance(value, dict) else {f"{before}{name}": value}
    return found


def changed(group: DictConfig, parameters: Parameters) -> DictConfig:
    """A copy of a group with parameters of dotted names."""
    copied = copy.deepcopy(group)
    for name, value in parameters.items():
        OmegaConf.update(copied, name, value)
    return copied
