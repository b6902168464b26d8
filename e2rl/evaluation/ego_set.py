"""The egos that a run rates, in the same traffic: the same scenes, noise, methods and
intensities for each of them.

The noise of a rollout depends on its scene and seed alone, so egos are compared rollout
by rollout. Each is attacked by adversaries of its own. Trainings of one policy with
different seeds are separate egos in the files, and are also pooled under one name, as
`metrics.statistics` says.
"""

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor

from e2rl.driving.setup import Setup
from e2rl.evaluation.build import build_ego
from e2rl.evaluation.check import as_list
from e2rl.evaluation.summary import metric_rows
from e2rl.planners.ego import Ego
from e2rl.run.config import load_choice
from e2rl.run.errors import InputError

NAME = re.compile(r"[A-Za-z0-9._+-]+")  # what a file name may hold


@dataclass(frozen=True)
class EgoSet:
    """The egos of a run.

    Args:
        egos: by their name in files.
        names: of the tables' columns.
        pairs: names of which the first is compared with the second.
        trainings: of those names that stand for several egos, these.
    """

    egos: Mapping[str, Ego]
    names: Sequence[str]
    pairs: Sequence[tuple[str, str]] = ()
    trainings: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def setups(self, setup: Setup) -> list[Setup]:
        """Returns the setup with each of the egos."""
        return [
            replace(setup, ego=ego, ego_name=name) for name, ego in self.egos.items()
        ]

    def metric_rows(
        self,
        rows: list[dict],
        features: list[dict[str, Tensor]],
        references: Collection[str] | None = None,
        **fields: Any,
    ) -> list[dict]:
        """Returns the rows of metrics.json: for each ego, method and intensity, and for
        each name of `trainings`.

        Rows of the first name of a pair are compared with the second's under `ego
        SECOND` of their `paired`. references, fields: see
        `e2rl.evaluation.summary.metric_rows`.
        """
        pooled, pooled_features = pool_trainings(
            rows, features, trainings=self.trainings
        )
        result = metric_rows(
            rows + pooled,
            features + pooled_features,
            egos=self.pairs,
            references=references,
            **fields,
        )
        counts = {name: len(members) for name, members in self.trainings.items()}
        return [
            row | {"n_trainings": counts[row["ego"]]} if row["ego"] in counts else row
            for row in result
        ]


def pool_trainings(
    rows: Sequence[dict], features: Sequence, trainings: Mapping[str, Sequence[str]]
) -> tuple[list[dict], list]:
    """Returns copies of the rows of several trainings under their common name, with the
    number of their `training`."""
    pooled: tuple[list[dict], list] = ([], [])
    for name, members in trainings.items():
        for row, feature in zip(rows, features, strict=True):
            if row["ego_policy"] in members:
                pooled[0].append(
                    row
                    | {
                        "ego_policy": name,
                        "training": list(members).index(row["ego_policy"]),
                    }
                )
                pooled[1].append(feature)
    return pooled


# --- from the configuration


def build_egos(config: DictConfig, name: str) -> EgoSet:
    """Returns the egos of `config.egos`, or where it names none the one of the group
    `ego`, a file called `name`.

    An entry with `checkpoints` is an ego for each of them. Raises InputError for an
    ego, a field or a checkpoint that is not there, and for names that collide.
    """
    if not config.egos:
        return EgoSet({name: build_ego(config)}, [name])
    egos: dict[str, Ego] = {}
    trainings: dict[str, list[str]] = {}
    for entry in map(str, config.egos):
        members = trainings_of(config, entry)
        if len(members) > 1:
            trainings[entry] = list(members)
        taken = [
            own
            for own in members
            if own in egos or (own != entry and own in config.egos)
        ]
        if taken:
            raise InputError(
                f"egos.{entry}: {', '.join(taken)} is the name of another ego, too; "
                "choose another name"
            )
        egos |= {
            own: one_ego(config, entry, changes=changes)
            for own, changes in members.items()
        }
    counts = {len(members) for members in trainings.values()}
    if len(counts) > 1:
        raise InputError(
            f"egos: {' and '.join(trainings)} have different numbers of checkpoints; "
            "give as many of each"
        )
    return EgoSet(
        egos, list(map(str, config.egos)), pairs=compared(config), trainings=trainings
    )


def trainings_of(config: DictConfig, name: str) -> dict[str, dict[str, Any]]:
    """Returns {name in files: {ego: FILE, changes of its fields}} of an entry, one for
    each of its `checkpoints`."""
    entry = config.egos[name]
    where = f"egos.{name}"
    if not NAME.fullmatch(name):
        raise InputError(
            f"{where}: the name goes into file names; use letters, digits and . _ + -"
        )
    if not isinstance(entry, DictConfig) or "ego" not in entry:
        raise InputError(
            f"{where}={entry!r}: expected a file of conf/ego and changes, such as "
            f"{{ego: idm, headway: 2}}"
        )
    several = entry.get("checkpoints") or []
    if not isinstance(several, list | ListConfig):
        raise InputError(
            f"{where}.checkpoints={several}: expected a list of training runs, [RUN, RUN]"
        )
    missing = [
        key
        for key in entry
        if OmegaConf.is_missing(entry, key) and not (key == "checkpoint" and several)
    ]
    if missing:
        key = f"{where}.{str(missing[0])}"
        raise InputError(
            f"{key}: needed; give the folder that train.py wrote, {key}=RUN"
        )
    changes = {
        str(key): entry[key]
        for key in entry
        if not OmegaConf.is_missing(entry, key) and key != "checkpoints"
    }
    if several and changes.get("checkpoint") is not None:
        raise InputError(
            f"{where}: has a checkpoint and checkpoints; give one of the two"
        )
    if len(several) < 2:
        return {name: changes | ({"checkpoint": several[0]} if several else {})}
    return {
        f"{name}_{number}": changes | {"checkpoint": each}
        for number, each in enumerate(several)
    }


def one_ego(config: DictConfig, name: str, changes: Mapping[str, Any]) -> Ego:
    """Returns the ego of an entry; its first weights depend on the run's seed alone,
    not on the other egos."""
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
        raise InputError(
            f"{where}: {str(error).splitlines()[0]}; compare it with conf/ego/{changes['ego']}"
        ) from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def compared(config: DictConfig) -> list[tuple[str, str]]:
    """Returns pairs of names whose difference is of interest: each ego with `compare`,
    or with the first."""
    names = [str(name) for name in config.egos]
    reference = (as_list(config.compare) or names)[0]
    return [(name, reference) for name in names if name != reference]
