"""The rows of metrics.json: one per (dataset, split, method, ego, eta), with paired
differences to other methods; and the headline of each, which is counted nowhere else."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from e2rl.evaluation.modes import GROUP, key_of
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import DRAWS, REALISM_DRAWS, paired_differences, summarise
from e2rl.run.endings import command_line
from e2rl.run.run import git_commit
from e2rl.search.tries import TRIES
from e2rl.traffic.attempt import count_reasons

Key = tuple  # values of GROUP
Scores = tuple[list[dict], list[dict[str, Tensor]]]  # rows and samples
UNKNOWN = {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}


def metric_row(
    key: Key,
    *,
    scenes: int,
    seeds: int,
    rollouts: int,
    metrics: Mapping,
    git: str | None = None,
    command: str | None = None,
    **fields: Any,
) -> dict:
    """Returns a row of metrics.json.

    Args:
        key: dataset, split, method, ego and eta.
        scenes: number of scenes.
        seeds: number of seeds.
        rollouts: number of rollouts.
        metrics: means and intervals.
        git: commit of the run; None: the present one.
        command: of the run; None: the present one.
        fields: override or extend the row.
    """
    identity = dict(zip(("dataset", "split", "method", "ego", "eta"), key, strict=True))
    counts = {"n_scenes": scenes, "n_seeds": seeds, "n_rollouts": rollouts}
    origin = {
        "git": git_commit() if git is None else git,
        "command": command_line() if command is None else command,
    }
    return identity | counts | origin | {"metrics": metrics, "paired": {}} | fields


def metric_rows(
    rows: Sequence[dict],
    samples: Sequence[dict[str, Tensor]],
    *,
    errored: Sequence[dict] = (),
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
    egos: Sequence[tuple[str, str]] = (),
    trainings: Mapping[str, Sequence[str]] | None = None,
    references: Collection[str] | None = None,
    searched: bool = False,
    **fields: Any,
) -> list[dict]:
    """Returns rows of metrics.json from the rows of rollouts.

    Rollouts that the traffic lost take no part. A row's `paired` compares it with every
    other method (or eta) on the same dataset, split and ego over the shared (scene,
    seed); a method there with several etas is named method@eta. A group of which the
    traffic lost all rollouts has a row too, without metrics.

    Args:
        rows: of rollouts.
        samples: of realism, one for each row.
        errored: entries of errored.json, which are counted by their reasons.
        draws: of the bootstrap.
        realism_draws: of the bootstrap of realism.
        egos: pairs of egos of which the first is also compared with the second in the
            same traffic, under `ego SECOND`, realism without intervals; as these are
            many, a method is then compared with the first other one of its ego only.
        trainings: by name, the egos whose rollouts are pooled under it, too.
        references: the methods that others are compared with (None: all; of many rows,
            the differences cost more than the means).
        searched: the rollouts are tries. Events are those of `scene_rows`, as rates of
            tries are none of the planner, and nothing is paired: a search goes on by
            what it has found.
        fields: extend each row.
    """
    trainings = trainings or {}
    groups: dict[Key, Scores] = {}
    for row, sample in [
        *zip(rows, samples, strict=True),
        *pooled(rows, samples, trainings),
    ]:
        if not lost(row):
            group = groups.setdefault(key_of(row), ([], []))
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
            group_rows,
            group_samples,
            draws=draws,
            realism_draws=realism_draws,
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
        row |= {"searched": searched, "headline": counts}
        if row["ego"] in trainings:
            row["n_trainings"] = len(trainings[row["ego"]])
        result.append(row)
    reasons: dict[Key, list[dict]] = {key: [] for key in groups}
    for entry in errored:
        reasons.setdefault(key_of(entry), []).append(entry)
    unknown = dict.fromkeys(METRICS, UNKNOWN)
    for key in list(reasons)[len(result) :]:
        row = metric_row(key, scenes=0, seeds=0, rollouts=0, metrics=unknown, **fields)
        result.append(row)
    return [
        {"errored": count_reasons(entries)} | row
        for entries, row in zip(reasons.values(), result, strict=True)
    ]


def pooled(
    rows: Sequence[dict],
    samples: Sequence[dict[str, Tensor]],
    trainings: Mapping[str, Sequence[str]],
) -> list[tuple[dict, dict[str, Tensor]]]:
    """Returns copies of the rows of several trainings under their common name, with the
    number of their `training`, each with its sample."""
    copies = []
    for name, members in trainings.items():
        for row, sample in zip(rows, samples, strict=True):
            if row["ego_policy"] in members:
                training = list(members).index(row["ego_policy"])
                copy = row | {"ego_policy": name, "training": training}
                copies.append((copy, sample))
    return copies


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


# --- the headline


class Headline(NamedTuple):
    """In how many scenes one ego in one traffic fails preventably, and in how many it
    raised.

    Args:
        scenes: driven in; those of which the traffic lost all rollouts do not count.
        preventable: scenes with a preventable failure.
        raised: scenes in which the planner raised.
        failed: scenes with one of the two.
        ways: different ways of failing preventably, cells of the atlas.
        searches: of a scene, by how many seeds; 0: it was not searched.
        tries: of a search of a scene in the mean.
        nfe: of a search of a scene in the mean, without tries that errored.
    """

    scenes: int
    preventable: int
    raised: int
    failed: int
    ways: int
    searches: int
    tries: float
    nfe: float


def headline(rows: Sequence[Mapping[str, Any]], searched: bool) -> Headline:
    """Returns the headline of rows of rollouts of one ego, method and intensity;
    `searched`: they are tries."""
    scenes = set()
    preventable = set()
    crashed = set()
    cells = set()
    seeds = set()
    tries = 0
    nfe = 0.0
    for row in rows:
        if lost(row):
            continue
        scene = row["scene_id"]
        scenes.add(scene)
        seeds.add(row["seed"] // TRIES)
        tries += 1
        cost = row.get("nfe", 0.0)
        nfe += cost if cost == cost else 0.0
        if raised(row):
            crashed.add(scene)
        elif row.get("cfr_preventable") == 1:
            preventable.add(scene)
            cells.add(cell_of(row))
    searches = max(len(scenes) * len(seeds), 1)
    return Headline(
        scenes=len(scenes),
        preventable=len(preventable),
        raised=len(crashed),
        failed=len(preventable | crashed),
        ways=len(cells - {None}),
        searches=len(seeds) if searched else 0,
        tries=tries / searches if searched else 0.0,
        nfe=nfe / searches if searched else 0.0,
    )
