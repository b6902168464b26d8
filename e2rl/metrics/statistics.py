"""Means and 95% intervals over rollouts (docs/method.md, section 10).

The interval is a cluster bootstrap: whole locations (or logs) are drawn, not rollouts.
A draw holds each cluster with a multiplicity. Every resampled mean is a quotient of two
sums that are linear in the multiplicities, hence one matrix product serves all draws
and metrics. Where the bootstrap would mislead:

- fewer than LEAST places that know a metric give no interval;
- a fraction with fewer than LEAST places at which the event occurs, or at which it does
  not, has the exact interval of Clopper and Pearson (1934), with the places as the
  sample. A difference of such fractions lies between the differences of their exact
  bounds at 97.5% each (Bonferroni);
- a ratio per kilometre with fewer than LEAST places at which the event occurs gives
  none;
- where all draws of a mean agree, all places do. Of a fraction the exact interval
  bounds those that are otherwise, at which it, or its difference, may be the least or
  the most that it can be; another mean is its own interval. Medians, ratios and
  realism, of which draws may agree where places do not, then have none.

Rows of several trainings of one policy say which in `training` (0, 1, ..). Trainings
are then drawn with replacement as well as places, independently of them: a rollout
counts as often as its place times its training was drawn (the pigeonhole bootstrap,
Owen 2007). Few trainings still understate how much they vary.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from scipy.special import betaincinv
from torch import Tensor

from e2rl.metrics.catalogue import METRICS, Metric
from e2rl.metrics.errored import raised
from e2rl.metrics.realism import Samples, realism

DRAWS = 1000
SAME = 1e-9  # of the values of draws that agree, but for rounding
REALISM_DRAWS = 400  # each costs a pass over all samples
LEVEL = 0.95
LEVELS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
Z = 1.959964  # standard deviations to either side that hold LEVEL of a normal law
LEAST = 10  # places
Row = Mapping[str, Any]


def cluster_index(
    locations: Iterable[str], scenes: Iterable[str]
) -> tuple[Tensor, int]:
    """(cluster [R] int64, number of clusters) by location; where there is none by log,
    of which a scene may be one of several windows, LOG@START."""
    places = zip(locations, scenes, strict=True)
    names = [
        f"location {place}" if place else f"log {scene.split('@')[0]}"
        for place, scene in places
    ]
    number = {name: index for index, name in enumerate(sorted(set(names)))}
    return torch.tensor([number[name] for name in names], dtype=torch.int64), len(
        number
    )


def bootstrap_draws(clusters: int, draws: int = DRAWS, seed: int = 0) -> Tensor:
    """Multiplicities [1 + draws, clusters] float64 of clusters drawn with replacement;
    row 0 counts each once."""
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(max(clusters, 1), (draws, clusters), generator=generator)
    counts = torch.zeros(draws, clusters, dtype=torch.float64)
    counts.scatter_add_(1, chosen, torch.ones_like(chosen, dtype=torch.float64))
    return torch.cat([torch.ones(1, clusters, dtype=torch.float64), counts])


def crossed(draws: Tensor, other: Tensor) -> Tensor:
    """Multiplicities [D, C * K] of the pairs of C and K clusters that are drawn
    independently; pair c * K + k."""
    return (draws[:, :, None] * other[:, None, :]).flatten(1)


def resampled_means(
    totals: Tensor, weights: Tensor, cluster: Tensor, draws: Tensor
) -> Tensor:
    """Quotients [D, M], per draw [D, C], of the sums of totals and weights [R, M] of
    rollouts in cluster [R].

    A rollout is left out where either is NaN.
    """
    unknown = totals.isnan() | weights.isnan()
    shape = (draws.shape[1], totals.shape[1])
    total = totals.new_zeros(shape).index_add(
        0, cluster, totals.masked_fill(unknown, 0.0)
    )
    count = totals.new_zeros(shape).index_add(
        0, cluster, weights.masked_fill(unknown, 0.0)
    )
    return (draws @ total) / (draws @ count)  # 0 / 0 is NaN


def resampled_medians(values: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """Median [D], per draw [D, C], of values [R] of rollouts in cluster [R], each as
    often as the draw has its cluster.

    NaN values are left out; a draw without any value is NaN.
    """
    known = ~values.isnan()
    values, order = values[known].sort()
    if not len(values):
        return draws.new_full((len(draws),), torch.nan)
    reached = draws[:, cluster[known][order]].cumsum(1)
    half = reached[:, -1:] / 2
    low, high = (
        (passed.long().argmax(1)) for passed in (reached >= half, reached > half)
    )
    return ((values[low] + values[high]) / 2).where(half[:, 0] > 0, torch.nan)


def resampled_labels(
    labels: Tensor, cluster: Tensor, draws: Tensor, places: int
) -> Tensor:
    """Expected number [D], per draw [D, C], of different labels [R] (NaN: none) of one
    rollout at each of `places` different clusters of the draw, picked at random.

    Neither many rollouts nor many at one place raise it. It is exact: the clusters
    picked miss a label with the ratio of two elementary symmetric polynomials. NaN
    where a draw has fewer clusters.
    """
    known = ~labels.isnan()
    values, index = labels[known].unique(return_inverse=True)
    counts = draws.new_zeros(draws.shape[1], len(values))
    counts.index_put_(
        (cluster[known], index), draws.new_ones(len(index)), accumulate=True
    )
    total = counts.sum(1, keepdim=True)
    times = draws * (total[:, 0] > 0)
    missed = 1 - counts / total.clamp(min=1)
    parts = torch.cat(
        [missed, torch.ones_like(total)], 1
    )  # the last column: of all picks
    polynomial = draws.new_zeros(places + 1, len(draws), parts.shape[1])
    polynomial[0] = 1
    for one in total[:, 0].nonzero()[:, 0].tolist():
        polynomial[1:] += (times[:, one, None] * parts[one]) * polynomial[:-1]
    return (
        (1 - polynomial[-1, :, :-1] / polynomial[-1, :, -1:])
        .sum(-1)
        .where(polynomial[-1, :, -1] > 0, torch.nan)
    )


def interval(values: Tensor, places: int) -> dict[str, float]:
    """{mean, low, high} of values [D], row 0 the estimate; no interval (NaN) from fewer
    than LEAST places that know it, or where all draws agree."""
    values = values.where(values.isfinite(), torch.nan)
    low = high = torch.nan
    if places >= LEAST and len(values) > 1:
        low, high = values[1:].nanquantile(values.new_tensor(LEVELS)).tolist()
        low, high = (torch.nan, torch.nan) if low == high else (low, high)
    return {"mean": values[0].item(), "low": low, "high": high}


def jackknife(values: Tensor) -> dict[str, float]:
    """{mean, low, high} of a statistic, values [1 + P]: of all P places, then without
    each of them (Efron 1982). No interval (NaN) from fewer than LEAST places, or where
    one of the values is not finite."""
    others = values[1:]
    count = len(values) - 1
    spread = (
        ((count - 1) / max(count, 1) * (others - others.mean()).square().sum())
        .sqrt()
        .item()
    )
    half = (
        Z * spread
        if count >= LEAST and values.isfinite().all() and spread > 0
        else float("nan")
    )
    mean = values[0].item() if values[0].isfinite() else float("nan")
    return {"mean": mean, "low": mean - half, "high": mean + half}


def exact_interval(
    fraction: float, places: float, level: float = LEVEL
) -> tuple[float, float]:
    """Bounds of Clopper and Pearson for a fraction in [0, 1] of so many independent
    places, a whole number or not."""
    events = fraction * places
    tail = (1 - level) / 2
    low = float(betaincinv(events, places - events + 1, tail)) if events > 0 else 0.0
    high = (
        float(betaincinv(events + 1, places - events, 1 - tail))
        if events < places
        else 1.0
    )
    return low, high


def bounds_of_alike(
    fraction: float, places: int, least: float = 0.0
) -> tuple[float, float]:
    """Bounds of a fraction, or of a difference of two, that is the same at each of so
    many places: the others, of which there are as many as the exact interval of none
    allows, may have the least, or 1."""
    others = exact_interval(0.0, places)[1]
    return fraction + others * (least - fraction), fraction + others * (1 - fraction)


def row_metrics() -> list[Metric]:
    """The metrics that are averaged over rows, not computed from pooled samples."""
    return [metric for metric in METRICS.values() if not metric.samples]


def metric_table(
    rows: Sequence[Row], metrics: Sequence[Metric]
) -> tuple[Tensor, Tensor]:
    """Totals and weights [R, M] float64 of the rows' metrics, whose sums' quotient is
    the mean; NaN where unknown.

    The total of a metric is its value times its weight; of a metric `per` another
    column, just its value. Where the planner raised, a metric has the value that it
    declares for that. A metric `per` another column knows none: what a rollout would
    have driven is unknown, and a failure over no distance is no rate.
    """
    errored = torch.tensor([raised(row) for row in rows], dtype=torch.bool)

    def column(name: str) -> Tensor:
        return torch.tensor(
            [float(row.get(name, torch.nan)) for row in rows], dtype=torch.float64
        )

    totals = []
    weights = []
    for metric in metrics:
        value = column(metric.source)
        divisor = metric.per or metric.weight
        weight = column(divisor) if divisor else torch.ones_like(value)
        if not (metric.per or math.isnan(metric.raised)):
            value = value.masked_fill(errored, metric.raised)
            weight = weight.masked_fill(errored, 1.0)
        weights.append(weight)
        totals.append(value if metric.per else value * weights[-1])
    return torch.stack(totals, 1), torch.stack(weights, 1)


class Bootstrap:
    """The resampling of rollouts that a group, or two groups that are compared, share."""

    def __init__(self, rows: Sequence[Row], draws: int, realism_draws: int) -> None:
        self.place, places = cluster_index(
            *([row[name] for row in rows] for name in ("location", "scene_id"))
        )
        training = torch.tensor(
            [row.get("training", 0) for row in rows], dtype=torch.int64
        )
        trainings = int(training.amax()) + 1 if len(rows) else 1
        self.cluster = self.place * trainings + training
        self.place_draws = bootstrap_draws(places, draws)
        self.draws = crossed(
            self.place_draws, bootstrap_draws(trainings, draws, seed=1)
        )
        other = bootstrap_draws(trainings, realism_draws, seed=1)
        self.realism_draws = crossed(bootstrap_draws(places, realism_draws), other)

    def resampled(
        self, totals: Tensor, weights: Tensor, samples: Sequence[Samples]
    ) -> dict[str, Tensor]:
        """{metric: values [D] in each draw}, from the results of `metric_table` and the
        realism samples."""
        means = resampled_means(totals, weights, cluster=self.cluster, draws=self.draws)
        for column, metric in enumerate(row_metrics()):
            if metric.median:
                means[:, column] = resampled_medians(
                    totals[:, column], self.cluster, draws=self.draws
                )
            if metric.places:
                labels = totals[:, column] / weights[:, column]  # 0 / 0 is NaN
                means[:, column] = resampled_labels(
                    labels, self.place, draws=self.place_draws, places=metric.places
                )
        values = {
            metric.name: means[:, column] for column, metric in enumerate(row_metrics())
        }
        return values | realism(list(samples), self.cluster, draws=self.realism_draws)

    def places(self, chosen: Tensor) -> int:
        """Number of places of the rollouts chosen [R] bool."""
        return len(self.place[chosen].unique())

    def rare(self, totals: Tensor, weights: Tensor) -> set[str]:
        """Names of the fractions and of the ratios for which the bootstrap has too few
        places with, or without, an event; from the results of `metric_table`."""
        found = set()
        for metric, total, weight in zip(
            row_metrics(), totals.T, weights.T, strict=True
        ):
            if bool(metric.per) == metric.fraction:
                continue
            sides = (total > 0,) if metric.per else (total > 0, total < weight)
            if min(self.places((weight > 0) & side) for side in sides) < LEAST:
                found.add(metric.name)
        return found

    def exact(
        self,
        names: set[str],
        totals: Tensor,
        weights: Tensor,
        values: Mapping[str, Tensor],
        level: float,
    ) -> dict[str, tuple[float, float]]:
        """Exact bounds of these metrics, whose estimates are row 0 of `values`; NaN
        from too few places, and for what is no fraction of places."""
        found = {}
        for metric, total, weight in zip(
            row_metrics(), totals.T, weights.T, strict=True
        ):
            if metric.name in names:
                places = self.places(~total.isnan() & (weight > 0))
                known = places >= LEAST and not metric.per
                mean = values[metric.name][0].item()
                found[metric.name] = (
                    exact_interval(mean, places, level=level)
                    if known
                    else (torch.nan, torch.nan)
                )
        return found

    def agreed(
        self, values: Mapping[str, Tensor], known: Mapping[str, Tensor], least: float
    ) -> dict[str, tuple[float, float]]:
        """Bounds of the means of which all draws agree, LEAST places or more: see
        `bounds_of_alike`.

        Args:
            values: [D] of each metric, row 0 the estimate.
            known: bool [R] of each metric, the rollouts that a value uses.
            least: the least that a fraction can be: 0, of a difference -1.
        """
        found = {}
        for metric in row_metrics():
            mean = values[metric.name][0].item()
            places = self.places(known[metric.name])
            drawn = values[metric.name][1:]
            drawn = drawn[drawn.isfinite()]
            plain = not (
                metric.median or metric.places or metric.per or metric.per_collision
            )
            if (
                plain
                and places >= LEAST
                and len(drawn)
                and bool(((drawn - mean).abs() <= SAME * max(1, abs(mean))).all())
            ):
                found[metric.name] = (
                    bounds_of_alike(mean, places, least=least)
                    if metric.fraction
                    else (mean, mean)
                )
        return found

    def intervals(
        self, values: Mapping[str, Tensor], known: Mapping[str, Tensor]
    ) -> dict[str, dict[str, float]]:
        """{metric: {mean, low, high, n}} in the catalogue's order; known [R] bool: the
        n rollouts that a value uses."""
        counts = {
            name: 0 if values[name][0].isnan() else int(known[name].sum())
            for name in METRICS
        }
        return {
            name: interval(values[name], self.places(known[name])) | {"n": counts[name]}
            for name in METRICS
        }


def known_rollouts(known: Tensor, samples: Sequence[Samples]) -> dict[str, Tensor]:
    """{metric: bool [R]}: rollouts that it uses, from known [R, M] of `row_metrics` and
    from the realism samples."""
    result = {
        metric.name: known[:, column] for column, metric in enumerate(row_metrics())
    }
    for metric in METRICS.values():
        if metric.samples:
            counts = [sample[metric.samples].numel() for sample in samples]
            result[metric.name] = torch.tensor(counts, dtype=torch.int64) > 0
    return result


def summarise(
    rows: Sequence[Row],
    samples: Sequence[Samples],
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}} of one group of rollouts (one method, ego and
    eta), in the catalogue's order.

    n is the number of rollouts that the value rests on; what cannot be computed is NaN
    with n = 0.

    Raises:
        ValueError: there is not one entry of samples per row.
    """
    if len(rows) != len(samples):
        raise ValueError(
            f"{len(rows)} rows but {len(samples)} samples; they are made together by score_rollouts"
        )
    bootstrap = Bootstrap(rows, draws, realism_draws=realism_draws)
    totals, weights = metric_table(rows, row_metrics())
    known = known_rollouts(~totals.isnan() & (weights > 0), samples)
    values = bootstrap.resampled(totals, weights, samples)
    result = bootstrap.intervals(values, known)
    for name, bounds in bootstrap.exact(
        bootstrap.rare(totals, weights), totals, weights, values, LEVEL
    ).items():
        result[name] |= dict(zip(("low", "high"), bounds, strict=True))
    for name, (low, high) in bootstrap.agreed(values, known, 0.0).items():
        result[name] |= {"low": low, "high": high}
    return result


def paired_differences(
    rows: Sequence[Row],
    samples: Sequence[Samples],
    other_rows: Sequence[Row],
    other_samples: Sequence[Samples],
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
    relative: bool = False,
) -> dict[str, dict[str, float]]:
    """{metric: {difference, low, high, n}} of this group minus the other, over the n
    (scene, seed) both have.

    Both groups are resampled with the same clusters. A metric per collision compares
    the two groups' own collisions on these pairs; all other metrics use only the pairs
    in which both groups know it.

    Args:
        relative: also give `relative`, `relative_low` and `relative_high`, the
            difference over the other's value.
    """
    pairs = matched(rows, other_rows)
    rows = [rows[own] for own, _ in pairs]
    samples = [samples[own] for own, _ in pairs]
    other_rows = [other_rows[other] for _, other in pairs]
    other_samples = [other_samples[other] for _, other in pairs]
    metrics = row_metrics()
    (first, first_weights), (second, second_weights) = (
        metric_table(rows, metrics),
        metric_table(other_rows, metrics),
    )
    unmatched = (first.isnan() | second.isnan()) & torch.tensor(
        [not metric.per_collision for metric in metrics]
    )
    first = first.masked_fill(unmatched, torch.nan)
    second = second.masked_fill(unmatched, torch.nan)
    shared = [
        {**other, **own} for own, other in zip(rows, other_rows, strict=True)
    ]  # either may tell the training
    bootstrap = Bootstrap(shared, draws, realism_draws=realism_draws)
    ours = bootstrap.resampled(first, first_weights, samples)
    theirs = bootstrap.resampled(second, second_weights, other_samples)
    known = known_rollouts(~first.isnan() | ~second.isnan(), samples)
    other_known = known_rollouts(~first.isnan() | ~second.isnan(), other_samples)
    differences = {name: ours[name] - theirs[name] for name in METRICS}
    both = {name: known[name] & other_known[name] for name in METRICS}
    result = bootstrap.intervals(differences, both)
    rare = bootstrap.rare(first, first_weights) | bootstrap.rare(second, second_weights)
    own = bootstrap.exact(rare, first, first_weights, ours, (1 + LEVEL) / 2)
    other = bootstrap.exact(rare, second, second_weights, theirs, (1 + LEVEL) / 2)
    for name in rare:
        result[name] |= {
            "low": own[name][0] - other[name][1],
            "high": own[name][1] - other[name][0],
        }
    for name, (low, high) in bootstrap.agreed(differences, both, -1.0).items():
        result[name] |= {"low": low, "high": high}
    found = {
        name: {"difference": value.pop("mean"), **value}
        for name, value in result.items()
    }
    if relative:
        for name, value in bootstrap.intervals(
            ratios(differences, theirs), both
        ).items():
            found[name] |= {
                "relative": value["mean"],
                "relative_low": value["low"],
                "relative_high": value["high"],
            }
    return found


def ratios(
    differences: Mapping[str, Tensor], others: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Differences [D] over |others| [D], by name. Where a draw has none, the ratio has
    no bound: no draw is known."""
    result = {}
    for name, difference in differences.items():
        ratio = difference / others[name].abs()
        unbounded = bool((others[name][1:] == 0).any())
        result[name] = torch.cat(
            [ratio[:1], ratio[1:].masked_fill(torch.tensor(unbounded), torch.nan)]
        )
    return result


def matched(rows: Sequence[Row], other_rows: Sequence[Row]) -> list[tuple[int, int]]:
    """Positions (own, other) of rows of the same scene, seed and, where both groups
    tell it, training."""
    index: dict[tuple, list[int]] = {}
    for other, row in enumerate(other_rows):
        index.setdefault((row["scene_id"], row["seed"]), []).append(other)
    pairs = [
        (own, other)
        for own, row in enumerate(rows)
        for other in index.get((row["scene_id"], row["seed"]), [])
    ]
    told = [
        (rows[own].get("training"), other_rows[other].get("training"))
        for own, other in pairs
    ]
    return [
        pair
        for pair, (own, other) in zip(pairs, told, strict=True)
        if own == other or None in (own, other)
    ]
