"""The answer of a run: the last lines on the terminal, in sentences, at most 25 of them
and at most 100 columns wide.

It reads the rows of metrics.json, and the contents of modes.json and atlas.json, and
computes nothing.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from tabulate import tabulate

from e2rl.evaluation.check import SEARCH
from e2rl.evaluation.modes import OTHER
from e2rl.evaluation.rollout_files import ATLAS_FILE, ERRORED_FILE
from e2rl.metrics.atlas import CELL
from e2rl.metrics.catalogue import METRICS
from e2rl.report.comparison_tables import by_ego
from e2rl.report.headline import (
    errored_lines,
    plural,
    row_headline,
    touched_lines,
    traffic_name,
    unit_of,
)
from e2rl.report.tables import UNKNOWN, number
from e2rl.run.terminal import column_groups, terminal_width

LINES = 25
WEAKNESSES = 3  # lines of failure modes
MOST_ROWS = 10  # of a comparison
MOST_CELLS = 7  # of an atlas
HEADLINES = 3  # of traffic and egos
KINDS = {  # of failures, the first leads
    "preventable": "cfr_preventable",
    "clean": "cfr_clean",
    "count": "cfr_counted",
}
PER_DISTANCE = "count per 1,000 km"
COLUMNS = {  # of a comparison
    "hit": "cfr",
    **KINDS,
    "realism": "real",
    PER_DISTANCE: "counted_per_km",
}
CHANGES = {  # rows of the comparison of before and after
    "hit": "cfr",
    "preventable": "cfr_preventable",
    "count": "cfr_counted",
    "progress [m]": "progress",
    "clean": "cfr_clean",
    PER_DISTANCE: "counted_per_km",
}
OTHERS = {"people touched": "cfr_vru", "objects touched": "cfr_object"}
COUNTS = (
    "preventable: a careful and competent driver would have had none; clean: besides, "
    "nobody else did wrong; count: preventable, or the ego's fault."
)
FEW = "No intervals: they need scenes of at least ten places."


def answer_lines(
    rows: Sequence[dict],
    modes: Mapping | None = None,
    folder: Path | None = None,
    report: Path | None = None,
    notes: Sequence[str] = (),
    rollouts: Sequence[dict] = (),
) -> list[str]:
    """Returns the lines that say what an evaluation found: the headline of each traffic
    first.

    Then a table with a row for each ego, method and intensity.

    Args:
        rows: of metrics.json.
        modes: the content of modes.json; without it no weaknesses are named.
        folder: of the run, which holds tables.md.
        report: the failure report, where one was written.
        notes: further lines, such as the scenes that were left out.
        rollouts: of rollouts.csv, of which those that errored, or touched people or
            objects, are named.
    """
    driven = [row for row in rows if row["n_rollouts"]]
    driven.sort(key=lambda row: not row["eta"])  # attacks before nominal traffic
    texts = list(map(row_headline, driven[:HEADLINES]))
    texts += errored_lines(rollouts)
    texts += touched_lines(rollouts, shown=report is not None)
    lines = paragraphs(texts)
    if driven:
        lines += comparison(driven)
    if modes and driven:
        lines += weaknesses(modes)
    last = closing(rows, folder, report=report, notes=notes)
    return [*lines[: LINES - len(last)], *last]


def compared_answer(
    before: Sequence[dict],
    after: Sequence[dict],
    atlases: tuple[Mapping, Mapping] | None = None,
    folder: Path | None = None,
) -> list[str]:
    """Returns the lines that say what training changed: the ego before and after it,
    side by side.

    Args:
        before: rows of metrics.json of the stage `before`.
        after: rows of the stage `after`, which are paired with those before under the
            name `before`.
        atlases: of both stages (`evaluation.modes.group_atlas`); None: nothing was
            searched for.
        folder: of the run, which holds tables.md.
    """
    earlier = {(row["method"], row["eta"]): row for row in before}
    pairs = [
        (earlier[row["method"], row["eta"]], row)
        for row in after
        if (row["method"], row["eta"]) in earlier
    ]
    last = closing(after, folder)
    lines = atlas_lines(before=atlases[0], after=atlases[1]) if atlases else []
    if pairs:
        last = wrapped(COUNTS) + last
        metrics = CHANGES | {
            title: name
            for title, name in OTHERS.items()
            if any(tally(row, name) for row in (*before, *after))
        }
        if atlases:  # which leave room for the traffic at the ends
            strongest = max(new["eta"] for _, new in pairs)
            pairs = [pair for pair in pairs if pair[1]["eta"] in (0, strongest)]
        table = [["", "before", "after", "difference"]]
        for title, name in metrics.items():
            for old, new in pairs:
                label = f"{title}, {traffic_name(new)}"
                table.append(
                    [label, cell(old, name), cell(new, name), difference(new, name)]
                )
        lines += columns(table[: max(2, LINES - len(lines) - len(last))])
    return [*lines[: LINES - len(last)], *last]


def atlas_lines(before: Mapping, after: Mapping) -> list[str]:
    """The cells of two atlases with their numbers of scenes, those of most scenes
    before first."""
    old, new = (
        {tuple(cell[name] for name in CELL): cell["scenes"] for cell in atlas["atlas"]}
        for atlas in (before, after)
    )
    cells = sorted(
        {*old, *new}, key=lambda cell: (-old.get(cell, 0), -new.get(cell, 0), cell)
    )
    failed = [
        f"{atlas['failed_scenes']} of {plural(atlas['scenes'], 'scene')}"
        for atlas in (before, after)
    ]
    gone = sum(1 for cell in cells if not new.get(cell))
    added = sum(1 for cell in cells if not old.get(cell))
    lines = wrapped(
        f"A search finds preventable failures in {failed[0]} before training, in "
        f"{plural(before['cells'], 'way')}, and in {failed[1]} after it, in "
        f"{plural(after['cells'], 'way')}: {gone} are gone, {added} are new.",
    )
    rows = [
        [", ".join(filter(None, cell)), str(old.get(cell, 0)), str(new.get(cell, 0))]
        for cell in cells[:MOST_CELLS]
    ]
    if rows:
        lines += columns([["scenes that fail so", "before", "after"], *rows])
    if len(cells) > MOST_CELLS:
        rest = len(cells) - MOST_CELLS
        lines.append(f"... and {rest} more in {{before,after}}/{SEARCH}/{ATLAS_FILE}")
    return lines


# --- egos, methods and intensities


def under(row: dict) -> str:
    """Such as `attacked by e2 at η=2` or `in nominal traffic`."""
    if row["eta"]:
        return f"attacked by {traffic_name(row)}"
    return f"in {row['method']} traffic"


def comparison(rows: Sequence[dict]) -> list[str]:
    """A table with a row for each ego, method and intensity. Methods: those that find
    most preventable failures first, of equals most clean ones, then most that count,
    then most contacts. Egos: in each traffic, the strongest first, the one with the
    fewest first. Unknown rates come last."""
    egos = list(dict.fromkeys(row["ego"] for row in rows))
    cells = by_ego(rows, egos)
    labels = [label for _, label in cells]
    several = len(egos) > 1

    def rank(key: tuple[str, str]) -> tuple:
        row = cells[key]
        rates = []
        for name in (*KINDS.values(), "cfr"):
            mean = row["metrics"].get(name, {}).get("mean", math.nan)
            rates.append(math.inf if math.isnan(mean) else mean if several else -mean)
        if several:
            return -row["eta"], labels.index(key[1]), rates
        return not row["eta"], rates, row["eta"]

    ranked = sorted(cells, key=rank)
    ego, traffic = ranked[0]
    first = cells[ranked[0]]
    raised = tally(first, "errored")
    hits = f"{'hit or raised' if raised else 'hit'} in {share(first, 'cfr')}"
    hits += f" {unit_of(first)}"
    if several:
        lead = f"{ego} fails least: it {'' if raised else 'was '}{hits} {under(first)}"
    else:
        fails = first["metrics"]["cfr"]["mean"]
        most = "fails most" if fails else "does not fail, not even"
        lead = f"{ego} {most} in the traffic of {traffic}: {hits}"
    preventable, clean, counted = (
        f"{share(first, name).partition(' ')[0]} {kind}" for kind, name in KINDS.items()
    )
    lead += f", of them {preventable}, {clean}; {counted}."
    shown = {
        title: name
        for title, name in COLUMNS.items()
        if any(value(row, name) != UNKNOWN for row in rows)
    }
    table = [["ego", "traffic", *shown]]
    for key in ranked[:MOST_ROWS]:
        table.append([*key, *(cell(cells[key], name) for name in shown.values())])
    lines = wrapped(lead)
    lines += columns(table if several else [line[1:] for line in table])
    if len(ranked) > MOST_ROWS:
        lines.append(f"... and {len(ranked) - MOST_ROWS} more in tables.md")
    text = COUNTS
    without = sum(tally(row, "errored") for row in cells.values())
    if without and PER_DISTANCE in shown:
        text += (
            f" Rates per 1,000 km are without {plural(without, 'rollout')} in which "
        )
        text += "a planner raised."
    return lines + wrapped(text)


# --- weaknesses, and what was measured


def weaknesses(modes: Mapping) -> list[str]:
    """The failure modes with the most failures that count, a line each; where none
    counts, the most frequent ones.

    They are of the attacks, where there are any, and not of nominal traffic.
    """
    groups = modes["groups"]
    places = [place for place, group in enumerate(groups) if group["eta"]]
    places = places or list(range(len(groups)))
    total = sum(groups[place]["failures"] for place in places)
    if not total:
        return []
    ranks = {}
    for mode in modes["modes"]:
        count, counted = (
            sum(mode["groups"][place][name] for place in places)
            for name in ("count", "counted")
        )
        ranks[mode["mode"]] = (-counted, -count, mode["mode"])
    any_counts = any(counted for counted, *_ in ranks.values())
    named = [
        mode
        for mode in modes["modes"]
        if mode["mode"] != OTHER and ranks[mode["mode"]][0 if any_counts else 1]
    ]
    if not named:
        counted = -sum(rank[0] for rank in ranks.values())
        return wrapped(
            f"No weakness stands out: {counted} failures that count are each of "
            "another kind.",
        )
    order = "most failures that count first"
    lines = [
        f"Weaknesses, {order if any_counts else 'although none of the failures counts'}:"
    ]
    named.sort(key=lambda mode: ranks[mode["mode"]])
    for place, mode in enumerate(named[:WEAKNESSES], 1):
        counted, count, _ = ranks[mode["mode"]]
        text = f"{place}. {mode['name']} ({-count} of {plural(total, 'failure')}"
        text += f", {-counted} count)" if any_counts else ")"
        lines += wrapped(text, indent="   ")
    return lines


def closing(
    rows: Sequence[dict],
    folder: Path | None,
    report: Path | None = None,
    notes: Sequence[str] = (),
) -> list[str]:
    """The last lines: what the numbers rest on, and where everything lies.

    Args:
        rows: of metrics.json.
        folder: of the run, which holds tables.md; None: it is not named.
        report: the failure report, where one was written.
        notes: further lines, before all others.

    Returns:
        Lines of the terminal's width, but for paths.
    """
    lines = paragraphs([*notes, measured(rows)], indent="")
    if report:
        lines.append(f"Watch every failure: {report}")
    if folder:
        lines.append(f"All metrics, with intervals: {folder / 'tables.md'}")
    return lines


def measured(rows: Sequence[dict]) -> str:
    """Where the numbers come from, and what they lack."""
    if not rows:
        return "No rollout was scored."
    first = max(rows, key=lambda row: row["n_rollouts"])
    text = (
        f"Measured: {first['dataset']}/{first['split']}, "
        f"{plural(first['n_scenes'], 'scene')}, {plural(first['n_seeds'], 'seed')}"
    )
    attacks = {traffic_name(row) for row in rows if row["eta"]}
    if len(attacks) == 1:
        text += f"; attack: {attacks.pop()}"
    text += "."
    rates = [row["metrics"]["cfr"] for row in rows if "cfr" in row["metrics"]]
    if rates and all(math.isnan(hits["low"]) for hits in rates):
        text += f" {FEW}"
    errored = sum(count for row in rows for count in row.get("errored", {}).values())
    if errored:
        text += f" {plural(errored, 'rollout')} without a score: see {ERRORED_FILE}."
    return text


# --- cells


def tally(row: dict, name: str) -> int:
    """How many rollouts a rate stands for."""
    estimate = row["metrics"].get(name)
    if not estimate or math.isnan(estimate["mean"]):
        return 0
    return round(estimate["mean"] * estimate["n"])


def share(row: dict, name: str) -> str:
    """Such as `3 of 12`."""
    estimate = row["metrics"].get(name)
    if not estimate or not estimate["n"]:
        return UNKNOWN
    return f"{tally(row, name)} of {estimate['n']}"


def rate(row: dict, name: str) -> str:
    """Such as `25%, 95% interval 9 to 53%`."""
    mean, low, high = (
        per_cent(row["metrics"][name][end]) for end in ("mean", "low", "high")
    )
    if math.isnan(row["metrics"][name]["low"]):
        return mean
    return f"{mean}, 95% interval {low[:-1]} to {high}"


def cell(row: dict, name: str) -> str:
    """Such as `25% (3 of 12)` for a rate of rollouts, else `value`."""
    if not METRICS[name].fraction or share(row, name) == UNKNOWN:
        return value(row, name)
    return f"{per_cent(row['metrics'][name]['mean'])} ({share(row, name)})"


def difference(row: dict, name: str) -> str:
    """The paired difference to `before`, such as `-20 [-28, -12]`: points of per cent,
    or rates per 1,000 km."""
    change = (row["paired"].get("before") or {}).get(name)
    metric = METRICS[name]
    if not change or math.isnan(change["difference"]):
        return UNKNOWN
    scale = 100 if metric.fraction else 1000 if metric.per else 1
    middle, low, high = (
        f"{scale * change[end]:+,.0f}" for end in ("difference", "low", "high")
    )
    return middle if math.isnan(change["low"]) else f"{middle} [{low}, {high}]"


def value(row: dict, name: str) -> str:
    """The mean of a metric as the tables print it; a rate of metres or kilometres per
    1,000 of them."""
    estimate = row["metrics"].get(name)
    if not estimate or not estimate["n"] or math.isnan(estimate["mean"]):
        return UNKNOWN
    if METRICS[name].per:
        return f"{1000 * estimate['mean']:,.0f}"
    return number(METRICS[name], estimate["mean"])


def per_cent(fraction: float) -> str:
    """Such as `25%`; one decimal below 10%."""
    decimals = 0 if fraction in (0, 1) or fraction >= 0.1 else 1
    return f"{100 * fraction:.{decimals}f}%"


def wrapped(text: str, indent: str = "") -> list[str]:
    """The text in lines of the terminal's width, the second and later ones indented."""
    return textwrap.wrap(
        text.strip(), terminal_width(), subsequent_indent=indent, break_on_hyphens=False
    )


def paragraphs(texts: Iterable[str], indent: str = "  ") -> list[str]:
    """The lines of several texts."""
    return [line for text in texts for line in wrapped(text, indent)]


def columns(table: Sequence[Sequence[str]]) -> list[str]:
    """Returns aligned rows of text that fit the terminal; table: the heads, which may
    be wrapped, then rows.

    Columns that find no room stand beneath, beside the first column again, which is cut
    where it is too wide.
    """
    width = terminal_width()
    head, *rows = table
    sizes = [
        max(map(len, [*title.split(), *(row[column] for row in rows)]), default=0)
        for column, title in enumerate(head)
    ]
    room = width - sum(sizes[1:]) - 2 * (len(sizes) - 1)
    sizes[0] = min(sizes[0], max(width // 3, room))
    lines: list[str] = []
    for group in column_groups(sizes, width):
        body: list[list[str]] = []
        heads = [textwrap.wrap(head[column], sizes[column]) for column in group]
        height = max(map(len, heads))
        for line in range(-height, 0):
            body.append([title[line] if -line <= len(title) else "" for title in heads])
        for row in rows:
            body.append([row[column] for column in group])
            if len(row[0]) > sizes[0]:
                body[-1][0] = f"{row[0][: sizes[0] - 1]}…"
        align = ["left"] + ["right"] * (len(group) - 1)
        text = tabulate(body, tablefmt="plain", disable_numparse=True, colalign=align)
        lines += text.splitlines()
    return lines
