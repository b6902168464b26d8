"""Tables that compare methods or egos: a row each, with their differences to some of
them (tables 1 and 4)."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from e2rl.metrics.catalogue import Metric, table_metrics
from e2rl.report.tables import (
    MEANS,
    PAIRED,
    UNKNOWN,
    Table,
    column_names,
    counts,
    difference_cell,
    heading,
    known_metrics,
    mean_cell,
    notes_on,
    origin,
)
from e2rl.run.files import csv_text, write_atomically

METHODS = "methods"  # a table of the catalogue, and the name of its files
EGOS = "egos"
Terms = Mapping[str, tuple[str, str]]  # by method: knowledge of the ego, and duty to it
TRAININGS = (
    "An ego of several trainings is their pool: the intervals draw trainings as well as "
    "places, with replacement, and with few trainings are too narrow rather than too "
    "wide."
)


def method_tables(
    rows: Sequence[dict],
    terms: Terms,
    references: Sequence[str],
    settings: str = "",
    table: str = METHODS,
) -> list[Table]:
    """Returns means and paired differences: a row a method, a column a metric.

    Args:
        rows: of metrics.json.
        terms: knowledge and duty of each method.
        references: methods that each is compared with; they must be among the rows.
        settings: for the captions.
        table: of the catalogue, whose metrics are the columns, but for those that no
            row knows.
    """
    names = column_names(rows)
    text = f"{origin(rows[0])}. {counts(rows, names)}"
    labels = Table(
        f"{text} {MEANS} Knowledge: the ego's plan, or its motion predicted; duty: what "
        f"adversaries owe the ego. {settings}",
        ["method", "knowledge", "duty"],
        rows=[
            [name, *(term or UNKNOWN for term in terms.get(row["method"], ("", "")))]
            for name, row in zip(names, rows, strict=True)
        ],
        title="Methods",
    )
    return with_metrics(
        labels,
        rows,
        metrics=table_metrics(table),
        references={name: name for name in references},
        difference=f"{text} Difference of each method to {' and to '.join(references)}",
    )


def planner_tables(
    rows: Sequence[dict],
    names: Sequence[str],
    references: Collection[str],
    settings: str = "",
    table: str = EGOS,
) -> list[Table]:
    """Returns means and paired differences: a row an ego, traffic and intensity.

    Args:
        rows: of metrics.json.
        names: of the egos.
        references: egos that each is compared with in the same traffic, as far as the
            rows are paired with them.
        settings: for the captions.
        table: of the catalogue, whose metrics are the columns.
    """
    cells = by_ego(rows, names)
    group = list(cells.values())
    drives = [f"{ego} under {traffic}" for ego, traffic in cells]
    text = f"{group[0]['dataset']}/{group[0]['split']}. "
    text += counts(group, drives, per="ego and traffic")
    pooled = any(row.get("n_trainings", 1) > 1 for row in group)
    labels = Table(
        f"{text} {MEANS}{f' {TRAININGS}' if pooled else ''} {settings}",
        ["ego", "traffic"],
        rows=[list(key) for key in cells],
        title="Egos",
    )
    others = " and to ".join(references)
    return with_metrics(
        labels,
        group,
        metrics=table_metrics(table),
        references={name: f"ego {name}" for name in references},
        difference=f"{text} Difference of each ego to {others} in the same traffic",
    )


def with_metrics(
    labels: Table,
    group: Sequence[dict],
    *,
    metrics: Sequence[Metric],
    references: Mapping[str, str],
    difference: str,
) -> list[Table]:
    """The table of means, then that of differences where there are some.

    Args:
        labels: first columns of the table of means, a row for each of `group`.
        group: rows of metrics.json.
        metrics: further columns, but for those that no row knows.
        references: by name, its key in a row's `paired`.
        difference: caption of the differences.

    Returns:
        One table or two.
    """
    metrics = known_metrics(group, metrics)
    caption = f"{labels.caption.strip().rstrip('.')}. {notes_on(group)}".strip()
    means = [
        [*label, *(mean_cell(metric, row) for metric in metrics)]
        for label, row in zip(labels.rows, group, strict=True)
    ]
    head = [*labels.head, *map(heading, metrics)]
    tables = [Table(caption, head, rows=means, title=labels.title)]
    pairs = []
    for name, key in references.items():
        for label, row in zip(labels.rows, group, strict=True):
            if paired := row["paired"].get(key):
                cells = [
                    difference_cell(metric, paired.get(metric.name))
                    for metric in metrics
                ]
                pairs.append([*label, name, *cells])
    if pairs:
        points = (heading(metric, points=True) for metric in metrics)
        head = [*labels.head, "minus", *points]
        tables.append(Table(f"{difference} {PAIRED}", head, rows=pairs))
    return tables


def save_compared(folder: Path, tables: Sequence[Table], name: str = METHODS) -> None:
    """Write the tables into one file of Markdown and one of LaTeX, both called `name`,
    and into a CSV file each: `name` and `name`_differences."""
    markdown = "\n".join(table.markdown() for table in tables)
    latex = "\n".join(table.latex() for table in tables)
    write_atomically(folder / f"{name}.md", markdown)
    write_atomically(folder / f"{name}.tex", latex)
    for table, suffix in zip(tables, ("", "_differences"), strict=False):
        text = csv_text([table.head, *table.rows])
        write_atomically(folder / f"{name}{suffix}.csv", text)


# --- egos side by side


def by_ego(rows: Sequence[dict], names: Sequence[str]) -> dict[tuple[str, str], dict]:
    """{(ego, traffic and intensity): row} of the closed-loop rows of these egos."""
    cells: dict[tuple[str, str], dict] = {}
    for name in names:
        group = [row for row in rows if row["ego"] == name and row.get("stage") is None]
        for label, row in zip(column_names(group), group, strict=True):
            cells[name, label] = row
    return cells
