"""Several egos in the same traffic: the same scenes, noise, methods and intensities for each of them.

The noise of a rollout depends on its scene and seed alone, so egos are compared rollout by rollout. The adversaries are
made anew against each of them. Trainings of one policy with different seeds are egos of their own in the files, and are
also pooled under one name, as `metrics.statistics` says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from e2rl.ego.base import Ego
from e2rl.evaluation.files import ROLLOUTS
from e2rl.evaluation.kept import NOTHING_KEPT, Kept
from e2rl.evaluation.processes import Processes
from e2rl.evaluation.protocol import Method, Setup, drive_all, record
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.proximity import ego_path, mean_acceleration
from e2rl.scene.scene import SceneSet


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
