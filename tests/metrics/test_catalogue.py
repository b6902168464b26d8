"""A metric that is registered from outside appears in rows, files and tables, and
nothing else changes."""

import pytest
import torch

from e2rl.evaluation.rollout_files import read_rows, write_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.catalogue import Metric, register, table_metrics, unregister
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.statistics import MetricTable, paired_differences, summarise
from e2rl.report.tables import legend, metric_tables
from e2rl.run.errors import InputError
from tests.metrics.random_rollouts import random_rollouts


def fast_traffic(batch):
    """The share of vehicle-steps until the ego's contact above 10 m/s, and the steps it
    rests on."""
    steps = torch.arange(batch["states"].shape[1])
    counted = (
        batch["valid"]
        & batch["traffic"][:, None]
        & (steps <= batch["stop"][:, None])[..., None]
    )
    number = counted.sum((1, 2))
    return {
        "fast": ((batch["states"][..., 3] > 10) & counted).sum((1, 2)) / number,
        "fast_steps": number,
    }


@pytest.fixture
def fast():
    metric = Metric(
        "fast",
        "vehicle-steps above 10 m/s",
        fraction=True,
        weight="fast_steps",
        tables="main speeds",
    )
    register(metric, fast_traffic)
    yield metric
    unregister("fast")


def test_it_is_in_rows_files_summaries_and_its_tables(fast, tmp_path):
    rollouts = random_rollouts(40)  # more than one batch
    rows, samples = score_rollouts(rollouts)
    assert all(0 < row["fast"] < 1 and row["fast_steps"] > 0 for row in rows)
    table = MetricTable.of(rows, [fast])
    assert torch.equal(
        table.totals / table.weights,
        torch.tensor([[row["fast"]] for row in rows], dtype=torch.float64),
    )
    expected = sum(row["fast"] * row["fast_steps"] for row in rows) / sum(
        row["fast_steps"] for row in rows
    )
    assert summarise(rows, samples, draws=20, realism_draws=2)["fast"][
        "mean"
    ] == pytest.approx(expected)
    assert (
        paired_differences(
            rows,
            samples,
            other_rows=rows,
            other_samples=samples,
            draws=20,
            realism_draws=2,
        )["fast"]["difference"]
        == 0
    )
    write_rows(tmp_path / "rollouts.csv", rows)
    assert read_rows(tmp_path / "rollouts.csv")[7]["fast"] == pytest.approx(
        rows[7]["fast"]
    )
    summaries = metric_rows(rows, samples, draws=20, realism_draws=2)
    (row,) = metric_tables(summaries, table="speeds")[0].rows
    assert row[0] == "fast [%]"
    assert row[1].startswith(f"{100 * expected:.1f} [")
    assert metric_tables(summaries, table="main")[0].rows[-1] == row
    assert "above 10 m/s" in legend()
    assert fast not in table_metrics("traffic")


def test_taken_names_are_refused():
    for name in (
        "cfr",
        "seed",
        "partner",
        "motion_columns",
    ):  # a metric, columns, the name of a built-in function
        with pytest.raises(InputError, match=f"metric {name}: .*taken"):
            register(Metric(name, ""), fast_traffic)


def none_left(batch):
    return batch["stop"] / batch["nobody"]


@pytest.mark.parametrize(
    ("compute", "message"),
    [
        (
            lambda batch: batch["valid"],
            r"wrong is a Tensor \[2, .* a tensor \[2\] here",
        ),
        (lambda batch: [0.0, 1.0], "wrong is a list, expected one number per rollout"),
        (none_left, r"failed at .*test_catalogue.py:\d+: KeyError 'nobody'; mend it"),
    ],
)
def test_a_metric_that_fails_is_named(compute, message):
    register(Metric("wrong", ""), compute)
    try:
        with pytest.raises(InputError, match=f"metric wrong: {message}"):
            score_rollouts(random_rollouts(2))
    finally:
        unregister("wrong")
