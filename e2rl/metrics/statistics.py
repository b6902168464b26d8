"""Means and 95% intervals over rollouts, bootstrapped by cluster: whole locations (or scenes) are drawn, not rollouts.

Rows are the dicts of `metrics.score.score_rollouts`, features those of `metrics.realism.traffic_features`, one of each
per rollout. Every resampled mean is a quotient of two sums that are linear in the clusters' multiplicities, hence one
matrix product serves all draws and metrics. Fewer than two clusters with known values give no interval: NaN.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.metrics.catalogue import METRICS, Metric
from e2rl.metrics.realism import realism

DRAWS = 1000
REALISM_DRAWS = 400  # each costs a pass over all samples
LEVELS = (0.025, 0.975)
PER_COLLISION = frozenset({"avoidable", "avoidable_1s", "evasion_accel", "rir", "at_fault", "relvel", "contact_time"})
Row = dict[str, object]
Features = dict[str, Tensor]


def cluster_index(rows: Sequence[Row]) -> tuple[Tensor, int]:
    """(cluster [R] int64, number of clusters) of rows: by location, by scene where there is none."""
    names = [f"location {row['location']}" if row["location"] else f"scene {row['scene_id']}" for row in rows]
    number = {name: index for index, name in enumerate(sorted(set(names)))}
    return torch.tensor([number[name] for name in names], dtype=torch.int64), len(number)


def bootstrap_draws(clusters: int, draws: int = DRAWS, seed: int = 0) -> Tensor:
    """Multiplicities [1 + draws, clusters] float64 of clusters drawn with replacement; row 0 counts each once."""
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(max(clusters, 1), (draws, clusters), generator=generator)
    counts = torch.zeros(draws, clusters, dtype=torch.float64)
    counts.scatter_add_(1, chosen, torch.ones_like(chosen, dtype=torch.float64))
    return torch.cat([torch.ones(1, clusters, dtype=torch.float64), counts])


def resampled_means(totals: Tensor, weights: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """Quotients [D, M] per draw [D, C] of the sums of totals, weights [R, M] of rollouts in cluster [R]; where either
    is NaN the rollout is left out."""
    unknown = totals.isnan() | weights.isnan()
    shape = (draws.shape[1], totals.shape[1])
    total = totals.new_zeros(shape).index_add(0, cluster, totals.masked_fill(unknown, 0.0))
    count = totals.new_zeros(shape).index_add(0, cluster, weights.masked_fill(unknown, 0.0))
    return (draws @ total) / (draws @ count)  # 0 / 0 is NaN


def resampled_medians(values: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """Median [D] of values [R] of rollouts in cluster [R], each as often as a draw [D, C] has its cluster; NaN ones are
    left out, and a draw without any is NaN."""
    known = ~values.isnan()
    values, order = values[known].sort()
    if not len(values):
        return draws.new_full((len(draws),), torch.nan)
    reached = draws[:, cluster[known][order]].cumsum(1)
    half = reached[:, -1:] / 2
    low, high = ((passed.long().argmax(1)) for passed in (reached >= half, reached > half))
    return ((values[low] + values[high]) / 2).where(half[:, 0] > 0, torch.nan)


def resampled(totals: Tensor, weights: Tensor, cluster: Tensor, draws: Tensor, metrics: Sequence[Metric]) -> Tensor:
    """The metrics [D, M] of each draw, from `metric_table`'s values and weights: quotients of sums, or medians."""
    table = resampled_means(totals, weights, cluster, draws)
    for column, metric in enumerate(metrics):
        if metric.median:
            table[:, column] = resampled_medians(totals[:, column], cluster, draws)
    return table


def interval(samples: Tensor, known_clusters: int) -> dict[str, float]:
    """{mean, low, high} of samples [D], row 0 the estimate; the interval needs two clusters that know the value."""
    samples = samples.where(samples.isfinite(), torch.nan)
    low, high = samples[1:].nanquantile(samples.new_tensor(LEVELS)).tolist() if known_clusters > 1 else (torch.nan,) * 2
    return {"mean": samples[0].item(), "low": low, "high": high}


def metric_table(rows: Sequence[Row], metrics: Sequence[Metric]) -> tuple[Tensor, Tensor]:
    """Weighted values and weights [R, M] float64 of the rows' metrics; NaN where a row lacks one. A metric `per`
    another column is not weighted: it is summed and divided by the sum of that column."""

    def table(names: list[str], absent: float) -> Tensor:
        cells = [[float(row.get(name, torch.nan)) if name else absent for name in names] for row in rows]
        return torch.tensor(cells, dtype=torch.float64).reshape(len(rows), len(names))

    values = table([metric.source for metric in metrics], torch.nan)
    weights = table([metric.weight for metric in metrics], 1.0)
    per = table([metric.per for metric in metrics], torch.nan)
    quotient = torch.tensor([bool(metric.per) for metric in metrics])
    return torch.where(quotient, values, values * weights), torch.where(quotient, per, weights)


def summarise(
    rows: Sequence[Row], features: Sequence[Features], draws: int = DRAWS, realism_draws: int = REALISM_DRAWS
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}} of one group of rollouts (one method, ego and eta), in the catalogue's order.

    n is the number of rollouts that the value rests on; what cannot be computed is NaN with n = 0.
    """
    if len(rows) != len(features):
        raise ValueError(f"{len(rows)} rows but {len(features)} features; they are made together by score_rollouts")
    cluster, clusters = cluster_index(rows)
    single = [metric for metric in METRICS.values() if not metric.pooled]
    totals, weights = metric_table(rows, single)
    means = resampled(totals, weights, cluster, bootstrap_draws(clusters, draws), single)
    known = ~totals.isnan() & (weights > 0)
    result = {
        metric.name: interval(means[:, column], len(cluster[known[:, column]].unique()))
        | {"n": int(known[:, column].sum())}
        for column, metric in enumerate(single)
    }
    pooled = realism(list(features), cluster, bootstrap_draws(clusters, realism_draws))
    for name, samples in pooled.items():
        used = has_samples(features, name)
        result[name] = interval(samples, len(cluster[used].unique())) | {"n": int(used.sum())}
    return {name: result[name] for name in METRICS}


def has_samples(features: Sequence[Features], name: str) -> Tensor:
    """Bool [R]: rollouts with anything that the pooled metric `name` counts."""
    key = "a_lon_adversary" if name == "real_adv" else "a_lon"
    return torch.tensor([bool(sample[key].numel()) for sample in features], dtype=torch.bool)


def paired_differences(
    rows: Sequence[Row],
    features: Sequence[Features],
    other_rows: Sequence[Row],
    other_features: Sequence[Features],
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
) -> dict[str, dict[str, float]]:
    """{metric: {difference, low, high, n}} of this group minus the other, over the n (scene, seed) both have.

    Both groups are resampled with the same clusters. Metrics per collision (rir, relvel, ...) and weighted ones compare
    the two groups' own quotients on these pairs; all other metrics use only the pairs in which both are known.
    """
    place = {(row["scene_id"], row["seed"]): index for index, row in enumerate(other_rows)}
    pairs = [(index, place[key]) for index, row in enumerate(rows) if (key := (row["scene_id"], row["seed"])) in place]
    ours, theirs = [rows[a] for a, _ in pairs], [other_rows[b] for _, b in pairs]
    cluster, clusters = cluster_index(ours)
    single = [metric for metric in METRICS.values() if not metric.pooled]
    (first, first_weight), (second, second_weight) = metric_table(ours, single), metric_table(theirs, single)
    matched = first.isnan() | second.isnan()
    strict = torch.tensor([metric.name not in PER_COLLISION for metric in single]) & matched
    first, second = first.masked_fill(strict, torch.nan), second.masked_fill(strict, torch.nan)
    multiplicities = bootstrap_draws(clusters, draws)
    means = resampled(first, first_weight, cluster, multiplicities, single)
    means = means - resampled(second, second_weight, cluster, multiplicities, single)
    result = {}
    for column, metric in enumerate(single):
        known = ~first[:, column].isnan() | ~second[:, column].isnan()
        result[metric.name] = interval(means[:, column], len(cluster[known].unique())) | {"n": int(known.sum())}
    multiplicities = bootstrap_draws(clusters, realism_draws)
    samples = [
        realism([group[pair[side]] for pair in pairs], cluster, multiplicities)
        for side, group in enumerate((features, other_features))
    ]
    for name in samples[0]:
        used = [
            has_samples([group[pair[side]] for pair in pairs], name)
            for side, group in enumerate((features, other_features))
        ]
        used = used[0] & used[1]
        change = samples[0][name] - samples[1][name]
        result[name] = interval(change, len(cluster[used].unique())) | {"n": int(used.sum())}
    return {name: {"difference": result[name].pop("mean"), **result[name]} for name in METRICS}
