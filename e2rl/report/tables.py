"""Tables of metrics from the rows of metrics.json, for a terminal, Markdown, LaTeX and
CSV. Fractions are in per cent.

A run has a table with a row for each metric and a column for each method, one with the
differences to the first, and one of its failure modes, from its modes.json.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tabulate import LATEX_ESCAPE_RULES, tabulate

from e2rl.metrics.catalogue import (
    METRICS,
    SPREAD_STAGE,
    STAGES,
    Metric,
    table_metrics,
)
from e2rl.metrics.failure_modes import LEAST, MANY
from e2rl.report.headline import plural
from e2rl.run.files import write_atomically
from e2rl.run.terminal import column_groups, terminal_width

UNKNOWN = "–"
COUNTED = {  # what the count (n) of a stage's cells counts, and how its metrics are computed
    SPREAD_STAGE: "(n) vehicles: others than the ego, faster than 1 m/s at the start; samples on one route each.",
}
MEANS = "Mean [95% interval, by location or scene]; (n) rollouts where fewer count."
PAIRED = "[95% interval], paired by (scene, seed); * the interval leaves out 0."
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
VERDICTS = {
    "preventable": "preventable",
    "counted": "counts",
    "at_fault": "at fault",
    "avoidable": "avoidable",
}
SPEEDS = {"ego_speed": "ego [m/s]", "partner_speed": "partner [m/s]"}


@dataclass
class Table:
    """A caption, column heads and rows of cells; the first column is text, the others
    are numbers. title: of the section that begins with the table."""

    caption: str
    head: list[str]
    rows: list[list[str]]
    title: str = ""

    def grid(self, kind: str) -> str:
        """Head and rows in a format of tabulate."""
        align = ["left"] + ["right"] * (len(self.head) - 1)
        return tabulate(
            self.rows, self.head, kind, disable_numparse=True, colalign=align
        )

    def text(self) -> str:
        """For a terminal: aligned columns, the caption above; columns that find no room
        stand beneath."""
        width = terminal_width()
        caption = textwrap.fill(self.caption, width)
        grids = [part.grid("simple") for part in self.parts(width)]
        return "\n".join(
            [*([self.title] if self.title else []), caption, "\n\n".join(grids)]
        )

    def parts(self, width: int) -> list["Table"]:
        """Returns tables of at most `width`: the first column, and as many of the
        others as fit, one at least."""
        widths = [
            max(map(len, cells)) for cells in zip(self.head, *self.rows, strict=True)
        ]
        return [
            Table("", *self._chosen(group)) for group in column_groups(widths, width)
        ]

    def _chosen(self, columns: Sequence[int]) -> tuple[list[str], list[list[str]]]:
        return [self.head[each] for each in columns], [
            [row[each] for each in columns] for row in self.rows
        ]

    def markdown(self) -> str:
        """A Markdown table, its caption beneath."""
        head, *rows = [
            [cell.replace("|", "&#124;") for cell in line]
            for line in (self.head, *self.rows)
        ]
        title = f"## {self.title}\n\n" if self.title else ""
        return f"{title}{Table('', head, rows).grid('pipe')}\n\n{self.caption}\n"

    def latex(self) -> str:
        """A table environment with a tabular of package booktabs."""
        grid = self.grid("latex_booktabs").translate(SYMBOLS)
        caption = escaped(self.caption)
        return f"\\begin{{table}}\n{grid}\n\\caption{{{caption}}}\n\\end{{table}}\n"


def escaped(text: str) -> str:
    """The text for LaTeX."""
    return "".join(LATEX_ESCAPE_RULES.get(sign, rows=sign) for sign in text).translate(
        SYMBOLS
    )


def metric_tables(
    rows: Sequence[dict], settings: str = "", table: str = "main"
) -> list[Table]:
    """Returns the tables of rows of metrics.json: for each data set, split and ego the
    means of each method, and their differences where there are several.

    Args:
        rows: of metrics.json; those of the stage `spread` have their own table and
            metrics.
        settings: text for every caption, such as the prior and its sampler.
        table: of the catalogue, whose metrics the closed-loop tables show; a caption
            names those that no row knows.
    """
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        stage = row.get("stage") if row.get("stage") in STAGES else None
        groups.setdefault((row["dataset"], row["split"], row["ego"], stage), []).append(
            row
        )
    tables = []
    for (*_, stage), group in groups.items():
        metrics = STAGES.get(stage, table_metrics(table))
        tables += [
            means_table(group, settings, metrics=metrics),
            paired_table(group, metrics),
        ]
    return [table for table in tables if table.rows]


def means_table(
    group: Sequence[dict], settings: str, metrics: Sequence[Metric]
) -> Table:
    """The mean and interval of each metric, with a column for each row of metrics.json."""
    known = known_metrics(group, metrics)
    names = column_names(group)
    unknown = [metric.name for metric in metrics if metric not in known]
    counted = COUNTED.get(group[0].get("stage", ""))
    caption = f"{origin(group[0])}. {counts(group, names)} "
    caption += f"{MEANS.partition(';')[0]}; {counted}" if counted else MEANS
    caption += f" {notes_on(group)}" if notes_on(group) else ""
    caption += f" {settings.rstrip('.')}." if settings else ""
    caption += f" Not computable here: {', '.join(unknown)}." if unknown else ""
    rows = [
        [heading(metric), *(mean_cell(metric, row) for row in group)]
        for metric in known
    ]
    return Table(caption, ["", *names], rows=rows)


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
    found = [
        (name, row["paired"].get(key))
        for name, row in zip(names, group, strict=True)
        for key in keys
    ]
    columns = {name: paired for name, paired in found if paired}
    cells = {
        heading(metric, points=True): [
            difference_cell(metric, paired.get(metric.name))
            for paired in columns.values()
        ]
        for metric in metrics
    }
    rows = [
        [name, *line]
        for name, line in cells.items()
        if any(cell != UNKNOWN for cell in line)
    ]
    return Table(
        f"{origin(first)}. Difference to {reference} {PAIRED}",
        ["", *columns],
        rows=rows,
    )


def known_metrics(group: Sequence[dict], metrics: Iterable[Metric]) -> list[Metric]:
    """The metrics that some row knows."""
    return [
        metric
        for metric in metrics
        if any(row["metrics"].get(metric.name, {}).get("n", 0) for row in group)
    ]


def closed_loop(rows: Sequence[dict]) -> list[dict]:
    """The rows of rollouts, without those of the stages that measure the prior."""
    return [row for row in rows if row.get("stage") not in STAGES]


def origin(row: dict) -> str:
    return f"{row['dataset']}/{row['split']}, ego {row['ego']}"


def counts(group: Sequence[dict], names: Sequence[str], per: str = "method") -> str:
    """Numbers of scenes, seeds and rollouts, and of rollouts without a score; once
    where all columns agree, else by column."""
    texts = []
    for row in group:
        numbers = {
            "scene": row["n_scenes"],
            "seed": row["n_seeds"],
            "rollout": row["n_rollouts"],
        }
        if row.get("n_trainings", 1) > 1:
            numbers["training"] = row["n_trainings"]
        failed = [
            f"{count} rollouts without a score ({reason})"
            for reason, count in row.get("errored", {}).items()
        ]
        texts.append(
            ", ".join([*(plural(n, word) for word, n in numbers.items()), *failed])
        )
    if len(set(texts)) == 1:
        return f"{texts[0]} per {per}."
    return (
        "; ".join(f"{name}: {text}" for name, text in zip(names, texts, strict=True))
        + "."
    )


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
            f"A rollout in which the planner raised (errored) is a failure in {', '.join(failures)}, has a progress of "
            "0, and is not in the denominators of the others; one that the traffic lost is in none."
        )
    if any(row.get("searched") for row in group):
        events = ", ".join(name for name, metric in METRICS.items() if metric.event)
        notes.append(
            f"Tries go where failures are, so their rates are none of the planner: {events} are of searches of a scene "
            "(n), in any of its tries; the other columns are of tries."
        )
    return " ".join(notes)


def column_names(group: Sequence[Mapping]) -> list[str]:
    """The method, after its stage of training if any, with eta where it is not 0 or
    where the method has several."""
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


# --- failure modes


def mode_tables(found: Mapping) -> list[Table]:
    """Returns a table of failure modes for each ego: a row for each mode, with its
    fraction of the failures of each method and intensity, verdicts and mean speeds; no
    table without failures.

    Of several egos the modes are common, and so are their verdicts and speeds.
    """
    egos = dict.fromkeys(group["ego_policy"] for group in found["groups"])
    return [
        table
        for ego in egos
        if (table := mode_table(found, ego, several=len(egos) > 1)).rows
    ]


def mode_table(found: Mapping, ego: str, several: bool) -> Table:
    """The table of one ego; several: there are other egos in the run."""
    chosen = [
        index
        for index, group in enumerate(found["groups"])
        if group["ego_policy"] == ego
    ]
    groups = [found["groups"][index] for index in chosen]
    known = {
        name: title
        for name, title in VERDICTS.items()
        if any(mode[name] is not None for mode in found["modes"])
    }
    rows = []
    failures = 0
    for mode in found["modes"]:
        if count := sum(mode["groups"][index]["count"] for index in chosen):
            failures += count
            fractions = [mode["groups"][index]["fraction"] for index in chosen] + [
                mode[name] for name in known
            ]
            name = (
                mode["name"]
                if mode["name"] == "other"
                else f"{mode['mode']}. {mode['name']}"
            )
            speeds = [
                UNKNOWN if mode[name] is None else f"{mode[name]:.1f}"
                for name in SPEEDS
            ]
            percent = [
                UNKNOWN if part is None else f"{100 * part:.0f}" for part in fractions
            ]
            rows.append([name, str(count), *percent, *speeds])
    if rows:
        cells = [
            f"{each['failures']} in {plural(each['modes'], 'mode')}" for each in groups
        ]
        rows.append(
            ["all failures", str(failures), *cells, *[""] * (len(known) + len(SPEEDS))]
        )
    columns = [*column_names(groups), *known.values()]
    head = ["", "failures", *(f"{name} [%]" for name in columns), *SPEEDS.values()]
    text = (
        f"Failure modes of {ego}: fraction of each method's collisions; verdicts and mean speeds just before contact, "
        f"of the mode's collisions{' with any ego' if several else ''}. Each word holds for two thirds of them; other: "
        f"modes of less than {LEAST:.0%}, or of one collision of {MANY} or more. `e2rl replay RUN_DIR --modes` draws a "
        "typical one of each."
    )
    if found["unknown"]:
        text += f" Grouped without {', '.join(found['unknown'])}, which the rollouts do not know."
    absent = [title for name, title in VERDICTS.items() if name not in known]
    return Table(
        text + (f" Not computable here: {', '.join(absent)}." if absent else ""),
        head,
        rows=rows,
    )


# --- cells


def heading(metric: Metric, points: bool = False) -> str:
    unit = ("points" if points else "%") if metric.fraction else metric.unit
    return f"{metric.name} [{unit}]" if unit else metric.name


def mean_cell(metric: Metric, row: dict) -> str:
    """Such as `12.3 [8.1, 16.4] (n)`, where n is left out if all rollouts count."""
    value = row["metrics"].get(metric.name)
    if not value or not value["n"]:
        return UNKNOWN
    return estimate(metric, value, name="mean") + (
        f" ({value['n']})" if value["n"] != row["n_rollouts"] else ""
    )


def difference_cell(metric: Metric, value: dict | None) -> str:
    """Such as `+2.1 [+0.4, +3.9]*`, with a star where the interval leaves out 0, but
    for costs of the computation."""
    if not value or math.isnan(value["difference"]):
        return UNKNOWN
    certain = not metric.cost and (value["low"] > 0 or value["high"] < 0)
    return estimate(metric, value, name="difference", sign="+") + (
        "*" if certain else ""
    )


def estimate(metric: Metric, value: dict, name: str, sign: str = "") -> str:
    """The value called `name` and, where it is known and no point, its interval."""
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
    value = 100 * value if metric.fraction else value
    size = abs(value)
    decimals = metric.decimals
    if decimals is None and metric.fraction:
        decimals = 1 if size >= 1 or size == 0 else 2
    elif decimals is None:
        decimals = (
            0
            if size >= 1000
            else 1
            if size >= 10
            else 2
            if size >= 1 or size == 0
            else 3
        )
    return f"{value:{sign}.{decimals}f}"


# --- files


def save_tables(path: Path, tables: Sequence[Table]) -> None:
    """Write the tables into one Markdown file, with a list of what each metric means."""
    write_atomically(
        path,
        "\n".join([*(table.markdown() for table in tables), f"```\n{legend()}\n```\n"]),
    )


def print_tables(tables: Sequence[Table]) -> None:
    for table in tables:
        print(f"\n{table.text()}")


def legend() -> str:
    """One line per metric: its name and what it means."""
    metrics = (
        *METRICS.values(),
        *(metric for stage in STAGES.values() for metric in stage),
    )
    width = max(len(metric.name) for metric in metrics)
    return "\n".join(
        f"{metric.name.ljust(width)}  {metric.about}" for metric in metrics
    )
