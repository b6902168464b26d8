"""The table of methods: a row for each, with what it knows and owes, its metrics, its differences to one of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from e2rl.files import write_atomically
from e2rl.metrics.catalogue import STAGES, Metric, table_metrics
from e2rl.report.tables import UNKNOWN, Table, column_names, counts, difference_cell, heading, mean_cell, origin

Terms = Mapping[str, tuple[str, str]]  # by method: what it knows of the ego and owes it, "" for nothing to say
NAME = "methods"


def method_tables(
    rows: Sequence[dict], terms: Terms, reference: str, settings: str = "", table: str = NAME
) -> list[Table]:
    """Means and paired differences of the closed-loop rows of metrics.json: a row a method, a column a metric.

    reference: method that each is compared with; it must be among the rows. settings: for the captions; table: of
    `catalogue.TABLES`, whose metrics are the columns, but for those that no row knows.
    """
    group = [row for row in rows if row.get("stage") not in STAGES]
    names, metrics = column_names(group), known_metrics(group, table)
    text = f"{origin(group[0])}. {counts(group, names)}"
    settings = f" {settings.rstrip('.')}." if settings else ""
    head = ["method", "knowledge", "duty"]
    labels = [[name, *terms_of(row["method"], terms)] for name, row in zip(names, group, strict=True)]
    both = list(zip(labels, group, strict=True))
    means = [[*label, *(mean_cell(metric, row) for metric in metrics)] for label, row in both]
    caption = f"{text} Mean [95% interval, bootstrap by location or scene]; (n) rollouts where fewer count. Knowledge: "
    caption += "the ego's plan, or its motion predicted; duty: what adversaries owe the ego."
    tables = [Table(caption + settings, [*head, *map(heading, metrics)], means, "Methods")]
    found = [(label, row["paired"].get(reference)) for label, row in both]
    differences = [
        [*label, *(difference_cell(metric, paired.get(metric.name)) for metric in metrics)]
        for label, paired in found
        if paired
    ]
    caption = (
        f"{text} Difference of each method to {reference} [95% interval], paired by (scene, seed); * the interval "
    )
    if differences:
        points = [heading(metric, points=True) for metric in metrics]
        tables.append(Table(f"{caption}leaves out 0.", [*head, *points], differences))
    return tables


def known_metrics(group: Sequence[dict], table: str) -> list[Metric]:
    """The metrics of a table that some row knows."""
    return [
        metric
        for metric in table_metrics(table)
        if any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)
    ]


def terms_of(method: str, terms: Terms) -> list[str]:
    return [term or UNKNOWN for term in terms.get(method, ("", ""))]


def save_method_tables(folder: Path, tables: Sequence[Table]) -> None:
    """Write methods.md and methods.tex, and a CSV file for each table: methods.csv, methods_differences.csv."""
    write_atomically(folder / f"{NAME}.md", "\n".join(table.markdown() for table in tables))
    write_atomically(folder / f"{NAME}.tex", "\n".join(table.latex() for table in tables))
    for table, suffix in zip(tables, ("", "_differences"), strict=False):
        write_atomically(folder / f"{NAME}{suffix}.csv", table.csv())
