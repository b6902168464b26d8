"""Tables of metrics from the rows of metrics.json, for a terminal, Markdown, LaTeX and
CSV. Fractions are in per cent.

A run has a table with a row for each metric and a column for each method, and one with
the differences to the first.
"""

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from tabulate import LATEX_ESCAPE_RULES, tabulate

from e2rl.metrics.catalogue import (
    METRICS,
    Metric,
    table_metrics,
)
from e2rl.run.files import write_atomically
from e2rl.run.terminal import column_groups, terminal_width

Key = TypeVar("Key")
UNKNOWN = "–"
MEANS = "Mean [95% interval, by location or scene]; (n) rollouts where fewer count."
PAIRED = "[95% interval], paired by (scene, seed); * the interval leaves out 0."
LATEX = str.maketrans(LATEX_ESCAPE_RULES)
SYMBOLS = str.maketrans(
    {
        "–": "--",
        "−": "$-$",
        "η": r"$\eta$",
        "²": "$^2$",
        "³": "$^3$",
        "≤": r"$\le$",
        "≥": r"$\ge$",
    }
)


@dataclass
class Table:
    """A caption, column heads and rows of cells; the first column is text, the others
    are numbers. title: of the section that begins with the table; links: places in the
    failure report that the numbers of the first rows lead to."""

    caption: str
    head: list[str]
    rows: list[list[str]]
    title: str = ""
    links: list[list[str]] = field(default_factory=list)

    def text(self) -> str:
        """For a terminal: aligned columns, the caption above; columns that find no room
        stand beneath, beside the first column again."""
        width = terminal_width()
        lines = [self.head, *self.rows]
        widths = [
            max(len(line[column]) for line in lines) for column in range(len(self.head))
        ]
        grids = [
            grid([[line[column] for column in columns] for line in lines], "simple")
            for columns in column_groups(widths, width)
        ]
        caption = textwrap.fill(self.caption, width)
        title = [self.title] if self.title else []
        return "\n".join([*title, caption, "\n\n".join(grids)])

    def markdown(self) -> str:
        """A Markdown table, its caption beneath."""
        lines = [
            [cell.replace("|", "&#124;") for cell in line]
            for line in (self.head, *self.rows)
        ]
        title = f"## {self.title}\n\n" if self.title else ""
        return f"{title}{grid(lines, 'pipe')}\n\n{self.caption}\n"

    def latex(self) -> str:
        """A table environment with a tabular of package booktabs."""
        body = grid([self.head, *self.rows], "latex_booktabs").translate(SYMBOLS)
        caption = escaped(self.caption)
        return f"\\begin{{table}}\n{body}\n\\caption{{{caption}}}\n\\end{{table}}\n"


def grid(lines: Sequence[Sequence[str]], kind: str) -> str:
    """Head and rows in a format of tabulate."""
    head, *rows = lines
    align = ["left"] + ["right"] * (len(head) - 1)
    return tabulate(rows, head, kind, disable_numparse=True, colalign=align)


def escaped(text: str) -> str:
    """The text for LaTeX."""
    return text.translate(LATEX).translate(SYMBOLS)


def metric_tables(
    rows: Sequence[dict],
    settings: str = "",
    table: str = "main",
) -> list[Table]:
    """Returns the tables of rows of metrics.json: for each data set, split and ego the
    means of each method, and their differences where there are several.

    Args:
        rows: of metrics.json.
        settings: text for every caption, such as the prior and its sampler.
        table: of the catalogue, whose metrics the closed-loop tables show; a caption
            names those that no row knows.
    """
    groups = grouped(rows, lambda row: (row["dataset"], row["split"], row["ego"]))
    metrics = table_metrics(table)
    tables = []
    for group in groups.values():
        tables.append(means_table(group, settings, metrics=metrics))
        tables.append(paired_table(group, metrics))
    return [table for table in tables if table.rows]


def means_table(
    group: Sequence[dict],
    settings: str,
    metrics: Sequence[Metric],
) -> Table:
    """The mean and interval of each metric, with a column for each row of
    metrics.json."""
    shown = known_metrics(group, metrics)
    names = column_names(group)
    unknown = [metric.name for metric in metrics if metric not in shown]
    sentences = [
        f"{origin(group[0])}.",
        counts(group, names),
        MEANS,
        notes_on(group),
        f"{settings.rstrip('.')}." if settings else "",
        f"Not computable here: {', '.join(unknown)}." if unknown else "",
    ]
    rows = [
        [heading(metric), *(mean_cell(metric, row) for row in group)]
        for metric in shown
    ]
    return Table(" ".join(filter(None, sentences)), ["", *names], rows=rows)


def paired_table(group: Sequence[dict], metrics: Sequence[Metric]) -> Table:
    """Paired differences, of fractions in percentage points: of each method to the
    first one or, where rows have stages, of each method after training to itself
    before. No rows where nothing is paired."""
    first = group[0]
    names = column_names(group)
    # A method with several etas is named method@eta in `paired`.
    reference = names[0]
    keys = [f"{first['method']}@{first['eta']:g}", first["method"]]
    if any(row.get("stage") == "after" for row in group):
        reference = "before"
        keys = ["before"]
    columns = {
        name: row["paired"][key]
        for name, row in zip(names, group, strict=True)
        for key in keys
        if row["paired"].get(key)
    }
    rows = []
    for metric in metrics:
        cells = [
            difference_cell(metric, paired.get(metric.name))
            for paired in columns.values()
        ]
        if set(cells) - {UNKNOWN}:
            rows.append([heading(metric, points=True), *cells])
    caption = f"{origin(first)}. Difference to {reference} {PAIRED}"
    return Table(caption, ["", *columns], rows=rows)


def known_metrics(group: Sequence[dict], metrics: Iterable[Metric]) -> list[Metric]:
    """The metrics that some row knows."""
    return [
        metric
        for metric in metrics
        if any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)
    ]


def origin(row: dict) -> str:
    return f"{row['dataset']}/{row['split']}, ego {row['ego']}"


def counts(group: Sequence[dict], names: Sequence[str], per: str = "method") -> str:
    """Numbers of scenes, seeds and rollouts, and of rollouts without a score; once
    where all columns agree, else by column."""
    texts = {}
    for name, row in zip(names, group, strict=True):
        parts = [
            plural(row[f"n_{word}s"], word) for word in ("scene", "seed", "rollout")
        ]
        if row.get("n_trainings", 1) > 1:
            parts.append(plural(row["n_trainings"], "training"))
        parts += [
            f"{count} rollouts without a score ({reason})"
            for reason, count in row.get("errored", {}).items()
        ]
        texts[name] = ", ".join(parts)
    if len(set(texts.values())) == 1:
        return f"{texts[names[0]]} per {per}."
    return "; ".join(f"{name}: {text}" for name, text in texts.items()) + "."


def notes_on(group: Sequence[dict]) -> str:
    """What the rates of rows of metrics.json are of, where planners raised or scenes
    were searched."""
    notes = []
    if any(row["metrics"].get("errored", {}).get("mean", 0.0) > 0 for row in group):
        failures = [
            name
            for name, metric in METRICS.items()
            if metric.raised == 1 and name != "errored"
        ]
        notes.append(
            "A rollout in which the planner raised (errored) is a failure in "
            f"{', '.join(failures)}, has a progress of 0, and is not in the "
            "denominators of the others; one that the traffic lost is in none."
        )
    if any(row.get("searched") for row in group):
        events = ", ".join(name for name, metric in METRICS.items() if metric.event)
        notes.append(
            "Tries go where failures are, so their rates are none of the planner: "
            f"{events} are of searches of a scene (n), in any of its tries; the other "
            "columns are of tries."
        )
    return " ".join(notes)


def column_names(group: Sequence[Mapping]) -> list[str]:
    """The method, after its stage of training if any, with eta where it is not 0 or
    where the method has several."""
    names = []
    for row in group:
        etas = {other["eta"] for other in group if other["method"] == row["method"]}
        stage = row.get("stage") or ""
        eta = f"η={row['eta']:g}" if row["eta"] or len(etas) > 1 else ""
        names.append(" ".join(filter(None, (stage, row["method"], eta))))
    return names


# --- cells


def heading(metric: Metric, points: bool = False) -> str:
    unit = ("points" if points else "%") if metric.fraction else metric.unit
    return f"{metric.name} [{unit}]" if unit else metric.name


def mean_cell(metric: Metric, row: dict) -> str:
    """Such as `12.3 [8.1, 16.4] (n)`, where n is left out if all rollouts count."""
    value = row["metrics"].get(metric.name)
    if not value or not value["n"]:
        return UNKNOWN
    count = f" ({value['n']})" if value["n"] != row["n_rollouts"] else ""
    return estimate(metric, value, name="mean") + count


def difference_cell(metric: Metric, value: dict | None) -> str:
    """Such as `+2.1 [+0.4, +3.9]*`, with a star where the interval leaves out 0, but
    for costs of the computation."""
    if not value or math.isnan(value["difference"]):
        return UNKNOWN
    certain = not metric.cost and (value["low"] > 0 or value["high"] < 0)
    text = estimate(metric, value, name="difference", sign="+")
    return f"{text}*" if certain else text


def estimate(metric: Metric, value: Mapping, *, name: str, sign: str = "") -> str:
    """The value called `name` and, where it is known and no point, its interval.

    Args:
        metric: whose value it is.
        value: holds it under `name`, and its interval under `low` and `high`.
        name: `mean` or `difference`.
        sign: "+" to write it always.

    Returns:
        Such as `12.3 [8.1, 16.4]`.
    """
    centre, low, high = (
        number(metric, value[key], sign=sign) for key in (name, "low", "high")
    )
    return f"{centre} [{low}, {high}]" if value["low"] < value["high"] else centre


def number(metric: Metric, value: float, sign: str = "") -> str:
    """The value with the metric's own number of `decimals`, if it declares one; sign:
    "+" to write it always.

    Without one, shares are in per cent with one decimal (two below one per cent), and
    others have three digits.
    """
    if metric.fraction:
        value *= 100
    size = abs(value)
    decimals = metric.decimals
    if decimals is None and metric.fraction:
        decimals = 1 if size >= 1 or size == 0 else 2
    elif decimals is None and size == 0:
        decimals = 2
    elif decimals is None:
        decimals = 3 - sum(size >= bound for bound in (1, 10, 1000))
    return f"{value:{sign}.{decimals}f}"


# --- files


def save_tables(path: Path, tables: Iterable[Table]) -> None:
    """Write the tables into a Markdown file, with a list of what each metric means."""
    texts = [table.markdown() for table in tables]
    write_atomically(path, "\n".join([*texts, f"```\n{legend()}\n```\n"]))


def print_tables(tables: Iterable[Table]) -> None:
    for table in tables:
        print(f"\n{table.text()}")


def legend() -> str:
    """One line per metric: its name and what it means."""
    width = max(map(len, METRICS))
    return "\n".join(
        f"{metric.name.ljust(width)}  {metric.about}" for metric in METRICS.values()
    )


# --- words and groups


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def grouped(rows: Iterable[dict], key: Callable[[dict], Key]) -> dict[Key, list[dict]]:
    """The rows by their key, in the order of its first row."""
    groups: dict[Key, list[dict]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups
