"""Tables with a row a method or a row an ego: their metrics, and their differences to one of them (tables 1 and 4)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from e2rl.files import write_atomically
from e2rl.metrics.catalogue import STAGES, Metric, table_metrics
from e2rl.report.tables import UNKNOWN, Table, column_names, counts, difference_cell, heading, mean_cell, origin

Terms = Mapping[str, tuple[str, str]]  # by method: what it knows of the ego and owes it, "" for nothing to say
METHODS, EGOS = "methods", "egos"  # tables of the catalogue, and names of the files
MEANS = "Mean [95% interval, bootstrap by location or scene]; (n) rollouts where fewer count."


class Line(NamedTuple):
    """A row of a table: its first cells, and its row of metrics.json."""

    labels: list[str]
    row: dict


def method_tables(
    rows: Sequence[dict], terms: Terms, references: Sequence[str], settings: str = "", table: str = METHODS
) -> list[Table]:
    """Means and paired differences of the closed-loop rows of metrics.json: a row a method, a column a metric.

    references: methods that each is compared with; they must be among the rows. settings: for the captions; table: of
    `catalogue.TABLES`, whose metrics are the columns, but for those that no row knows.
    """
    group = closed_loop(rows)
    names = column_names(group)
    lines = [Line([name, *terms_of(row["method"], terms)], row) for name, row in zip(names, group, strict=True)]
    text = f"{origin(group[0])}. {counts(group, names)}"
    note = f"Knowledge: the ego's plan, or its motion predicted; duty: what adversaries owe the ego. {settings}"
    head, others = ["method", "knowledge", "duty"], {name: name for name in references}
    return [
        means_table("Methods", head, lines, table, f"{text} {MEANS} {note}"),
        *differences_table(
            head, lines, table, f"{text} Difference of each method to {' and to '.join(references)}", others
        ),
    ]


def planner_tables(
    rows: Sequence[dict], names: Sequence[str], reference: str, settings: str = "", table: str = EGOS
) -> list[Table]:
    """The same with a row for each ego of `names` and each traffic and intensity; reference: ego that each is compared
    with in the same traffic."""
    lines = []
    for name in names:
        own = [row for row in closed_loop(rows) if row["ego"] == name]
        for traffic, row in zip(column_names(own), own, strict=True):
            lines.append(Line([name, traffic], row))
    first, labels = lines[0].row, [f"{ego} under {traffic}" for (ego, traffic), *_ in lines]
    text = f"{first['dataset']}/{first['split']}. {counts([line.row for line in lines], labels, 'ego and traffic')}"
    head, difference = ["ego", "traffic"], f"{text} Difference of each ego to {reference} in the same traffic"
    return [
        means_table("Egos", head, lines, table, f"{text} {MEANS} {settings}"),
        *differences_table(head, lines, table, difference, {reference: f"ego {reference}"}),
    ]


def means_table(title: str, head: list[str], lines: Sequence[Line], table: str, caption: str) -> Table:
    metrics = known_metrics([line.row for line in lines], table)
    cells = [[*line.labels, *(mean_cell(metric, line.row) for metric in metrics)] for line in lines]
    return Table(f"{caption.strip().rstrip('.')}.", [*head, *map(heading, metrics)], cells, title)


def differences_table(
    head: list[str], lines: Sequence[Line], table: str, caption: str, references: Mapping[str, str]
) -> list[Table]:
    """The differences of the lines that have some, to one reference after the other; no table where none has.
    references: {name: its key in a row's `paired`}."""
    metrics = known_metrics([line.row for line in lines], table)
    cells = [
        [*line.labels, name, *(difference_cell(metric, line.row["paired"][key].get(metric.name)) for metric in metrics)]
        for name, key in references.items()
        for line in lines
        if key in line.row["paired"]
    ]
    caption = f"{caption} [95% interval], paired by (scene, seed); * the interval leaves out 0."
    heads = [*head, "minus", *(heading(metric, points=True) for metric in metrics)]
    return [Table(caption, heads, cells)] if cells else []


def closed_loop(rows: Sequence[dict]) -> list[dict]:
    return [row for row in rows if row.get("stage") not in STAGES]


def known_metrics(group: Sequence[dict], table: str) -> list[Metric]:
    """The metrics of a table that some row knows."""
    return [
        metric
        for metric in table_metrics(table)
        if any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)
    ]


def terms_of(method: str, terms: Terms) -> list[str]:
    return [term or UNKNOWN for term in terms.get(method, ("", ""))]


def save_compared(folder: Path, tables: Sequence[Table], name: str = METHODS) -> None:
    """Write the tables into one file of Markdown and one of LaTeX, both called `name`, and into a CSV file each: `name`
    and `name`_differences."""
    write_atomically(folder / f"{name}.md", "\n".join(table.markdown() for table in tables))
    write_atomically(folder / f"{name}.tex", "\n".join(table.latex() for table in tables))
    for table, suffix in zip(tables, ("", "_differences"), strict=False):
        write_atomically(folder / f"{name}{suffix}.csv", table.csv())
