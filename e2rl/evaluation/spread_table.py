"""The spread of the prior's samples beside that of MANY steps: what few network evaluations lose of it."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch

from e2rl.evaluation.displacement_table import BATCH, EGO
from e2rl.evaluation.protocol import Method
from e2rl.evaluation.summary import metric_row
from e2rl.metrics.catalogue import SPREAD_STAGE, STAGES, Metric
from e2rl.metrics.statistics import bootstrap_draws, cluster_index, interval, resampled_means
from e2rl.prior.prior import Prior
from e2rl.prior.spread import sample_variances
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.scenes.scene import SceneSet
from e2rl.traffic.nominal import NominalTraffic

MANY = 200  # steps of the reverse SDE that stand for the trained distribution
STAGES[SPREAD_STAGE] = (
    Metric("knot_variance", "variance over samples of an acceleration knot"),
    Metric("lateral_variance", "variance over samples of a lateral knot"),
    Metric("travel_std", "standard deviation over samples of the way after 5 s", unit="m"),
    *(
        Metric(f"{name}_ratio", f"{name} over that of {MANY} steps")
        for name in ("knot_variance", "lateral_variance", "travel_std")
    ),
    Metric("covered_50", "recorded ways after 5 s in the central half of the samples'", fraction=True),
    Metric("covered_90", "recorded ways after 5 s in the central nine tenths of the samples'", fraction=True),
)


def spread_rows(
    scenes: SceneSet, methods: Sequence[Method], samples: int, device: str = "cpu", parts: Parts = NO_PARTS
) -> list[dict]:
    """Rows of metrics.json, stage `spread`, of every method that is the prior alone; intervals over places.

    samples: of each scene. parts: the methods that are done.
    """
    rows = []
    for method in methods:
        if method.eta > 0 or not isinstance(method.traffic, NominalTraffic) or method.traffic.adversarial:
            continue
        prior = method.traffic.prior
        many = copy.copy(prior)
        many.sampler = replace(prior.sampler, steps=MANY)
        few_sums, many_sums = (
            parts.result(
                f"spread-{method.name}-{each.sampler.steps:03}",
                [method.name, samples, each.sampler.steps],
                partial(_sums, each, scenes, samples, device),
            )
            for each in (prior, many)
        )
        key = (scenes.dataset, scenes.split, method.name, EGO, method.eta)
        count, metrics = len(scenes), _summary(few_sums, many_sums, scenes)
        rows.append(metric_row(key, count, samples, count * samples, metrics, stage=SPREAD_STAGE))
    return rows


def _sums(prior: Prior, scenes: SceneSet, samples: int, device: str) -> torch.Tensor:
    """Sums [R, 7] of each scene: see `sample_variances`."""
    found = [
        torch.stack(list(sample_variances(prior, scenes.batch(rows).to(device), samples).values()), -1).cpu()
        for rows in torch.arange(len(scenes)).split(BATCH)
    ]
    return torch.cat(found)


def _summary(few: torch.Tensor, many: torch.Tensor, scenes: SceneSet) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}; n counts vehicles."""
    cluster, clusters = cluster_index(scenes.location, scenes.scene_id)
    draws, vehicles = bootstrap_draws(clusters), few[:, 3:4].expand(-1, 3)
    of_few, of_many = (resampled_means(sums[:, :3], vehicles, cluster, draws) for sums in (few, many))
    for means in (of_few, of_many):
        means[:, 2] = means[:, 2].sqrt()
    places, names = len(cluster[few[:, 3] > 0].unique()), [metric.name for metric in STAGES[SPREAD_STAGE]]
    covered = resampled_means(few[:, 4:6], few[:, 6:].expand(-1, 2), cluster, draws)
    columns = torch.cat([of_few, of_few / of_many, covered], 1)
    counts = [*[int(few[:, 3].sum())] * 6, *[int(few[:, 6].sum())] * 2]
    return {name: interval(columns[:, k], places) | {"n": counts[k]} for k, name in enumerate(names)}
