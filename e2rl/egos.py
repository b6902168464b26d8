"""The egos of a run that rates several: `egos` and `policy_learning` of the configuration of evaluate.py."""

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.build import build_ego, compare_names, load_choice
from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.evaluation.egos import EgoSet

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
