"""Means and 95% intervals over rollouts (docs/reference/metrics.md).

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
from dataclasses import dataclass
from typing import Any

import torch
from scipy.special import betaincinv
from torch import Tensor

from e2rl.metrics.catalogue import METRICS, Metric
from e2rl.metrics.errored import raised
from e2rl.metrics.realism import Samples, realism

DRAWS = 1000
REALISM_DRAWS = 400  # each costs a pass over all samples
SAME = 1e-9  # of the values of draws that agree, but for rounding
LEVEL = 0.95
LEVELS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
LEAST = 10  # places
Row = Mapping[str, Any]
Bounds = tuple[float, float]
UNKNOWN = (math.nan, math.nan)


def cluster_index(
    locations: Iterable[str], scenes: Iterable[str]
) -> tuple[Tensor, int]:
    """(cluster [R] int64, number of clusters) by location; where there is none by log,
    of which a scene may be one of several windows, LOG@START."""
    names = [
        f"location {place}" if place else f"log {scene.split('@')[0]}"
        for place, scene in zip(
            locations,
            scenes,
            strict=True,
        )
    ]
    number = {name: index for index, name in enumerate(sorted(set(names)))}
    clusters = torch.tensor([number[name] for name in names], dtype=torch.int64)
    return clusters, len(number)


def bootstrap_draws(clusters: int, draws: int = DRAWS, seed: int = 0) -> Tensor:
    """Multiplicities [1 + draws, clusters] float64 of clusters drawn with replacement;
    row 0 counts each once."""
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(max(clusters, 1), (draws, clusters), generator=generator)
    counts = torch.ones(1 + draws, clusters, dtype=torch.float64)
    counts[1:] = 0.0
    counts[1:].scatter_add_(1, chosen, torch.ones_like(counts[1:]))
    return counts


def resampled_means(
    totals: Tensor,
    weights: Tensor,
    *,
    cluster: Tensor,
    draws: Tensor,
) -> Tensor:
    """Quotients [D, M] of the sums of totals and weights in each draw.

    Args:
        totals, weights: [R, M] of rollouts; one is left out where either is NaN.
        cluster: [R] int64, of the rollouts.
        draws: [D, C], multiplicities of the clusters.
    """
    unknown = totals.isnan() | weights.isnan()

    def summed(values: Tensor) -> Tensor:
        sums = totals.new_zeros(draws.shape[1], totals.shape[1])
        return draws @ sums.index_add(0, cluster, values.masked_fill(unknown, 0.0))

    return summed(totals) / summed(weights)  # 0 / 0 is NaN


def resampled_medians(values: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """Median [D], per draw [D, C], of values [R] of rollouts in cluster [R], each as
    often as the draw has its cluster.

    NaN values are left out; a draw without any value is NaN.
    """
    finite = ~values.isnan()
    values, order = values[finite].sort()
    if not len(values):
        return draws.new_full((len(draws),), torch.nan)
    reached = draws[:, cluster[finite][order]].cumsum(1)
    half = reached[:, -1:] / 2
    low = values[(reached >= half).long().argmax(1)]
    high = values[(reached > half).long().argmax(1)]
    return ((low + high) / 2).where(half[:, 0] > 0, torch.nan)


def resampled_labels(
    labels: Tensor,
    cluster: Tensor,
    *,
    draws: Tensor,
    places: int,
) -> Tensor:
    """Expected number [D] of different labels of one rollout at each of several
    different clusters of a draw, picked at random.

    Neither many rollouts nor many at one place raise it. It is exact: the clusters
    picked miss a label with the ratio of two elementary symmetric polynomials.

    Args:
        labels: [R] of rollouts, NaN: none.
        cluster: [R] int64.
        draws: [D, C]; NaN where a draw has fewer than `places` clusters.
        places: how many clusters are picked.
    """
    labelled = ~labels.isnan()
    values, index = labels[labelled].unique(return_inverse=True)
    counts = draws.new_zeros(draws.shape[1], len(values))
    counts.index_put_(
        (cluster[labelled], index),
        draws.new_ones(len(index)),
        accumulate=True,
    )
    total = counts.sum(1, keepdim=True)
    times = draws * (total[:, 0] > 0)
    missed = 1 - counts / total.clamp(min=1)
    factors = torch.cat([missed, torch.ones_like(total)], 1)  # the last: of all picks
    polynomial = draws.new_zeros(places + 1, len(draws), factors.shape[1])
    polynomial[0] = 1
    for place in total[:, 0].nonzero()[:, 0].tolist():
        polynomial[1:] += (times[:, place, None] * factors[place]) * polynomial[:-1]
    missing, picks = polynomial[-1, :, :-1], polynomial[-1, :, -1:]
    return (1 - missing / picks).sum(-1).where(picks[:, 0] > 0, torch.nan)


def interval(values: Tensor, places: int) -> dict[str, float]:
    """{mean, low, high} of values [D], row 0 the estimate; no interval (NaN) from fewer
    than LEAST places that know it, or where all draws agree."""
    values = values.where(values.isfinite(), torch.nan)
    low, high = UNKNOWN
    if places >= LEAST and len(values) > 1:
        low, high = values[1:].nanquantile(values.new_tensor(LEVELS)).tolist()
        low, high = UNKNOWN if low == high else (low, high)
    return {"mean": values[0].item(), "low": low, "high": high}


def exact_interval(fraction: float, places: float, level: float = LEVEL) -> Bounds:
    """Bounds of Clopper and Pearson for a fraction in [0, 1] of so many independent
    places, a whole number or not."""
    events = fraction * places
    others = places - events
    tail = (1 - level) / 2
    low = float(betaincinv(events, others + 1, tail)) if events > 0 else 0.0
    high = float(betaincinv(events + 1, others, 1 - tail)) if others > 0 else 1.0
    return low, high


def bounds_of_alike(fraction: float, places: int, least: float = 0.0) -> Bounds:
    """Bounds of a fraction, or of a difference of two, that is the same at each of so
    many places: the others, of which there are as many as the exact interval of none
    allows, may have the least, or 1."""
    others = exact_interval(0.0, places)[1]
    return fraction + others * (least - fraction), fraction + others * (1 - fraction)


def row_metrics() -> list[Metric]:
    """The metrics that are averaged over rows, not computed from pooled samples."""
    return [metric for metric in METRICS.values() if not metric.samples]


@dataclass
class MetricTable:
    """Totals and weights [R, M] float64 of M metrics of rows, whose sums'
    quotient is the mean; NaN where unknown."""

    totals: Tensor
    weights: Tensor

    @classmethod
    def of(cls, rows: Sequence[Row], metrics: Sequence[Metric]) -> "MetricTable":
        """The total of a metric is its value times its weight; of a metric `per`
        another column, just its value.

        Where the planner raised, a metric has the value that it declares for that. A
        metric `per` another column knows none: what a rollout would have driven is
        unknown, and a failure over no distance is no rate.
        """
        errored = torch.tensor([raised(row) for row in rows], dtype=torch.bool)

        def column(name: str) -> Tensor:
            values = [float(row.get(name, torch.nan)) for row in rows]
            return torch.tensor(values, dtype=torch.float64)

        totals = []
        weights = []
        for metric in metrics:
            value = column(metric.source)
            divisor = metric.per or metric.weight
            weight = column(divisor) if divisor else torch.ones_like(value)
            if not (metric.per or math.isnan(metric.raised)):
                value = value.masked_fill(errored, metric.raised)
                weight = weight.masked_fill(errored, 1.0)
            totals.append(value if metric.per else value * weight)
            weights.append(weight)
        return cls(torch.stack(totals, 1), torch.stack(weights, 1))


class Bootstrap:
    """The resampling of rollouts that a group, or two groups that are compared, share."""

    def __init__(self, rows: Sequence[Row], draws: int, realism_draws: int) -> None:
        self.place, places = cluster_index(
            [row["location"] for row in rows], [row["scene_id"] for row in rows]
        )
        training = torch.tensor(
            [row.get("training", 0) for row in rows], dtype=torch.int64
        )
        trainings = int(training.amax()) + 1 if len(rows) else 1
        self.cluster = self.place * trainings + training

        def crossed(draws: int) -> Tensor:
            """[D, C * K]: places and trainings are drawn independently."""
            of_places = bootstrap_draws(places, draws)[:, :, None]
            of_trainings = bootstrap_draws(trainings, draws, seed=1)[:, None]
            return (of_places * of_trainings).flatten(1)

        self.place_draws = bootstrap_draws(places, draws)
        self.draws = crossed(draws)
        self.realism_draws = crossed(realism_draws)

    def resampled(
        self,
        table: MetricTable,
        samples: Sequence[Samples],
    ) -> dict[str, Tensor]:
        """{metric: values [D] in each draw}."""
        means = resampled_means(
            table.totals,
            table.weights,
            cluster=self.cluster,
            draws=self.draws,
        )
        values = {}
        for column, metric in enumerate(row_metrics()):
            total = table.totals[:, column]
            values[metric.name] = means[:, column]
            if metric.median:
                values[metric.name] = resampled_medians(
                    total,
                    self.cluster,
                    draws=self.draws,
                )
            if metric.places:
                values[metric.name] = resampled_labels(
                    total / table.weights[:, column],  # 0 / 0 is NaN
                    self.place,
                    draws=self.place_draws,
                    places=metric.places,
                )
        return values | realism(
            list(samples),
            self.cluster,
            draws=self.realism_draws,
        )

    def places(self, chosen: Tensor) -> int:
        """Number of places of the rollouts chosen [R] bool."""
        return len(self.place[chosen].unique())

    def is_rare(self, metric: Metric, total: Tensor, weight: Tensor) -> bool:
        """Whether the bootstrap of a fraction, or of a ratio, has too few places with,
        or without, an event; total, weight [R]."""
        if bool(metric.per) == metric.fraction:
            return False
        sides = [total > 0] if metric.per else [total > 0, total < weight]
        return min(self.places((weight > 0) & side) for side in sides) < LEAST

    def exact(
        self,
        metric: Metric,
        table: MetricTable,
        *,
        mean: float,
        level: float,
    ) -> Bounds:
        """Exact bounds of a metric whose estimate is `mean`; NaN from too few places,
        and for what is no fraction of places."""
        column = row_metrics().index(metric)
        counted = ~table.totals[:, column].isnan() & (table.weights[:, column] > 0)
        places = self.places(counted)
        if places < LEAST or metric.per:
            return UNKNOWN
        return exact_interval(mean, places, level)

    def agreed(
        self,
        metric: Metric,
        values: Tensor,
        *,
        known: Tensor,
        least: float,
    ) -> Bounds | None:
        """Bounds of a mean of which all draws agree, LEAST places or more (see
        `bounds_of_alike`); None of others.

        Args:
            metric: which one.
            values: [D], row 0 the estimate.
            known: [R] bool, the rollouts that a value uses.
            least: the least that a fraction can be: 0, of a difference -1.
        """
        mean = values[0].item()
        places = self.places(known)
        drawn = values[1:][values[1:].isfinite()]
        if metric.median or metric.places or metric.per or metric.per_collision:
            return None
        if places < LEAST or not len(drawn):
            return None
        if ((drawn - mean).abs() > SAME * max(1, abs(mean))).any():
            return None
        return bounds_of_alike(mean, places, least) if metric.fraction else (mean, mean)

    def intervals(
        self,
        values: Mapping[str, Tensor],
        known: Mapping[str, Tensor],
    ) -> dict[str, dict[str, float]]:
        """{metric: {mean, low, high, n}} in the catalogue's order; known [R] bool: the
        n rollouts that a value uses."""
        result = {}
        for name in METRICS:
            count = 0 if values[name][0].isnan() else int(known[name].sum())
            places = self.places(known[name])
            result[name] = interval(values[name], places) | {"n": count}
        return result


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
    *,
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}} of one group of rollouts (one method, ego and
    eta), in the catalogue's order.

    n is the number of rollouts that the value rests on; what cannot be computed is NaN
    with n = 0.

    Args:
        rows: of `score_rollouts`.
        samples: of `score_rollouts`, one entry per row.
        draws: of the bootstrap.
        realism_draws: of the bootstrap of realism.

    Raises:
        ValueError: there is not one entry of samples per row.
    """
    if len(rows) != len(samples):
        raise ValueError(
            f"{len(rows)} rows but {len(samples)} samples; score_rollouts makes both"
        )
    bootstrap = Bootstrap(rows, draws, realism_draws)
    table = MetricTable.of(rows, row_metrics())
    counted = known_rollouts(~table.totals.isnan() & (table.weights > 0), samples)
    values = bootstrap.resampled(table, samples)
    result = bootstrap.intervals(values, counted)
    for column, metric in enumerate(row_metrics()):
        name = metric.name
        bounds = bootstrap.agreed(
            metric,
            values[name],
            known=counted[name],
            least=0.0,
        )
        if bounds is None and bootstrap.is_rare(
            metric,
            table.totals[:, column],
            table.weights[:, column],
        ):
            mean = values[name][0].item()
            bounds = bootstrap.exact(metric, table, mean=mean, level=LEVEL)
        if bounds is not None:
            result[name]["low"], result[name]["high"] = bounds
    return result


def paired_differences(
    rows: Sequence[Row],
    samples: Sequence[Samples],
    other_rows: Sequence[Row],
    other_samples: Sequence[Samples],
    *,
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
) -> dict[str, dict[str, float]]:
    """{metric: {difference, low, high, n}} of this group minus the other, over the n
    (scene, seed) both have.

    Both groups are resampled with the same clusters. A metric per collision compares
    the two groups' own collisions on these pairs; all other metrics use only the pairs
    in which both groups know it.

    Args:
        rows, samples: of this group, as in `summarise`.
        other_rows, other_samples: of the other.
        draws: of the bootstrap.
        realism_draws: of the bootstrap of realism.
    """
    pairs = matched(rows, other_rows)
    rows = [rows[index] for index, _ in pairs]
    samples = [samples[index] for index, _ in pairs]
    other_rows = [other_rows[index] for _, index in pairs]
    other_samples = [other_samples[index] for _, index in pairs]
    table = MetricTable.of(rows, row_metrics())
    other_table = MetricTable.of(other_rows, row_metrics())
    per_collision = torch.tensor([metric.per_collision for metric in row_metrics()])
    unmatched = table.totals.isnan() | other_table.totals.isnan()
    unmatched = unmatched & ~per_collision
    table.totals = table.totals.masked_fill(unmatched, torch.nan)
    other_table.totals = other_table.totals.masked_fill(unmatched, torch.nan)
    # either may tell the training
    shared = [{**other, **row} for row, other in zip(rows, other_rows, strict=True)]
    bootstrap = Bootstrap(shared, draws, realism_draws)
    values = bootstrap.resampled(table, samples)
    others = bootstrap.resampled(other_table, other_samples)
    known_rows = ~table.totals.isnan() | ~other_table.totals.isnan()
    counted = known_rollouts(known_rows, samples)
    other_known = known_rollouts(known_rows, other_samples)
    differences = {name: values[name] - others[name] for name in METRICS}
    both = {name: counted[name] & other_known[name] for name in METRICS}
    result = bootstrap.intervals(differences, both)
    for column, metric in enumerate(row_metrics()):
        name = metric.name
        bounds = bootstrap.agreed(
            metric,
            differences[name],
            known=both[name],
            least=-1.0,
        )
        if bounds is None and any(
            bootstrap.is_rare(metric, each.totals[:, column], each.weights[:, column])
            for each in (table, other_table)
        ):
            (low, high), (other_low, other_high) = (
                bootstrap.exact(
                    metric,
                    group,
                    mean=drawn[name][0].item(),
                    level=(1 + LEVEL) / 2,
                )
                for group, drawn in ((table, values), (other_table, others))
            )
            bounds = low - other_high, high - other_low
        if bounds is not None:
            result[name]["low"], result[name]["high"] = bounds
    return {
        name: {"difference": value.pop("mean"), **value}
        for name, value in result.items()
    }


def matched(rows: Sequence[Row], other_rows: Sequence[Row]) -> list[tuple[int, int]]:
    """Positions (in rows, in other_rows) of rows of the same scene, seed and, where
    both groups tell it, training."""
    index: dict[tuple, list[int]] = {}
    for position, row in enumerate(other_rows):
        index.setdefault((row["scene_id"], row["seed"]), []).append(position)
    pairs = []
    for position, row in enumerate(rows):
        for other in index.get((row["scene_id"], row["seed"]), []):
            trainings = {row.get("training"), other_rows[other].get("training")}
            if len(trainings - {None}) < 2:
                pairs.append((position, other))
    return pairs
