"""The table of spreads: how far the prior's samples lie apart, beside samples of
MANY_STEPS steps of the reverse SDE, and how often the recording lies among them."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from e2rl.driving.setup import Method
from e2rl.evaluation.summary import metric_row
from e2rl.metrics.catalogue import SPREAD_STAGE, STAGES, Metric
from e2rl.metrics.statistics import (
    bootstrap_draws,
    cluster_index,
    interval,
    resampled_means,
)
from e2rl.prior.prior import Prior
from e2rl.prior.spread import sample_variances
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.scenes.scene import SceneSet
from e2rl.traffic.nominal import NominalTraffic

EGO = "unknown"  # `ego` column of the rows: no sample knows the ego's plan
BATCH = 32  # scenes sampled at once
MANY_STEPS = 200  # of the reverse SDE: they stand for the trained distribution
SPREADS = ("knot_variance", "lateral_variance", "travel_std")
COVERAGES = ("covered_50", "covered_90")
STAGES[SPREAD_STAGE] = (
    Metric("knot_variance", "variance over samples of an acceleration knot"),
    Metric("lateral_variance", "variance over samples of a lateral knot"),
    Metric(
        "travel_std", "standard deviation over samples of the way after 5 s", unit="m"
    ),
    *(
        Metric(f"{name}_ratio", f"{name} over that of {MANY_STEPS} steps")
        for name in SPREADS
    ),
    *(
        Metric(
            name,
            f"recorded ways after 5 s in the central {share} of the samples'",
            fraction=True,
        )
        for name, share in zip(COVERAGES, ("half", "nine tenths"), strict=True)
    ),
)


def spread_rows(
    scenes: SceneSet,
    methods: Sequence[Method],
    *,
    samples: int,
    device: str = "cpu",
    parts: Parts = NO_PARTS,
) -> list[dict]:
    """Rows of metrics.json, stage `spread`, of every method that is the prior alone.

    Args:
        scenes: whose start frames are sampled.
        methods: of the run; those with an attack or without a prior have no row.
        samples: of each scene.
        device: where the network runs.
        parts: the methods that are done.
    """
    rows = []
    for method in methods:
        traffic = method.traffic
        if not isinstance(traffic, NominalTraffic):
            continue
        if traffic.adversarial or method.eta > 0:
            continue
        reference = copy.copy(traffic.prior)
        reference.sampler = replace(traffic.prior.sampler, steps=MANY_STEPS)
        sums, reference_sums = (
            parts.result(
                f"spread-{method.name}-{prior.sampler.steps:03}",
                [method.name, samples, prior.sampler.steps],
                partial(_sums, prior, scenes, samples=samples, device=device),
            )
            for prior in (traffic.prior, reference)
        )
        row = metric_row(
            (scenes.dataset, scenes.split, method.name, EGO, method.eta),
            scenes=len(scenes),
            seeds=samples,
            rollouts=len(scenes) * samples,
            metrics=_metrics(sums, reference_sums, scenes=scenes),
            stage=SPREAD_STAGE,
        )
        rows.append(row)
    return rows


def _sums(prior: Prior, scenes: SceneSet, samples: int, device: str) -> Tensor:
    """Sums [R, 7] of each scene, in the order of `sample_variances`."""
    sums = []
    for rows in torch.arange(len(scenes)).split(BATCH):
        scene = scenes.batch(rows).to(device)
        columns = sample_variances(prior, scene, samples=samples)
        sums.append(torch.stack(list(columns.values()), -1).cpu())
    return torch.cat(sums)


def _metrics(
    sums: Tensor, reference_sums: Tensor, scenes: SceneSet
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}, intervals over places; n counts vehicles."""
    cluster, clusters = cluster_index(scenes.location, scenes.scene_id)
    draws = bootstrap_draws(clusters)
    vehicles = sums[:, 3:4]
    recorded = sums[:, 6:]

    def means(columns: Tensor, weights: Tensor) -> Tensor:
        weights = weights.expand_as(columns)
        return resampled_means(columns, weights, cluster=cluster, draws=draws)

    spread = means(sums[:, :3], vehicles)
    reference = means(reference_sums[:, :3], vehicles)
    spread[:, 2] = spread[:, 2].sqrt()  # of the travelled distance: std, not variance
    reference[:, 2] = reference[:, 2].sqrt()
    covered = means(sums[:, 4:6], recorded)
    places = len(cluster[vehicles[:, 0] > 0].unique())
    columns = torch.cat([spread, spread / reference, covered], 1)
    counts = [int(vehicles.sum())] * 6 + [int(recorded.sum())] * 2
    return {
        metric.name: interval(column, places) | {"n": count}
        for metric, column, count in zip(
            STAGES[SPREAD_STAGE], columns.unbind(1), counts, strict=True
        )
    }
