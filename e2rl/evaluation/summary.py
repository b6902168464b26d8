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
Scores = tuple[list[dict], list[dict[str, Tensor]]]  # rows and samples
UNKNOWN = {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}


def group_of(row: Mapping) -> Key:
    """Returns the values of GROUP of a row of metrics.json, of rollouts.csv or of
    errored.json."""
    ego = row["ego"] if "ego" in row else row["ego_policy"]
    return row["dataset"], row["split"], row["method"], ego, row["eta"]


def metric_row(
    key: Key, *, scenes: int, seeds: int, rollouts: int, metrics: Mapping, **fields: Any
) -> dict:
    """Returns a row of metrics.json.

    Args:
        key: dataset, split, method, ego and eta.
        scenes: number of scenes.
        seeds: number of seeds.
        rollouts: number of rollouts.
        metrics: means and intervals.
        fields: override or extend the row.
    """
    identity = dict(zip(("dataset", "split", "method", "ego", "eta"), key, strict=True))
    counts = {"n_scenes": scenes, "n_seeds": seeds, "n_rollouts": rollouts}
    origin = {"git": git_commit(), "command": command_line()}
    return identity | counts | origin | {"metrics": metrics, "paired": {}} | fields


def metric_rows(
    rows: Sequence[dict],
    samples: Sequence[dict[str, Tensor]],
    *,
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
    egos: Sequence[tuple[str, str]] = (),
    references: Collection[str] | None = None,
    searched: bool = False,
    **fields: Any,
) -> list[dict]:
    """Returns rows of metrics.json from the rows of rollouts.

    Rollouts that the traffic lost take no part. A row's `paired` compares it with every
    other method (or eta) on the same dataset, split and ego over the shared (scene,
    seed); a method there with several etas is named method@eta.

    Args:
        rows: of rollouts.
        samples: of realism, one for each row.
        draws: of the bootstrap.
        realism_draws: of the bootstrap of realism.
        egos: pairs of egos of which the first is also compared with the second in the
            same traffic, under `ego SECOND`, realism without intervals; as these are
            many, a method is then compared with the first other one of its ego only.
        references: the methods that others are compared with (None: all; of many rows,
            the differences cost more than the means).
        searched: the rollouts are tries. Events are those of `scene_rows`, as rates of
            tries are none of the planner, and nothing is paired: a search goes on by
            what it has found.
        fields: extend each row.
    """
    groups: dict[Key, Scores] = {}
    for row, sample in zip(rows, samples, strict=True):
        if not lost(row):
            group = groups.setdefault(group_of(row), ([], []))
            group[0].append(row)
            group[1].append(sample)
    result = []
    for key, (group_rows, group_samples) in groups.items():
        paired = {}
        if not searched:
            paired = paired_with_methods(
                key,
                groups,
                draws=draws,
                realism_draws=realism_draws,
                references=references,
                only_first=bool(egos),
            )
            paired |= paired_with_egos(key, groups, egos=egos, draws=draws)
        metrics = summarise(
            group_rows, group_samples, draws=draws, realism_draws=realism_draws
        )
        if searched:
            metrics |= scene_metrics(group_rows, draws)
        step = TRIES if searched else 1
        row = metric_row(
            key,
            scenes=len({row["scene_id"] for row in group_rows}),
            seeds=len({row["seed"] // step for row in group_rows}),
            rollouts=len(group_rows),
            metrics=metrics,
            paired=paired,
            **fields,
        )
        counts = headline(group_rows, searched)._asdict()
        result.append(row | {"searched": searched, "headline": counts})
    return result


def paired_with_methods(
    key: Key,
    groups: Mapping[Key, Scores],
    *,
    draws: int,
    realism_draws: int,
    references: Collection[str] | None,
    only_first: bool,
) -> dict[str, dict]:
    """Returns paired differences of a group to the other methods and intensities of its
    ego.

    Args:
        key: of the group.
        groups: all of them.
        draws: of the bootstrap.
        realism_draws: of the bootstrap of realism.
        references: methods to compare with (None: all).
        only_first: with the first of them alone.
    """
    others = []
    for other in groups:
        same = (other[0], other[1], other[3]) == (key[0], key[1], key[3])
        if same and other != key and (references is None or other[2] in references):
            others.append(other)
    paired = {}
    for other in others[:1] if only_first else others:
        etas = {group[4] for group in groups if group[:4] == other[:4]}
        name = other[2] if len(etas) == 1 else f"{other[2]}@{other[4]:g}"
        paired[name] = paired_differences(
            groups[key][0],
            groups[key][1],
            groups[other][0],
            groups[other][1],
            draws=draws,
            realism_draws=realism_draws,
        )
    return paired


def paired_with_egos(
    key: Key,
    groups: Mapping[Key, Scores],
    *,
    egos: Sequence[tuple[str, str]],
    draws: int,
) -> dict[str, dict]:
    """Returns paired differences of a group to other egos in its traffic.

    Args:
        key: of the group.
        groups: all of them.
        egos: pairs of names.
        draws: of the bootstrap.
    """
    paired = {}
    for first, second in egos:
        other = (*key[:3], second, key[4])
        if first == key[3] and other in groups:
            paired[f"ego {second}"] = paired_differences(
                groups[key][0],
                groups[key][1],
                groups[other][0],
                groups[other][1],
                draws=draws,
                realism_draws=0,
            )
    return paired


def events() -> list[str]:
    """Returns the names of the metrics that happen to the ego in a rollout or not."""
    return [name for name, metric in METRICS.items() if metric.event]


def scene_rows(
    rows: Sequence[Mapping], names: Collection[str] | None = None
) -> list[dict]:
    """Returns a row for each search of each scene, from the rows of its tries: `names`,
    1 where any try has the event, NaN where none knows it; whether the planner raised;
    seed: of the search. Tries that the traffic lost take no part."""
    names = events() if names is None else names
    names = [name for name in names if name != "errored"]
    scenes: dict[tuple, dict] = {}
    for row in rows:
        if lost(row):
            continue
        identity = {name: row[name] for name in (*GROUP, "scene_id", "location")}
        identity["seed"] = row["seed"] // TRIES
        unknown = dict.fromkeys(names, math.nan)
        scene = scenes.setdefault(
            tuple(identity.values()), identity | unknown | {"errored": 0.0}
        )
        for name in names:
            metric = METRICS[name]
            value = float(row.get(metric.source, math.nan))
            if raised(row):
                value = metric.raised
            if not scene[name] >= value and not math.isnan(value):
                scene[name] = value
        scene["errored"] = max(scene["errored"], float(raised(row)))
    return list(scenes.values())


def scene_metrics(rows: Sequence[Mapping], draws: int) -> dict[str, dict[str, float]]:
    """Returns the events of the scenes of tries as `summarise` gives them; rates per
    kilometre are not known."""
    scenes = scene_rows(rows)
    samples = [NO_SAMPLES] * len(scenes)
    metrics = summarise(scenes, samples, draws=draws, realism_draws=0)
    per_distance = [name for name, metric in METRICS.items() if metric.per]
    event_metrics = {name: metrics[name] for name in events()}
    return event_metrics | dict.fromkeys(per_distance, UNKNOWN)


def empty_rows(known: Sequence[dict], errored: Sequence[dict]) -> list[dict]:
    """Returns rows of metrics.json of the groups of which every rollout errored: no
    metric is known. known: the rows of the others, of which the first lends the fields
    that all have."""
    first = known[0] if known else {}
    shared = {
        name: first[name] for name in ("git", "command", "stage") if name in first
    }
    present = {group_of(row) for row in known}
    absent = dict.fromkeys(group_of(entry) for entry in errored)
    return [
        metric_row(
            key,
            scenes=0,
            seeds=0,
            rollouts=0,
            metrics=dict.fromkeys(METRICS, UNKNOWN),
            **shared,
        )
        for key in absent
        if key not in present
    ]
