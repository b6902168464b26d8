"""What a metric is, and the list of all that are declared.

A metric is declared beside the function that computes it, by `columns`, or in any
module by one call of `register`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from e2rl.run.errors import InputError

Batch = dict[str, Any]  # tensors by name
Compute = Callable[[Batch], Tensor | Batch]


@dataclass(frozen=True)
class Metric:
    """What a metric is, how it is averaged over rollouts, and how it is printed.

    It is the mean of its column over the rollouts that know it (that are not NaN),
    unless other fields say otherwise.
    """

    name: str
    about: str
    unit: str = ""
    fraction: bool = False  # in [0, 1], printed in per cent
    decimals: int | None = None  # printed; None: three significant digits
    column: str = ""  # of the rows, where it differs from the name
    weight: str = ""  # column that weights the mean
    # Column by whose sum the sum of its own column is divided, instead of the mean.
    per: str = ""
    median: bool = False  # instead of the mean
    # Of a column of labels: expected number of them at so many places, not the mean.
    places: int = 0
    # Of a metric that `metrics.realism` computes from pooled samples: which it needs.
    samples: str = ""
    # Known for collisions only: paired differences compare each group's own collisions.
    per_collision: bool = False
    # Of the computation: a difference in it is not marked as significant.
    cost: bool = False
    # Happens to the ego in a rollout or not; in a search: in a scene, in any of its tries.
    event: bool = False
    # Value of a rollout in which the planner raised (`metrics.errored`); NaN: unknown.
    raised: float = math.nan
    # Closed-loop tables (`metrics=...` of evaluate.py) that show it, such as "main egos".
    tables: str = ""

    @property
    def source(self) -> str:
        """The rows' column that holds it."""
        return self.column or self.name


rate = partial(Metric, fraction=True)  # a metric in [0, 1]
event = partial(rate, event=True)
TABLES = (
    "main",
    "traffic",
    "adversaries",
    "methods",
    "egos",
    "public",
)  # of the package
# Of columns in every table (docs/reference/metrics.md); others follow as declared.
ORDER = (
    *(
        "cfr",
        "cfr_preventable",
        "cfr_clean",
        "cfr_counted",
        "errored",
        "cfr_adv",
        "cfr_vru",
    ),
    *("cfr_object", "cfr_bg", "avoidable"),
    *("front", "side", "rear", "rir", "preventable", "counted", "at_fault"),
    *("relvel", "contact_time", "min_dtc", "ttc_c", "macc", "progress"),
    *(
        "aor_step",
        "aor_any",
        "real",
        "real_adv",
        "real_norm",
        "transport",
        "seconds_per_rollout",
        "nfe",
    ),
)
METRICS: dict[str, Metric] = {}  # of rollouts, in ORDER
# Functions of a batch: a dict of columns, or the column of the metric of that name.
COMPUTE: dict[str, Compute] = {}
# Columns of a row after its metrics: what happened, and what metrics rest on.
EVENTS: list[str] = []
# Columns that hold one of these words, or "" where the computed index is -1.
WORDS: dict[str, tuple[str, ...]] = {}
SOURCE = ("dataset", "split", "method", "ego_policy")  # columns of a row of a run
IDENTITY = ("scene_id", "location", "seed", "eta")  # columns before a row's metrics
LATER: dict[str, float | str] = {  # last columns, and what rows that lack them know
    "errored": math.nan,
    "raised_by": "",  # "ego" or "traffic"
    "error": "",  # the message
    "cfr_object": math.nan,
    "left_out": math.nan,  # vehicles that come near, neither driven nor replayed
}


def declare(
    *metrics: Metric,
    events: Sequence[str] = (),
    words: Mapping[str, tuple[str, ...]] | None = None,
) -> None:
    """Add metrics whose columns are in the rows already, or are added to them later;
    `events`: further columns of the rows, `words`: those that hold words. Raises
    ValueError where a name is taken."""
    if taken := [metric.name for metric in metrics if metric.name in METRICS]:
        raise ValueError(
            f"metric {taken[0]}: name is taken; choose another, or unregister it first"
        )
    rank = {name: place for place, name in enumerate(ORDER)}
    declared = [*METRICS.values(), *metrics]
    declared.sort(key=lambda metric: rank.get(metric.name, len(rank)))
    METRICS.clear()
    METRICS.update({metric.name: metric for metric in declared})
    EVENTS.extend(events)
    WORDS.update(words or {})


def columns(
    *metrics: Metric,
    events: Sequence[str] = (),
    words: Mapping[str, tuple[str, ...]] | None = None,
) -> Callable[[Compute], Compute]:
    """Decorator of a function batch -> {column: [B]}: declares the metrics that it
    computes (see `declare`)."""

    def computes(compute: Compute) -> Compute:
        declare(
            *metrics,
            events=events,
            words=words,
        )
        COMPUTE[compute.__name__] = compute
        return compute

    return computes


def register(metric: Metric, compute: Compute | None = None) -> None:
    """Add a metric of rollouts to rollouts.csv, metrics.json and its tables.

    Args:
        metric: what it is.
        compute: compute(batch) returns the metric's column [B], NaN where it is
            unknown, or a dict of columns: this one, and those that `weight` or `per`
            name. `score_rollouts` calls it on the CPU for at most 32 rollouts at once.
            The batch holds the tensors of `sim.rollouts.Rollouts` (positions in
            float64, 0 where invalid), `traffic` [B, N] bool, the simulated vehicles
            other than the ego, and the fields of `contact.first_contact`, such as `hit`
            and `stop` [B]. None: the metric is read from a column that exists already
            or is added to the rows later.

    Raises:
        InputError: the name or the column is taken.
    """
    if metric.name in COMPUTE or (
        compute is not None and metric.source in row_columns()
    ):
        raise InputError(
            f"metric {metric.name}: name or column is taken; choose another, or "
            "unregister it first"
        )
    declare(metric)
    if compute is not None:
        COMPUTE[metric.name] = compute


def unregister(name: str) -> None:
    """Take a registered metric out of the catalogue again."""
    METRICS.pop(name)
    COMPUTE.pop(name, None)


def table_names() -> tuple[str, ...]:
    """Names of the closed-loop tables."""
    return tuple(
        dict.fromkeys(
            [
                *TABLES,
                *(
                    table
                    for metric in METRICS.values()
                    for table in metric.tables.split()
                ),
            ]
        )
    )


def table_metrics(table: str) -> tuple[Metric, ...]:
    """The metrics of a closed-loop table, in its order."""
    return tuple(
        metric for metric in METRICS.values() if table in metric.tables.split()
    )


def row_columns() -> tuple[str, ...]:
    """Columns of a row: its identity, its metrics, events, what metrics are weighted or
    divided by, and LATER ones."""
    metrics = METRICS.values()
    weights = [
        name for metric in metrics for name in (metric.weight, metric.per) if name
    ]
    columns = (*IDENTITY, *(metric.source for metric in metrics), *EVENTS, *weights)
    return (*dict.fromkeys(name for name in columns if name not in LATER), *LATER)
