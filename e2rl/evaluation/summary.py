"""The rows of metrics.json: one per (dataset, split, method, ego, eta), with paired
differences to other methods."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from torch import Tensor

from e2rl.evaluation.headline import headline
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import DRAWS, REALISM_DRAWS, paired_differences, summarise
from e2rl.run.endings import command_line
from e2rl.run.run import git_commit
from e2rl.search.tries import TRIES

GROUP = ("dataset", "split", "method", "ego_policy", "eta")
Key = tuple  # values of GROUP


def group_of(row: Mapping) -> Key:
    """Values of GROUP of a row of metrics.json, of rollouts.csv or of errored.json."""
    return tuple(
        row["ego" if name == "ego_policy" and "ego" in row else name] for name in GROUP
    )


def metric_row(
    key: Key, scenes: int, seeds: int, rollouts: int, metrics: Mapping, **fields: Any
) -> dict:
    """One row of metrics.json; key: dataset, split, method, ego and eta; fields
    override or extend it."""
    identity = dict(zip(("dataset", "split", "method", "ego", "eta"), key, strict=True))
    counts = {"n_scenes": scenes, "n_seeds": seeds, "n_rollouts": rollouts}
    origin = {"git": git_commit(), "command": command_line()}
    return identity | counts | origin | {"metrics": metrics, "paired": {}} | fields


def metric_rows(
    rows: Sequence[dict],
    features: Sequence[dict[str, Tensor]],
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
    egos: Sequence[tuple[str, str]] = (),
    references: Collection[str] | None = None,
    searched: bool = False,
    **fields: Any,
) -> list[dict]:
    """Rows of metrics.json from the rows of rollouts and their realism samples
    (`features`).

    Rollouts that the traffic lost take no part. Of tries of searches (`searched`)
    events are those of `scene_rows`, as rates of tries are none of the planner, and
    nothing is paired: a search goes on by what it has found.

    A row's `paired` compares it with every other method (or eta) on the same dataset,
    split and ego over the shared (scene, seed); a method there with several etas is
    named method@eta. egos: pairs of egos of which the first is also compared with the
    second in the same traffic, under `ego SECOND`, realism without intervals; as these
    are many, a method is then compared with the first other one of its ego only.
    references: the methods that others are compared with (None: all; of many rows, the
    differences cost more than the means). `fields` extend each row.
    """
    groups: dict[Key, list[int]] = {}
    for index, row in enumerate(rows):
        if not lost(row):
            groups.setdefault(group_of(row), []).append(index)
    members = {
        key: ([rows[i] for i in index], [features[i] for i in index])
        for key, index in groups.items()
    }
    result = []
    for key, ours in members.items():
        paired = {}
        others = [
            other
            for other in members
            if other != key and (*other[:2], other[3]) == (*key[:2], key[3])
        ]
        others = [
            other for other in others if references is None or other[2] in references
        ]
        for other in others[: 0 if searched else 1 if egos else None]:
            differences = paired_differences(
                *ours, *members[other], draws=draws, realism_draws=realism_draws
            )
            paired[_method_name(other, members)] = differences
        for first, second in () if searched else egos:
            other = (*key[:3], second, key[4])
            if first == key[3] and other in members:
                paired[f"ego {second}"] = paired_differences(
                    *ours, *members[other], draws=draws, realism_draws=0, relative=True
                )
        metrics = summarise(*ours, draws=draws, realism_draws=realism_draws)
        if searched:
            metrics |= scene_metrics(ours[0], draws)
        scenes = {row["scene_id"] for row in ours[0]}
        seeds = {row["seed"] // (TRIES if searched else 1) for row in ours[0]}
        row = metric_row(
            key,
            len(scenes),
            seeds=len(seeds),
            rollouts=len(ours[0]),
            metrics=metrics,
            paired=paired,
            **fields,
        )
        result.append(
            row
            | {"searched": searched, "headline": headline(ours[0], searched)._asdict()}
        )
    return result


def events() -> list[str]:
    """Returns the names of the metrics that happen to the ego in a rollout or not."""
    return [name for name, metric in METRICS.items() if metric.event]


def scene_rows(
    rows: Sequence[Mapping], names: Collection[str] | None = None
) -> list[dict]:
    """A row for each search of each scene, from the rows of its tries: `names`, 1 where
    any try has the event, NaN where none knows it; whether the planner raised; seed: of
    the search. Tries that the traffic lost take no part."""
    names = [
        name for name in (events() if names is None else names) if name != "errored"
    ]
    found: dict[tuple, dict] = {}
    for row in (row for row in rows if not lost(row)):
        identity = {name: row[name] for name in (*GROUP, "scene_id", "location")} | {
            "seed": row["seed"] // TRIES
        }
        scene = found.setdefault(
            tuple(identity.values()),
            identity | dict.fromkeys(names, math.nan) | {"errored": 0.0},
        )
        for name in names:
            value = (
                METRICS[name].raised
                if raised(row)
                else float(row.get(METRICS[name].source, math.nan))
            )
            known = [each for each in (scene[name], value) if not math.isnan(each)]
            scene[name] = max(known, default=math.nan)
        scene["errored"] = max(scene["errored"], float(raised(row)))
    return list(found.values())


def scene_metrics(rows: Sequence[Mapping], draws: int) -> dict[str, dict[str, float]]:
    """Returns the events of the scenes of tries as `summarise` gives them; rates per
    kilometre are not known."""
    scenes = scene_rows(rows)
    found = summarise(scenes, [NO_SAMPLES] * len(scenes), draws=draws, realism_draws=0)
    nothing = {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}
    per_distance = {name: nothing for name, metric in METRICS.items() if metric.per}
    return {name: found[name] for name in events()} | per_distance


def empty_rows(known: Sequence[dict], errored: Sequence[dict]) -> list[dict]:
    """Rows of metrics.json of the groups of which every rollout errored: no metric is
    known. known: the rows of the others, of which the first lends the fields that all
    have."""
    present = set(map(group_of, known))
    absent = dict.fromkeys(map(group_of, errored))
    nothing = {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}
    shared = {
        name: known[0][name]
        for name in ("git", "command", "stage")
        if known and name in known[0]
    }
    return [
        metric_row(
            key,
            0,
            seeds=0,
            rollouts=0,
            metrics=dict.fromkeys(METRICS, nothing),
            **shared,
        )
        for key in absent
        if key not in present
    ]


def _method_name(key: Key, keys: Collection[Key]) -> str:
    """The group's method, with its eta if the method occurs with several etas for the
    same ego."""
    etas = {other[4] for other in keys if other[:4] == key[:4]}
    return key[2] if len(etas) == 1 else f"{key[2]}@{key[4]:g}"
