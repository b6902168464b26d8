"""The answer of a run: the last lines on the terminal, in sentences, at most 25 of them
and at most 100 columns wide.

It reads the rows of metrics.json, and the contents of modes.json and atlas.json, and
computes nothing.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from e2rl.evaluation.modes import OTHER
from e2rl.evaluation.rollout_files import ERRORED_FILE, TABLE
from e2rl.evaluation.summary import Headline, headline
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import lost, raised
from e2rl.report.comparison_tables import by_ego
from e2rl.report.outcomes import outcome_line
from e2rl.report.tables import UNKNOWN, grouped, number, plural
from e2rl.run.terminal import columns, terminal_width

LINES = 25
WEAKNESSES = 3  # lines of failure modes
MOST_ROWS = 10  # of a comparison
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
COUNTS = (
    "preventable: a careful and competent driver would have had none; clean: besides, "
    "nobody else did wrong; count: preventable, or the ego's fault."
)
NAMED = 12  # scenes of a message that a summary names
MESSAGES = 3  # that a summary names
TOUCHED = {"cfr_vru": "a pedestrian or cyclist", "cfr_object": "an object"}
Row = Mapping[str, Any]  # of rollouts.csv
RATES = ("cfr", "cfr_counted", "cfr_preventable")  # of a group, in words
SEARCHED = "Tries go where failures are: rates of tries are no rates of the planner."
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


# --- the headline, and what errored


def traffic_name(row: Row) -> str:
    """Such as `e2 at η=2` or `nominal`."""
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def headline_text(headline: Headline, ego: str, traffic: str) -> str:
    """The headline of an ego in a traffic, in a sentence or two."""
    where = f"{ego} under {traffic}"
    scenes = plural(headline.scenes, "scene")
    ways = f", in {plural(headline.ways, 'way')}" if headline.ways else ""
    effort = ""
    if headline.searches:
        effort = f", within {headline.tries:.1f} tries ({headline.nfe:.0f} NFE) a scene"
        if headline.searches > 1:
            effort += f" and each of {headline.searches} searches"
    if not headline.raised:
        return (
            f"{where}: preventable failures in {headline.preventable} of "
            f"{scenes}{ways}{effort}."
        )
    return (
        f"{where}: preventable failures, or it raised, in {headline.failed} of "
        f"{scenes}{effort}; preventable failures in {headline.preventable} of "
        f"{headline.scenes}{ways}; it raised in {headline.raised} of {headline.scenes}."
    )


def row_headline(row: Row) -> str:
    """The headline of a row of metrics.json, "" where it has none."""
    if not row.get("headline"):
        return ""
    headline = Headline(**row["headline"])
    return headline_text(headline, row["ego"], traffic=traffic_name(row))


def unit_of(row: Row, count: int = 2) -> str:
    """What the rates of events of a row of metrics.json are of, for so many of them."""
    if row.get("searched") and row["n_seeds"] > 1:
        return "searches of a scene"
    return ("scene" if row.get("searched") else "rollout") + "s" * (count != 1)


def errored_lines(rows: Sequence[dict], named: int = NAMED) -> list[str]:
    """What errored: how many rollouts, whose they are, and a line for each message and
    traffic with its scenes.

    Args:
        rows: of all rollouts.
        named: so many scenes of each line, and MESSAGES of the messages; 0: all.
    """
    lines = []
    kinds = {
        "The planner raised in {}, its failures:": raised,
        "The traffic raised in {}, left out:": lost,
    }
    for text, is_kind in kinds.items():
        errored = list(filter(is_kind, rows))
        if not errored:
            continue
        share = f"{len(errored)} of {plural(len(rows), 'rollout')}"
        lines.append(text.format(share))
        groups = grouped(errored, lambda row: (row["error"], traffic_name(row)))
        ranked = sorted(groups.items(), key=lambda item: -len(item[1]))
        shown = MESSAGES if named else len(ranked)
        for (message, traffic), group in ranked[:shown]:
            scenes = scenes_text(group, named)
            lines.append(f"{message} ({len(group)} under {traffic}): {scenes}")
        if rest := len(ranked[shown:]):
            lines.append(f"and {plural(rest, 'other message')} in {ERRORED_FILE}")
    return lines


def touched_lines(rows: Iterable[dict], shown: bool = False) -> list[str]:
    """In how many rollouts each ego touched a pedestrian or cyclist, or an object, a
    line for each of the two where any did. Headlines, verdicts and failures are of
    contacts with vehicles.

    Args:
        rows: of all rollouts.
        shown: of a run with a failure report, which lacks them; else their scenes are
            named.
    """
    egos = grouped(rows, itemgetter("ego_policy"))
    return [
        touched_text([row for row in group if row.get(column) in (0, 1)], column, shown)
        for column in TOUCHED
        for group in egos.values()
        if any(row.get(column) == 1 for row in group)
    ]


def touched_text(rows: Sequence[dict], column: str, shown: bool) -> str:
    """`touched_lines` of the rows of one ego, which know the column of TOUCHED."""
    attacks_first = sorted(rows, key=lambda row: not row["eta"])
    groups = grouped(attacks_first, traffic_name)
    touching = {
        name: [row for row in group if row[column] == 1]
        for name, group in groups.items()
    }
    names = [name for name in groups if touching[name] or len(groups) <= 2]
    counts = [
        f"{len(touching[name])} of {plural(len(groups[name]), 'rollout')} under {name}"
        for name in names
    ]
    text = f"{rows[0]['ego_policy']} touched {TOUCHED[column]} in {', '.join(counts)}"
    if shown:
        return f"{text}; the failure report lacks them, see {column} in {TABLE}."
    named = NAMED if len(names) <= 2 else MESSAGES
    places = [
        f"{name} in " * (len(names) > 1) + scenes_text(touching[name], named, TABLE)
        for name in names
        if touching[name]
    ]
    return f"{text}: {'; '.join(places)}."


def scenes_text(rows: Iterable[dict], named: int, file: str = ERRORED_FILE) -> str:
    """The scenes of rows with the seeds of each, such as `a (seeds 0, 1), b (seed 0)`;
    named: so many, 0: all; file: that has the others."""
    scenes = grouped(rows, itemgetter("scene_id"))
    most = named or None
    texts = []
    for scene, group in list(scenes.items())[:most]:
        seeds = [str(row["seed"]) for row in group]
        rest = ", ..." * (0 < named < len(seeds))
        word = "seed" if len(seeds) == 1 else "seeds"
        texts.append(f"{scene} ({word} {', '.join(seeds[:most])}{rest})")
    others = len(scenes) - len(texts)
    rest = f" and {plural(others, 'other scene')} in {file}" if others else ""
    return ", ".join(texts) + rest


def group_lines(
    group: Row,
    rows: Sequence[dict],
    metrics: Sequence[dict],
    searched: bool,
) -> tuple[dict[str, str], list[str]]:
    """Returns the RATES of one ego in one traffic in words, and the lines about it: its
    headline, its rates and what to know of them.

    Args:
        group: of modes.json.
        rows: of its rollouts.
        metrics: rows of metrics.json; where they know the group in a pool only, its
            rates are not known.
        searched: the rollouts are tries.
    """
    traffic = traffic_name(group)
    lines = [
        headline_text(headline(rows, searched), group["ego_policy"], traffic=traffic)
    ]
    lines.append(outcome_line(rows))
    rates = {
        name: f"{share(row, name)} {unit_of(row)} ({rate(row, name)})"
        for row in metrics
        if (row["ego"], row["method"], row["eta"])
        == (group["ego_policy"], group["method"], group["eta"])
        for name in RATES
        if row["metrics"].get(name, {}).get("n")
    }
    crashed = any(map(raised, rows))
    if "cfr" in rates:
        lines.append(f"It was hit{', or raised,' * crashed} in {rates['cfr']}.")
    if "cfr_counted" in rates:
        lines.append(
            f"It has a failure that counts in {rates['cfr_counted']}: its fault, or a "
            f"competent driver prevents it{', or it raised' * crashed}."
        )
    if "interval" not in rates.get("cfr", "interval"):
        lines.append(FEW)
    if searched:
        lines.append(SEARCHED)
    lines += touched_lines(rows, shown=True)
    lines += [
        f"{line.rstrip(':')}." for line in errored_lines(rows) if line.endswith(":")
    ]
    return rates, lines


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
    lead += f", of them {preventable}, {clean}; {counted}"
    lead += f", with the {raised} in which it raised." if raised else "."
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
        f"Weaknesses, {order if any_counts else 'although none of the contacts counts'}:"
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
        failed = any(tally(row, "cfr") for row in rows)
        title = "Watch every failure" if failed else "Why nothing was found"
        lines.append(f"{title}: {report}")
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
        text.strip(),
        terminal_width(),
        subsequent_indent=indent,
        break_on_hyphens=False,
    )


def paragraphs(texts: Iterable[str], indent: str = "  ") -> list[str]:
    """The lines of several texts."""
    return [line for text in texts for line in wrapped(text, indent)]
