"""Metric tables from the rows of metrics.json: printed, and saved as markdown. Shares are in per cent.

One table per (dataset, split, ego): metrics down, methods across, then each method's paired difference to the first.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from e2rl.files import write_atomically
from e2rl.metrics.catalogue import META_STAGE, METRICS, OPEN_LOOP_STAGE, STAGES, Metric, table_metrics

RESTS_ON = {
    OPEN_LOOP_STAGE: "(n) vehicles: others than the ego, faster than 0.5 m/s in the log at the start, recorded "
    "throughout the horizon; causal start states, a route drawn per sample; samples without acceleration bounds.",
    META_STAGE: "(n) scenes. Likelihood of the log under each vehicle's histogram over all rollouts and steps; "
    "vehicles recorded throughout. A deterministic method's rollout stands for all.",
}


@dataclass
class Table:
    """A caption, column heads and rows of cells; the first column is text, the others are numbers."""

    caption: str
    head: list[str]
    rows: list[list[str]] = field(default_factory=list)

    def text(self) -> str:
        """For a terminal: aligned columns, the caption above."""
        widths = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)]

        def line(cells: list[str]) -> str:
            aligned = [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
            return "  ".join([cells[0].ljust(widths[0]), *aligned]).rstrip()

        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        caption = textwrap.fill(self.caption, max(len(rule), 60))
        return "\n".join([caption, rule, line(self.head), rule, *map(line, self.rows), rule])

    def markdown(self) -> str:
        """A markdown table, its caption beneath."""

        def line(cells: list[str]) -> str:
            return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"

        align = "| --- |" + " ---: |" * (len(self.head) - 1)
        return "\n".join([line(self.head), align, *map(line, self.rows), "", self.caption, ""])


def metric_tables(rows: Sequence[dict], settings: str = "", table: str = "main") -> list[Table]:
    """Tables of rows as in metrics.json. `settings` (prior, samples, bounds, ...) joins every caption.

    table: of `catalogue.TABLES`, whose metrics the closed-loop tables show; those that no column knows are left out and
    named in the caption. Rows of the stages `open loop` and `meta-metric` have tables and metrics of their own.
    """
    groups: dict[tuple, list[dict]] = {}
    metrics = table_metrics(table)
    for row in rows:
        stage = row.get("stage") if row.get("stage") in STAGES else None
        groups.setdefault((row["dataset"], row["split"], row["ego"], stage), []).append(row)
    tables = []
    for (*_, stage), group in groups.items():
        tables.append(means_table(group, settings, STAGES.get(stage, metrics)))
        if len(group) > 1:
            tables.append(paired_table(group, metrics))
    return [table for table in tables if table.rows]


def means_table(group: Sequence[dict], settings: str, metrics: Sequence[Metric]) -> Table:
    """Mean [95% interval] of each metric, one column per row of metrics.json."""

    def known(metric: Metric) -> bool:
        return any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)

    names = column_names(group)
    rests_on = RESTS_ON.get(group[0].get("stage"), "(n) rollouts where fewer count.")
    caption = f"{place(group[0])}. {counts(group, names)} "
    caption += f"Mean [95% interval, bootstrap by location or scene]; {rests_on}"
    unknown = [metric.name for metric in metrics if not known(metric)]
    caption += f" {settings.rstrip('.')}." if settings else ""
    caption += f" Not computable here: {', '.join(unknown)}." if unknown else ""
    body = [[heading(metric), *(mean_cell(metric, row) for row in group)] for metric in metrics if known(metric)]
    return Table(caption, ["", *names], body)


def paired_table(group: Sequence[dict], metrics: Sequence[Metric]) -> Table:
    """Differences of every method to the first one over the same (scene, seed), per cent points for shares; where rows
    have stages, of each method after training to the same method before.
    """
    first, names = group[0], column_names(group)
    reference = names[0]
    if any(row.get("stage") == "after" for row in group):
        reference = "before"
        columns = [(name, row["paired"].get("before")) for name, row in zip(names, group, strict=True)]
    else:
        columns = [(name, difference_to(row, first, group)) for name, row in zip(names[1:], group[1:], strict=True)]
    columns = [(name, paired) for name, paired in columns if paired]
    body = [
        [heading(metric, points=True), *(difference_cell(metric, paired.get(metric.name)) for _, paired in columns)]
        for metric in metrics
        if any(not math.isnan(paired[metric.name]["difference"]) for _, paired in columns if metric.name in paired)
    ]
    caption = (
        f"{place(first)}. Difference to {reference} [95% interval], paired by (scene, seed); * the interval "
        "leaves out 0."
    )
    return Table(caption, ["", *(name for name, _ in columns)], body if columns else [])


def difference_to(row: dict, first: dict, group: Sequence[dict]) -> dict | None:
    """The row's paired block that compares it with `first`, under the name that evaluation.summary gives it."""
    several = len({other["eta"] for other in group if other["method"] == first["method"]}) > 1
    return row["paired"].get(f"{first['method']}@{first['eta']:g}" if several else first["method"])


def place(row: dict) -> str:
    return f"{row['dataset']}/{row['split']}, ego {row['ego']}"


def counts(group: Sequence[dict], names: Sequence[str]) -> str:
    """Scenes, seeds, rollouts: once if all columns agree, else per column."""
    words = ("scene", "seed", "rollout")
    texts = [
        ", ".join(f"{row[f'n_{word}s']} {word}{'' if row[f'n_{word}s'] == 1 else 's'}" for word in words)
        for row in group
    ]
    if len(set(texts)) == 1:
        return f"{texts[0]} per method."
    return "; ".join(f"{name}: {text}" for name, text in zip(names, texts, strict=True)) + "."


def column_names(group: Sequence[dict]) -> list[str]:
    """method, with eta where it is not 0 or the method has several, and the stage where there is one."""
    several = {
        row["method"]
        for row in group
        if any(other["method"] == row["method"] and other["eta"] != row["eta"] for other in group)
    }
    return [
        " ".join(
            filter(
                None,
                (
                    "" if row.get("stage") in STAGES else str(row.get("stage", "")),
                    row["method"],
                    f"η={row['eta']:g}" if row["eta"] or row["method"] in several else "",
                ),
            )
        )
        for row in group
    ]


def heading(metric: Metric, points: bool = False) -> str:
    unit = ("points" if points else "%") if metric.share else metric.unit
    return f"{metric.name} [{unit}]" if unit else metric.name


def mean_cell(metric: Metric, row: dict) -> str:
    """'12.3 [8.1, 16.4] (n)': n only where it is not all rollouts; '–' where nothing is known."""
    value = row["metrics"].get(metric.name)
    if not value or not value["n"]:
        return "–"
    count = f" ({value['n']})" if value["n"] != row["n_rollouts"] else ""
    return number(metric, value["mean"]) + bounds(metric, value) + count


def difference_cell(metric: Metric, value: dict | None) -> str:
    if not value or math.isnan(value["difference"]):
        return "–"
    clear = value["low"] > 0 or value["high"] < 0
    return (
        number(metric, value["difference"], signed=True) + bounds(metric, value, signed=True) + ("*" if clear else "")
    )


def bounds(metric: Metric, value: dict, signed: bool = False) -> str:
    if math.isnan(value["low"]):
        return ""
    return f" [{number(metric, value['low'], signed)}, {number(metric, value['high'], signed)}]"


def number(metric: Metric, value: float, signed: bool = False) -> str:
    """Three significant digits, shares in per cent with one decimal (two below one per cent)."""
    value = 100 * value if metric.share else value
    sign = "+" if signed else ""
    if metric.share:
        return f"{value:{sign}.1f}" if abs(value) >= 1 or value == 0 else f"{value:{sign}.2f}"
    magnitude, decimals = abs(value), metric.decimals
    if decimals is None:
        decimals = 0 if magnitude >= 1000 else 1 if magnitude >= 10 else 2 if magnitude >= 1 or value == 0 else 3
    return f"{value:{sign}.{decimals}f}"


def save_tables(path: Path, tables: Sequence[Table]) -> None:
    """Write the tables into one markdown file, whole, with what each metric says below them."""
    parts = [*(table.markdown() for table in tables), f"```\n{legend()}\n```\n"]
    write_atomically(Path(path), "\n".join(parts))


def print_tables(tables: Sequence[Table]) -> None:
    for table in tables:
        print(f"\n{table.text()}")


def legend() -> str:
    """One line per metric: its name and what it says."""
    metrics = (*METRICS.values(), *(metric for stage in STAGES.values() for metric in stage))
    width = max(len(metric.name) for metric in metrics)
    return "\n".join(f"{metric.name.ljust(width)}  {metric.about}" for metric in metrics)
