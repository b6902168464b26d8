"""Metric tables from the rows of metrics.json, for a terminal and as markdown. Shares are in per cent.

For each (dataset, split, ego), one table has a row per metric and a column per method. Where there are several methods,
a second table has each method's paired difference to the first.
"""

import csv
import io
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from e2rl.metrics.catalogue import META_STAGE, METRICS, OPEN_LOOP_STAGE, STAGES, Metric, table_metrics
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically

UNKNOWN = "–"
COUNTED = {
    OPEN_LOOP_STAGE: "(n) vehicles: others than the ego, faster than 0.5 m/s in the log at the start, recorded "
    "throughout the horizon; causal start states, a route drawn per sample; samples without acceleration bounds.",
    META_STAGE: "(n) scenes. Likelihood of the log under each vehicle's histogram over all rollouts and steps; "
    "vehicles recorded throughout. A deterministic method's rollout stands for all.",
}  # what the count (n) of a stage's cells counts, and how its metrics are computed


@dataclass
class Table:
    """A caption, column heads and rows of cells; the first column is text, the others are numbers. title: of the
    section that begins with the table."""

    caption: str
    head: list[str]
    rows: list[list[str]]
    title: str = ""

    def text(self) -> str:
        """For a terminal: aligned columns, the caption above."""
        widths = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)]

        def line(cells: list[str]) -> str:
            numbers = [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
            return "  ".join([cells[0].ljust(widths[0]), *numbers]).rstrip()

        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        caption = textwrap.fill(self.caption, max(len(rule), 60))
        title = [f"{self.title}\n"] if self.title else []
        return "\n".join([*title, caption, rule, line(self.head), rule, *map(line, self.rows), rule])

    def markdown(self) -> str:
        """A markdown table, its caption beneath."""

        def line(cells: list[str]) -> str:
            return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"

        align = "| --- |" + " ---: |" * (len(self.head) - 1)
        title = [f"## {self.title}\n"] if self.title else []
        return "\n".join([*title, line(self.head), align, *map(line, self.rows), "", self.caption, ""])

    def csv(self) -> str:
        """Head and rows, without the caption."""
        buffer = io.StringIO()
        csv.writer(buffer, lineterminator="\n").writerows([self.head, *self.rows])
        return buffer.getvalue()

    def latex(self) -> str:
        """A table environment with a tabular of package booktabs."""

        def line(cells: list[str]) -> str:
            return " & ".join(map(escaped, cells)) + r" \\"

        columns = "l" + "r" * (len(self.head) - 1)
        lines = [r"\begin{table}", rf"\begin{{tabular}}{{{columns}}}", r"\toprule", line(self.head), r"\midrule"]
        lines += [*map(line, self.rows), r"\bottomrule", r"\end{tabular}"]
        return "\n".join([*lines, rf"\caption{{{escaped(self.caption)}}}", r"\end{table}", ""])


def metric_tables(rows: Sequence[dict], settings: str = "", table: str = "main") -> list[Table]:
    """Tables of rows as in metrics.json.

    settings: text for every caption, such as the prior and its sampler. table: of `catalogue.TABLES`, whose metrics the
    closed-loop tables show; a caption names those that no row knows. Rows of the stages `open loop` and `meta-metric`
    have their own tables and metrics.
    """
    groups: dict[tuple, list[dict]] = {}
    metrics = table_metrics(table)
    for row in rows:
        stage = row.get("stage") if row.get("stage") in STAGES else None
        groups.setdefault((row["dataset"], row["split"], row["ego"], stage), []).append(row)
    tables = []
    for (*_, stage), group in groups.items():
        tables += [means_table(group, settings, STAGES.get(stage, metrics)), paired_table(group, metrics)]
    return [table for table in tables if table.rows]


def means_table(group: Sequence[dict], settings: str, metrics: Sequence[Metric]) -> Table:
    """Mean [95% interval] of each metric, with a column for each row of metrics.json."""
    known = [metric for metric in metrics if any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)]
    unknown = [metric.name for metric in metrics if metric not in known]
    names, counted = column_names(group), COUNTED.get(group[0].get("stage", ""), "(n) rollouts where fewer count.")
    caption = (
        f"{origin(group[0])}. {counts(group, names)} Mean [95% interval, bootstrap by location or scene]; {counted}"
    )
    caption += f" {settings.rstrip('.')}." if settings else ""
    caption += f" Not computable here: {', '.join(unknown)}." if unknown else ""
    rows = [[heading(metric), *(mean_cell(metric, row) for row in group)] for metric in known]
    return Table(caption, ["", *names], rows)


def paired_table(group: Sequence[dict], metrics: Sequence[Metric]) -> Table:
    """Paired differences over the same (scene, seed), of shares in per cent points.

    They compare each method with the first one or, where rows have the stages before and after training, each method
    after training with itself before. The table has no rows where nothing is paired.
    """
    first, names = group[0], column_names(group)
    # A method with several etas is named method@eta in `paired`.
    reference, keys = names[0], [f"{first['method']}@{first['eta']:g}", first["method"]]
    if any(row.get("stage") == "after" for row in group):
        reference, keys = "before", ["before"]
    found = [(name, row["paired"].get(key)) for name, row in zip(names, group, strict=True) for key in keys]
    columns = {name: paired for name, paired in found if paired}
    rows = []
    for metric in metrics:
        cells = [difference_cell(metric, paired.get(metric.name)) for paired in columns.values()]
        if any(cell != UNKNOWN for cell in cells):
            rows.append([heading(metric, points=True), *cells])
    caption = f"{origin(first)}. Difference to {reference} [95% interval], paired by (scene, seed); * the interval "
    return Table(f"{caption}leaves out 0.", ["", *columns], rows)


def origin(row: dict) -> str:
    return f"{row['dataset']}/{row['split']}, ego {row['ego']}"


def counts(group: Sequence[dict], names: Sequence[str], per: str = "method") -> str:
    """Numbers of scenes, seeds and rollouts, and of rollouts without a score; once where all columns agree, else by
    column."""
    texts = []
    for row in group:
        numbers = {word: row[f"n_{word}s"] for word in ("scene", "seed", "rollout")}
        ended = [f"{count} without a score ({reason})" for reason, count in row.get("ended", {}).items()]
        texts.append(", ".join([*(f"{n} {word}{'' if n == 1 else 's'}" for word, n in numbers.items()), *ended]))
    if len(set(texts)) == 1:
        return f"{texts[0]} per {per}."
    return "; ".join(f"{name}: {text}" for name, text in zip(names, texts, strict=True)) + "."


def column_names(group: Sequence[dict]) -> list[str]:
    """The method, after its stage of training if any, with eta where it is not 0 or where the method has several."""
    etas: dict[str, set[float]] = {}
    for row in group:
        etas.setdefault(row["method"], set()).add(row["eta"])
    names = []
    for row in group:
        stage = row.get("stage")
        before = "" if stage is None or stage in STAGES else f"{stage} "
        eta = f" η={row['eta']:g}" if row["eta"] or len(etas[row["method"]]) > 1 else ""
        names.append(f"{before}{row['method']}{eta}")
    return names


def heading(metric: Metric, points: bool = False) -> str:
    unit = ("points" if points else "%") if metric.fraction else metric.unit
    return f"{metric.name} [{unit}]" if unit else metric.name


def mean_cell(metric: Metric, row: dict) -> str:
    """Such as `12.3 [8.1, 16.4] (n)`, where n is left out if all rollouts count."""
    value = row["metrics"].get(metric.name)
    if not value or not value["n"]:
        return UNKNOWN
    return estimate(metric, value, "mean") + (f" ({value['n']})" if value["n"] != row["n_rollouts"] else "")


def difference_cell(metric: Metric, value: dict | None) -> str:
    """Such as `+2.1 [+0.4, +3.9]*`, with a star where the interval leaves out 0."""
    if not value or math.isnan(value["difference"]):
        return UNKNOWN
    return estimate(metric, value, "difference", "+") + ("*" if value["low"] > 0 or value["high"] < 0 else "")


def estimate(metric: Metric, value: dict, name: str, sign: str = "") -> str:
    """The value called `name` and, where it is known, its interval."""
    centre, low, high = (number(metric, value[key], sign) for key in (name, "low", "high"))
    return centre if math.isnan(value["low"]) else f"{centre} [{low}, {high}]"


def number(metric: Metric, value: float, sign: str = "") -> str:
    """The value with the metric's own number of `decimals`, if it declares one; sign: "+" to write it always.

    Without one, shares are in per cent with one decimal (two below one per cent), and others have three digits.
    """
    value = 100 * value if metric.fraction else value
    size, decimals = abs(value), metric.decimals
    if decimals is None and metric.fraction:
        decimals = 1 if size >= 1 or size == 0 else 2
    elif decimals is None:
        decimals = 0 if size >= 1000 else 1 if size >= 10 else 2 if size >= 1 or size == 0 else 3
    return f"{value:{sign}.{decimals}f}"


LATEX = {"\\": r"\textbackslash{}", "–": "--", "−": "$-$", "η": r"$\eta$", "²": "$^2$", "³": "$^3$", "≤": r"$\le$"}
LATEX |= {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {sign: rf"\{sign}" for sign in "&%$#_{}"}


def escaped(text: str) -> str:
    """The text for LaTeX."""
    return "".join(LATEX.get(sign, sign) for sign in text)


def save_tables(path: Path, tables: Sequence[Table]) -> None:
    """Write the tables into one markdown file, with a list of what each metric means."""
    parts = [*(table.markdown() for table in tables), f"```\n{legend()}\n```\n"]
    write_atomically(path, "\n".join(parts))


def read_tables(path: Path) -> list[Table]:
    """The tables of a file that `save_tables` wrote; a caption is one line. InputError where there is no such file, or
    where a table has no line under its head."""
    try:
        blocks = Path(path).read_text().split("\n\n")
    except (OSError, UnicodeError) as error:
        raise InputError(f"{path}: no tables ({error}); give the folder of a run that evaluate.py wrote") from error
    tables: list[Table] = []
    title = ""
    for block, caption in zip(blocks, [*blocks[1:], ""], strict=True):
        lines = block.strip().splitlines()
        if block.strip().startswith("## "):
            title = block.strip()[3:]
        elif lines and lines[0].startswith("| "):
            if len(lines) < 2:
                raise InputError(f"{path}: damaged at {lines[0][:60]!r}; run evaluate.py again to write it")
            head, _, *rows = [[cell.replace("&#124;", "|") for cell in row[2:-2].split(" | ")] for row in lines]
            tables.append(Table(caption.strip(), head, rows, title))
            title = ""
    return tables


def print_tables(tables: Sequence[Table]) -> None:
    for table in tables:
        print(f"\n{table.text()}")


def legend() -> str:
    """One line per metric: its name and what it means."""
    metrics = (*METRICS.values(), *(metric for stage in STAGES.values() for metric in stage))
    width = max(len(metric.name) for metric in metrics)
    return "\n".join(f"{metric.name.ljust(width)}  {metric.about}" for metric in metrics)
