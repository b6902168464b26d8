"""Tables with a row a method or a row an ego: their metrics, and their differences to one of them (tables 1 and 4).

Tables of several egos side by side, and whether a trained one still drives as it should.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from e2rl.metrics.catalogue import METRICS, STAGES, Metric, table_metrics
from e2rl.report.tables import UNKNOWN, Table, column_names, counts, difference_cell, heading, mean_cell, origin
from e2rl.run.files import write_atomically

SHOWN = ("cfr", "cfr_counted", "failures_per_km", "counted_per_km", "cfr_adv", "progress", "macc", "ego_off_road")
NOTES = {
    "failures_per_km": "Collisions of all rollouts over the kilometres driven in them, up to the first contact.",
    "counted_per_km": "Failures that count over the kilometres driven, up to the first contact.",
}
TRAININGS = (
    "An ego of several trainings is their pool: the intervals draw trainings as well as places, with replacement, and "
    "with few trainings are too narrow rather than too wide"
)
UP, PROGRESS, ROUGHNESS = 0.01, 0.97, 1.25  # share of rollouts; of the planner's; of the recorded egos'
Cells = Mapping[tuple[str, str], dict]  # rows of metrics.json by ego and traffic


def ego_tables(
    rows: Sequence[dict], names: Sequence[str], pairs: Sequence[tuple[str, str]], title: str, settings: str = ""
) -> list[Table]:
    """A table for each of SHOWN: a row for each traffic and intensity, a column for each ego of `names`, then for each
    of `pairs` the paired difference, of the first pair also in per cent of its second ego.

    rows: of metrics.json; settings: for the first caption. Metrics that no row knows have no table.
    """
    cells, traffic = by_ego(rows, names)
    tables: list[Table] = []
    for metric in (METRICS[name] for name in SHOWN):
        lines = [line(metric, cells, label, names, pairs) for label in traffic]
        if all(cell == UNKNOWN for cells_of in lines for cell in cells_of[1:]):
            continue
        head = [heading(metric), *names, *(difference_heading(metric, *pair) for pair in pairs)]
        head[len(names) + 2 : len(names) + 2] = [f"{pairs[0][0]} − {pairs[0][1]} [%]"] if pairs else []
        tables.append(Table(caption(metric, rows, settings if not tables else ""), head, lines))
    if tables:
        tables[0].title = title
    return tables


def by_ego(rows: Sequence[dict], names: Sequence[str]) -> tuple[Cells, list[str]]:
    """({(ego, traffic): row}, names of traffic and intensity) of the closed-loop rows of the egos `names`."""
    cells: dict[tuple[str, str], dict] = {}
    for name in names:
        group = [row for row in rows if row["ego"] == name and row.get("stage") is None]
        cells |= {(name, label): row for label, row in zip(column_names(group), group, strict=True)}
    return cells, list(dict.fromkeys(label for _, label in cells))


def line(metric: Metric, cells: Cells, label: str, names: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """The cells of one traffic: means of the egos, differences of the pairs."""
    found = [(cells[first, label]["paired"].get(f"ego {second}") or {}).get(metric.name) for first, second in pairs]
    differences = [difference_cell(metric, value) for value in found]
    differences[1:1] = [relative_cell(value) for value in found[:1]]
    return [label, *(mean_cell(metric, cells[name, label]) for name in names), *differences]


def difference_heading(metric: Metric, first: str, second: str) -> str:
    unit = "points" if metric.fraction else metric.unit
    return f"{first} − {second} [{unit}]" if unit else f"{first} − {second}"


def relative_cell(value: dict | None) -> str:
    """Such as `-31 [-42, -17]*`, per cent; the interval is unknown where a draw has nothing to be a share of."""
    if not value or not math.isfinite(value["relative"]):
        return UNKNOWN
    centre, low, high = (100 * value[name] for name in ("relative", "relative_low", "relative_high"))
    if math.isnan(low):
        return f"{centre:+.0f}"
    return f"{centre:+.0f} [{low:+.0f}, {high:+.0f}]" + ("*" if low > 0 or high < 0 else "")


def caption(metric: Metric, rows: Sequence[dict], settings: str) -> str:
    """What the table shows; with the settings also how it was measured."""
    text = f"{metric.name}: {metric.about}. {NOTES.get(metric.name, '')}".strip()
    text += " Mean [95% interval, bootstrap by location or scene]; differences paired by (scene, seed), * the interval "
    text += "leaves out 0."
    if not settings:
        return text
    first = rows[0]
    text += f" {first['dataset']}/{first['split']}, {first['n_scenes']} scenes, {first['n_seeds']} seeds."
    pooled = any(row.get("n_trainings", 1) > 1 for row in rows)
    return f"{text}{f' {TRAININGS}.' if pooled else ''} {settings.rstrip('.')}."


# --- guards


def guard_table(rows: Sequence[dict], before: str, after: str, planner: str, recorded: float) -> Table:
    """Whether `after` still drives well in nominal traffic: each guard with its limit, what was found, met or missed.

    recorded: mean |acceleration| [m/s^2] of the recorded egos. Estimates decide; intervals stand beside them.
    """
    cells, _ = by_ego(rows, [after])
    row = cells[after, "nominal"]

    def over(name: str, other: str, most: float) -> list[str]:
        """A guard on a metric's paired difference to another ego."""
        metric, paired = METRICS[name], row["paired"][f"ego {other}"][name]
        limit = f"≤ {100 * most:.0f}"
        return [
            f"{metric.name} over {other} [points]",
            limit,
            difference_cell(metric, paired),
            verdict(paired["difference"], most),
        ]

    progress, macc = row["paired"][f"ego {planner}"]["progress"], METRICS["macc"]
    ceiling = ROUGHNESS * recorded
    lines = [
        over("cfr", before, UP),
        over("cfr", planner, 0.0),
        [
            f"progress against {planner} [%]",
            f"≥ {100 * (PROGRESS - 1):.0f}",
            relative_cell(progress),
            verdict(-progress["relative"], 1 - PROGRESS),
        ],
        [
            f"macc [m/s²], recorded egos: {recorded:.2f}",
            f"≤ {ceiling:.2f}",
            mean_cell(macc, row),
            verdict(row["metrics"]["macc"]["mean"], ceiling),
        ],
        over("ego_off_road", before, 0.0),
    ]
    text = (
        f"Guards of {after}, in nominal traffic: what must not be given up for fewer collisions. The estimate decides, "
    )
    text += "the 95% interval stands beside it; differences are paired by (scene, seed)."
    return Table(text, ["", "limit", "found", ""], lines)


def verdict(value: float, most: float) -> str:
    """met, missed, or unknown."""
    return UNKNOWN if math.isnan(value) else "met" if value <= most + 1e-12 else "missed"


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
