"""The egos of a run that rates several: `egos` and `policy_learning` of the configuration of evaluate.py.

Several egos in the same traffic: the same scenes, noise, methods and intensities for each of them.

The noise of a rollout depends on its scene and seed alone, so egos are compared rollout by rollout. The adversaries are
made anew against each of them. Trainings of one policy with different seeds are egos of their own in the files, and are
also pooled under one name, as `metrics.statistics` says.
"""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.evaluation.methods import build_ego, compare_names
from e2rl.evaluation.protocol import Method, Setup, drive_all, record
from e2rl.evaluation.rollout_files import ROLLOUTS
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.proximity import ego_path, mean_acceleration
from e2rl.planners.ego import Ego
from e2rl.run.config import load_choice
from e2rl.run.errors import InputError
from e2rl.run.parts import NOTHING_KEPT, Kept
from e2rl.run.processes import Processes
from e2rl.scenes.scene import SceneSet


@dataclass(frozen=True)
class EgoSet:
    """egos: by their name in files. names: of the tables' columns. trainings: of those names that stand for several
    egos, these. pairs: names of which the first is compared with the second."""

    egos: Mapping[str, Ego]
    names: Sequence[str]
    pairs: Sequence[tuple[str, str]]
    trainings: Mapping[str, Sequence[str]] = field(default_factory=dict)


def run_egos(
    setup: Setup,
    egos: EgoSet,
    methods: Sequence[Method],
    seeds: Sequence[int],
    folder: Path | None = None,
    save_rollouts: bool = True,
    processes: Processes = 1,
    only: Sequence[int] | None = None,
    kept: Kept = NOTHING_KEPT,
    **fields: Any,
) -> list[dict]:
    """`run_protocol` for each of the egos instead of the setup's, into one folder; returns the rows of metrics.json.

    Besides a row for each ego, method and intensity, there is one for each name of `egos.trainings`. Rows of the first
    name of a pair are compared with the second's under `ego SECOND` of their `paired`.
    """
    into = folder / ROLLOUTS if folder is not None and save_rollouts else None
    found = drive_all(setups_of(setup, egos), methods, seeds, into, processes, only, kept)

    def summarise(rows: list[dict], features: list) -> list[dict]:
        pooled, more = pool_trainings(rows, features, egos.trainings)
        result = metric_rows(rows + pooled, features + more, egos=egos.pairs, **fields)
        return [row | {"n_trainings": len(egos.trainings.get(row["ego"], [1]))} for row in result]

    return record(*found, folder, summarise)


def setups_of(setup: Setup, egos: EgoSet) -> list[Setup]:
    """The setup with each of the egos."""
    return [replace(setup, ego=ego, ego_name=name) for name, ego in egos.egos.items()]


def pool_trainings(
    rows: Sequence[dict], features: Sequence, trainings: Mapping[str, Sequence[str]]
) -> tuple[list[dict], list]:
    """Copies of the rows of several trainings under their common name, each with the number of its `training`."""
    pooled: tuple[list[dict], list] = ([], [])
    for name, members in trainings.items():
        for row, feature in zip(rows, features, strict=True):
            if row["ego_policy"] in members:
                pooled[0].append(row | {"ego_policy": name, "training": list(members).index(row["ego_policy"])})
                pooled[1].append(feature)
    return pooled


def recorded_acceleration(scenes: SceneSet) -> float:
    """Mean |acceleration| [m/s^2] of the recorded egos, by the rule of the metric `macc`, over the scenes."""
    found = []
    for part in scenes.parts():
        stop = torch.full((len(part),), scenes.steps)
        found.append(mean_acceleration(*ego_path(part["logged"].double(), part["logged_valid"], stop)))
    return torch.cat(found).nanmean().item()


ROLES = ("before", "after", "planner")  # of policy_learning: names of `egos`
NAME = re.compile(r"[A-Za-z0-9._+-]+")  # what a file name may hold


def build_egos(config: DictConfig) -> EgoSet | None:
    """The egos of `config.egos`, None where it names none; an entry with `checkpoints` is an ego for each of them.

    Raises InputError for an ego, a field or a checkpoint that is not there, names that collide, and parts of a run that
    are made for one ego.
    """
    if not config.egos:
        if config.policy_learning is not None:
            raise InputError("policy_learning: names no egos; set egos too, as experiment=policy_learning does")
        return None
    if config.tuning is not None or config.figure == "skeleton" or config.meta_rollouts:
        raise InputError("egos: tuning, figure=skeleton and meta_rollouts are of one ego; choose it with ego=NAME")
    egos: dict[str, Ego] = {}
    trainings: dict[str, list[str]] = {}
    for name in map(str, config.egos):
        entries = versions(config, name)
        if len(entries) > 1:
            trainings[name] = list(entries)
        taken = [own for own in entries if own in egos or (own != name and own in config.egos)]
        if taken:
            raise InputError(f"egos.{name}: {', '.join(taken)} is the name of another ego, too; choose another name")
        for own, changes in entries.items():
            egos[own] = one_ego(config, name, changes)
    counts = {len(members) for members in trainings.values()}
    if len(counts) > 1:
        raise InputError(f"egos: {' and '.join(trainings)} have different numbers of checkpoints; give as many of each")
    return EgoSet(egos, list(map(str, config.egos)), compared(config), trainings)


def versions(config: DictConfig, name: str) -> dict[str, dict[str, Any]]:
    """{name in files: {ego: FILE, changes of its fields}} of an entry, one for each of its `checkpoints`."""
    entry = config.egos[name]
    where = f"egos.{name}"
    if not NAME.fullmatch(name):
        raise InputError(f"{where}: the name goes into file names; use letters, digits and . _ + -")
    if not isinstance(entry, DictConfig) or "ego" not in entry:
        raise InputError(
            f"{where}={entry!r}: expected a file of conf/ego and changes, such as {{ego: idm, headway: 2}}"
        )
    lists = entry.get("checkpoints")
    if lists is not None and not isinstance(lists, ListConfig):
        raise InputError(f"{where}.checkpoints={lists}: expected a list of training runs, [RUN, RUN]")
    missing = [key for key in entry if OmegaConf.is_missing(entry, key) and not (key == "checkpoint" and lists)]
    if missing:
        key = f"{where}.{str(missing[0])}"
        raise InputError(f"{key}: needed; give the folder that train.py wrote, {key}=RUN")
    changes = {str(key): entry[key] for key in entry if not OmegaConf.is_missing(entry, key) and key != "checkpoints"}
    if not lists:
        return {name: changes}
    if changes.get("checkpoint") is not None:
        raise InputError(f"{where}: has a checkpoint and checkpoints; give one of the two")
    if len(lists) == 1:
        return {name: changes | {"checkpoint": lists[0]}}
    return {f"{name}_{number}": changes | {"checkpoint": lists[number]} for number in range(len(lists))}


def one_ego(config: DictConfig, name: str, changes: Mapping[str, Any]) -> Ego:
    """The ego of an entry; its first weights depend on the run's seed alone, not on the other egos."""
    where = f"egos.{name}"
    try:
        changed = copy.deepcopy(config)
        OmegaConf.set_struct(changed, False)
        changed.ego = load_choice("ego", str(changes["ego"]))
        OmegaConf.set_struct(changed, True)
        for key, value in changes.items():
            if key != "ego":
                OmegaConf.update(changed, f"ego.{key}", value, merge=True)
        torch.manual_seed(config.get("seed", 0))
        return build_ego(changed)
    except OmegaConfBaseException as error:
        raise InputError(f"{where}: {str(error).splitlines()[0]}; compare it with conf/ego/{changes['ego']}") from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def compared(config: DictConfig) -> list[tuple[str, str]]:
    """Pairs of names whose difference is of interest: `policy_learning.after` with each other ego, `before` first; or
    without `policy_learning` each ego with `compare`, or with the first."""
    names = [str(name) for name in config.egos]
    if config.policy_learning is None:
        reference = names[0] if config.compare is None else compare_names(config)[0]
        return [(name, reference) for name in names if name != reference]
    for role in ROLES:
        given = config.policy_learning.get(role)
        if given not in names:
            raise InputError(f"policy_learning.{role}={given}: none of egos ({', '.join(names)}); name one of them")
    if not any(name == "nominal" for name in config.methods):
        raise InputError(f"methods={list(config.methods)}: policy_learning compares nominal driving; name nominal, too")
    before, after = config.policy_learning.before, config.policy_learning.after
    if after in (before, config.policy_learning.planner):
        raise InputError(f"policy_learning: after is {after}, and before or planner, too; name another of egos")
    return [(after, before), *((after, name) for name in names if name not in (before, after))]


def curve_runs(config: DictConfig) -> list[Path]:
    """Run folders whose learning curves are drawn: `policy_learning.runs`, or null: those among the checkpoints of
    `policy_learning.after` that have logged scalars."""
    if config.policy_learning.runs is not None:
        return [Path(run) for run in config.policy_learning.runs]
    entries = versions(config, config.policy_learning.after).values()
    paths = [Path(entry["checkpoint"]) for entry in entries if entry.get("checkpoint")]
    return [path for path in paths if (path / "logs").is_dir()]
