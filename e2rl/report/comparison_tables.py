"""Tables that compare methods or egos: a row each, with their differences to some of
them (tables 1 and 4); in how many scenes searches have failed each ego; and whether an
ego that was trained still drives as it should."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from e2rl.evaluation.ego_set import EgoSet
from e2rl.evaluation.summary import scene_rows
from e2rl.metrics.catalogue import METRICS, table_metrics
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.report.tables import (
    MEANS,
    PAIRED,
    UNKNOWN,
    Table,
    closed_loop,
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

EVENTS = ("cfr_preventable", "cfr_counted", "cfr")  # of scenes
METHODS, EGOS = "methods", "egos"  # tables of the catalogue, and names of the files
Terms = Mapping[
    str, tuple[str, str]
]  # by method: what it knows of the ego and owes it, "" for nothing to say
TRAININGS = (
    "An ego of several trainings is their pool: the intervals draw trainings as well as places, with replacement, and "
    "with few trainings are too narrow rather than too wide."
)
SEARCHED = (
    "Scenes with a try that ends in a contact (`cfr`), in one that counts, in a preventable one, or in which the "
    "planner raised. Each search of a scene counts once. 95% intervals by place and, of several trainings of one "
    "policy, by training. Differences are of the same scenes; a star: the interval leaves out 0."
)
UP, PROGRESS, ROUGHNESS = (
    0.01,
    0.97,
    1.25,
)  # fraction of rollouts; of the planner's; of the recorded egos'


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
    group = closed_loop(rows)
    names = column_names(group)
    known = [
        [term or UNKNOWN for term in terms.get(row["method"], ("", ""))]
        for row in group
    ]
    labels = [[name, *cells] for name, cells in zip(names, known, strict=True)]
    text = f"{origin(group[0])}. {counts(group, names)}"
    note = f"{MEANS} Knowledge: the ego's plan, or its motion predicted; duty: what adversaries owe the ego. {settings}"
    difference = f"{text} Difference of each method to {' and to '.join(references)}"
    head = ["method", "knowledge", "duty"]
    keys = {name: name for name in references}
    return tables_of(
        group,
        labels,
        head=head,
        table=table,
        title="Methods",
        caption=f"{text} {note}",
        difference=difference,
        references=keys,
    )


def planner_tables(
    rows: Sequence[dict],
    names: Sequence[str],
    references: Collection[str],
    settings: str = "",
    table: str = EGOS,
) -> list[Table]:
    """Returns the same with a row for each ego of `names` and each traffic and
    intensity, and differences to the egos `references` in the same traffic, as far as
    the rows are paired with them."""
    cells, _ = by_ego(closed_loop(rows), names)
    group = list(cells.values())
    labels = [list(key) for key in cells]
    text = f"{group[0]['dataset']}/{group[0]['split']}. "
    text += counts(
        group,
        [f"{ego} under {traffic}" for ego, traffic in labels],
        per="ego and traffic",
    )
    difference = f"{text} Difference of each ego to {' and to '.join(references)} in the same traffic"
    pooled = (
        f" {TRAININGS}" if any(row.get("n_trainings", 1) > 1 for row in group) else ""
    )
    caption = f"{text} {MEANS}{pooled} {settings}"
    keys = {name: f"ego {name}" for name in references}
    return tables_of(
        group,
        labels,
        head=["ego", "traffic"],
        table=table,
        title="Egos",
        caption=caption,
        difference=difference,
        references=keys,
    )


def tables_of(
    group: Sequence[dict],
    labels: Sequence[list[str]],
    head: list[str],
    table: str,
    title: str,
    caption: str,
    difference: str,
    references: Mapping[str, str],
) -> list[Table]:
    """The table of means of rows of metrics.json, which begin with `labels` under
    `head`, then that of differences to the `references` {name: its key in a row's
    `paired`} where there are some."""
    metrics = known_metrics(group, table_metrics(table))
    labelled = list(zip(labels, group, strict=True))
    means = [
        [*cells, *(mean_cell(metric, row) for metric in metrics)]
        for cells, row in labelled
    ]
    caption = " ".join(
        filter(None, (f"{caption.strip().rstrip('.')}.", notes_on(group)))
    )
    found = [Table(caption, [*head, *map(heading, metrics)], rows=means, title=title)]
    pairs = [
        [
            *cells,
            name,
            *(
                difference_cell(metric, row["paired"][key].get(metric.name))
                for metric in metrics
            ),
        ]
        for name, key in references.items()
        for cells, row in labelled
        if key in row["paired"]
    ]
    heads = [*head, "minus", *(heading(metric, points=True) for metric in metrics)]
    return (
        [*found, Table(f"{difference} {PAIRED}", heads, rows=pairs)] if pairs else found
    )


def save_compared(folder: Path, tables: Sequence[Table], name: str = METHODS) -> None:
    """Write the tables into one file of Markdown and one of LaTeX, both called `name`,
    and into a CSV file each: `name` and `name`_differences."""
    write_atomically(
        folder / f"{name}.md", "\n".join(table.markdown() for table in tables)
    )
    write_atomically(
        folder / f"{name}.tex", "\n".join(table.latex() for table in tables)
    )
    for table, suffix in zip(tables, ("", "_differences"), strict=False):
        write_atomically(
            folder / f"{name}{suffix}.csv", csv_text([table.head, *table.rows])
        )


# --- egos side by side


def by_ego(
    rows: Sequence[dict], names: Sequence[str]
) -> tuple[dict[tuple[str, str], dict], list[str]]:
    """({(ego, traffic): row}, names of traffic and intensity) of the closed-loop rows
    of the egos `names`."""
    cells: dict[tuple[str, str], dict] = {}
    for name in names:
        group = [row for row in rows if row["ego"] == name and row.get("stage") is None]
        cells |= {
            (name, label): row
            for label, row in zip(column_names(group), group, strict=True)
        }
    return cells, list(dict.fromkeys(label for _, label in cells))


def searched_table(rows: Sequence[Mapping], egos: EgoSet) -> Table:
    """Returns in how many scenes searches have failed each ego, from the rows of all
    tries: EVENTS of scenes, and differences to the ego that all are compared with, in
    points and relative to it.

    Tries of different egos are no pairs, since a search goes on by what it has found;
    scenes with equal budgets are.
    """
    every = scene_rows(rows)
    others = {first: second for first, second in reversed(egos.pairs)}
    lines = []
    for row in egos.metric_rows(every, [NO_SAMPLES] * len(every)):
        pair = row["paired"].get(f"ego {others.get(row['ego'])}", {})
        several = f" ({row['n_trainings']} trainings)" if "n_trainings" in row else ""
        cells = [mean_cell(METRICS[name], row) for name in EVENTS]
        cells += [difference_cell(METRICS[name], pair.get(name)) for name in EVENTS]
        lines.append(
            [
                f"{row['ego']}{several}, {row['method']}",
                *cells,
                relative_cell(pair.get(EVENTS[0])),
            ]
        )
    (reference,) = set(others.values()) or {""}
    head = [
        "ego",
        *(f"{name} [%]" for name in EVENTS),
        *(f"{name} minus {reference}" for name in EVENTS),
    ]
    head.append(f"{EVENTS[0]} relative to {reference} [%]")
    return Table(SEARCHED, head, rows=lines, title="Scenes in which each ego fails")


def relative_cell(value: dict | None) -> str:
    """Such as `-31 [-42, -17]*`, per cent; the interval is unknown where a draw has
    nothing to divide by."""
    if not value or not math.isfinite(value["relative"]):
        return UNKNOWN
    centre, low, high = (
        100 * value[name] for name in ("relative", "relative_low", "relative_high")
    )
    if math.isnan(low):
        return f"{centre:+.0f}"
    return f"{centre:+.0f} [{low:+.0f}, {high:+.0f}]" + (
        "*" if low > 0 or high < 0 else ""
    )


def guard_table(
    rows: Sequence[dict], before: str, after: str, planner: str, recorded: float
) -> Table:
    """Returns whether `after` still drives well in nominal traffic: each guard with its
    limit, what was found, and whether it is met. Estimates decide; intervals stand
    beside them.

    recorded: mean |acceleration| [m/s^2] of the recorded egos.
    """
    row = by_ego(rows, [after])[0][after, "nominal"]
    lines = []
    for name, other, most in (
        ("cfr", before, UP),
        ("cfr", planner, 0.0),
        ("ego_off_road", before, 0.0),
    ):
        metric = METRICS[name]
        paired = row["paired"][f"ego {other}"][name]
        found = difference_cell(metric, paired), verdict(paired["difference"], most)
        lines.append([f"{name} over {other} [points]", f"≤ {100 * most:.0f}", *found])
    progress = row["paired"][f"ego {planner}"]["progress"]
    ceiling = ROUGHNESS * recorded
    found = relative_cell(progress), verdict(-progress["relative"], 1 - PROGRESS)
    smooth = (
        mean_cell(METRICS["macc"], row),
        verdict(row["metrics"]["macc"]["mean"], ceiling),
    )
    lines[2:2] = [
        [f"progress against {planner} [%]", f"≥ {100 * (PROGRESS - 1):.0f}", *found],
        [f"macc [m/s²], recorded egos: {recorded:.2f}", f"≤ {ceiling:.2f}", *smooth],
    ]
    text = f"Guards of {after}, in nominal traffic: what must not be given up for fewer collisions. The estimate "
    text += "decides, the 95% interval stands beside it; differences are paired by (scene, seed)."
    return Table(text, ["", "limit", "found", ""], rows=lines)


def verdict(value: float, most: float) -> str:
    """met, missed, or unknown."""
    return (
        UNKNOWN if math.isnan(value) else "met" if value <= most + 1e-12 else "missed"
    )
