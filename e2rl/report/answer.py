"""The answer of a run: the last lines on the terminal, in sentences, at most 25 of them
and at most 100 columns wide.

It reads the rows of metrics.json, and the contents of modes.json and atlas.json, and
computes nothing.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from e2rl.evaluation.methods import SEARCH
from e2rl.evaluation.modes import ATLAS_FILE, OTHER
from e2rl.evaluation.rollout_files import ERRORED_FILE
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
from e2rl.report.tables import UNKNOWN, closed_loop, number
from e2rl.run.terminal import column_groups, terminal_width

LINES = 25
WEAKNESSES, MOST_ROWS, MOST_CELLS = (
    3,
    10,
    7,
)  # lines of failure modes; rows of a comparison, of an atlas
HEADLINES = 3  # of traffic and egos
KINDS = {
    "preventable": "cfr_preventable",
    "clean": "cfr_clean",
    "count": "cfr_counted",
}  # of failures, the first leads
COUNTS = (
    "preventable: a careful and competent driver would have had none; clean: besides, nobody else did wrong; count: "
    "preventable, or the ego's fault."
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

    One attack on one ego is told in sentences. Several egos, methods or intensities
    have a table of one row each.

    Args:
        rows: of metrics.json.
        modes: the content of modes.json; without it no weaknesses are named.
        folder: of the run, which holds tables.md.
        report: the failure report, where one was written.
        notes: further lines, such as the scenes that were left out.
        rollouts: of rollouts.csv, of which those that errored, or touched people or
            objects, are named.
    """
    driven = [row for row in closed_loop(rows) if row["n_rollouts"]]
    nominal = [row for row in driven if not row["eta"]]
    attacks = [row for row in driven if row["eta"]]
    first = sorted(driven, key=lambda row: not row["eta"])[
        :HEADLINES
    ]  # attacks before nominal traffic
    texts = (
        *map(row_headline, first),
        *errored_lines(rollouts),
        *touched_lines(rollouts, shown=report is not None),
    )
    lines = [line for text in texts for line in wrapped(text, "  ")]
    if (
        len({row["ego"] for row in driven}) == 1
        and len(attacks) <= 1
        and len(nominal) <= 1
    ):
        lines += told(
            attacks[0] if attacks else nominal[0],
            nominal[0] if attacks and nominal else None,
        )
    elif driven:
        lines += compared(driven)
    lines += weaknesses(modes if driven else None)
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
    earlier = {(row["method"], row["eta"]): row for row in closed_loop(before)}
    later = {(row["method"], row["eta"]): row for row in closed_loop(after)}
    pairs = [(earlier[key], row) for key, row in later.items() if key in earlier]
    last = [*(wrapped(COUNTS) if pairs else []), *closing(after, folder)]
    lines = atlas_lines(*atlases) if atlases else []
    if pairs:
        old, new = max(pairs, key=lambda pair: pair[1]["eta"])
        lines += wrapped(
            f"After training, {new['ego']} was {ended(old, new)} in {of(new, 'cfr')} rollouts {traffic(new)} "
            f"{bracketed(rate(new, 'cfr'), ends(new))}; "
            f"before it in {of(old, 'cfr')} {bracketed(rate(old, 'cfr'), ends(old))}."
        )
        kinds = {
            "hit": "cfr",
            **{kind: KINDS[kind] for kind in ("preventable", "count")},
            "progress [m]": "progress",
        }
        kinds |= {"clean": KINDS["clean"], "count per 1,000 km": "counted_per_km"}
        others = {"people touched": "cfr_vru", "objects touched": "cfr_object"}
        kinds |= {
            title: name
            for title, name in others.items()
            if any(tally(row, name) for row in (*before, *after))
        }
        if atlases:  # which leave room for the traffic at the ends
            pairs = [pair for pair in pairs if pair[1]["eta"] in (0, new["eta"])]
        table = [["", "before", "after", "difference"]]
        table += [
            [
                f"{title}, {traffic_name(new)}",
                cell(old, name),
                cell(new, name),
                gap(new, name),
            ]
            for title, name in kinds.items()
            for old, new in pairs
        ]
        lines += columns(table[: max(2, LINES - len(lines) - len(last))])
    return [*lines[: LINES - len(last)], *last]


def atlas_lines(before: Mapping, after: Mapping) -> list[str]:
    """The cells of two atlases with their numbers of scenes, those of most scenes
    before first."""
    scenes = [
        {tuple(cell[name] for name in CELL): cell["scenes"] for cell in atlas["atlas"]}
        for atlas in (before, after)
    ]
    every = {
        key: tuple(each.get(key, 0) for each in scenes)
        for key in (*scenes[0], *scenes[1])
    }
    ranked = sorted(every.items(), key=lambda cell: (-cell[1][0], -cell[1][1], cell[0]))
    failed = [
        f"{each['failed_scenes']} of {plural(each['scenes'], 'scene')}"
        for each in (before, after)
    ]
    gone, new = (
        sum(not counts[place] for counts in every.values()) for place in (1, 0)
    )
    lines = wrapped(
        f"A search finds preventable failures in {failed[0]} before training, in {plural(before['cells'], 'way')}, and "
        f"in {failed[1]} after it, in {plural(after['cells'], 'way')}: {gone} are gone, {new} are new."
    )
    rows = [[", ".join(filter(None, key)), *map(str, counts)] for key, counts in ranked]
    table = (
        columns([["scenes that fail so", "before", "after"], *rows[:MOST_CELLS]])
        if rows
        else []
    )
    rest = len(rows) - MOST_CELLS
    return [
        *lines,
        *table,
        *(
            [f"... and {rest} more in {{before,after}}/{SEARCH}/{ATLAS_FILE}"]
            if rest > 0
            else []
        ),
    ]


# --- one attack on one ego


def told(row: dict, nominal: dict | None) -> list[str]:
    """Sentences about one row of metrics.json, beside the nominal traffic where that
    was driven."""
    if row.get("searched"):
        return [line for text in searched(row, nominal) for line in wrapped(text, "  ")]
    kind = "attacked rollouts" if row["eta"] else "rollouts"
    driven = [row, nominal] if nominal else [row]
    found = f"{row['ego']} was {ended(*driven)} in {of(row, 'cfr')} {kind} {bracketed(rate(row, 'cfr'), ends(row))}"
    if nominal is None:
        return [
            line
            for text in (f"{found}.", verdict(row), per_distance(row))
            for line in wrapped(text, "  ")
        ]
    sentences = [
        f"{found}, {of(nominal, 'cfr')} nominal {bracketed(ends(nominal))}".strip()
        + ".",
        verdict(row),
    ]
    sentences += [per_distance(row, nominal), effect(row, nominal), cost(row, nominal)]
    return [line for sentence in sentences for line in wrapped(sentence, "  ")]


def per_distance(row: dict, nominal: dict | None = None) -> str:
    """The failures that count per distance, and how many rollouts, since the planner
    raised, are not in it."""
    rates = [value(each, "counted_per_km") for each in (row, nominal) if each]
    if rates[0] == UNKNOWN:
        return ""
    text = f"Failures that count per 1,000 km driven: {rates[0]}"
    text += f" attacked, {rates[1]} nominal" if nominal else ""
    crashed = sum(tally(each, "errored") for each in (row, nominal) if each)
    return (
        f"{text}; without {plural(crashed, 'rollout')} in which it raised."
        if crashed
        else f"{text}."
    )


def searched(row: dict, nominal: dict | None) -> list[str]:
    """Sentences about the tries of a search, of which there are numbers and no rates."""
    hits = row["metrics"].get("counted", {}).get("n", 0)
    sentences = [
        f"Tries end in {hits} contacts. {verdict(row)}"
        if hits
        else "No try ends in a contact."
    ]
    return [*sentences, cost(row, nominal)] if nominal else sentences


def ended(*rows: dict) -> str:
    """What rollouts that count in `cfr` have come to."""
    return "hit, or raised," if any(tally(row, "errored") for row in rows) else "hit"


def ends(row: dict) -> str:
    """How many of the rollouts that count in `cfr` came to which of the two, "" where
    the planner never raised."""
    crashed = tally(row, "errored")
    return (
        f"hit in {tally(row, 'cfr') - crashed}, raised in {crashed}" if crashed else ""
    )


def bracketed(*parts: str) -> str:
    """The parts that are there in brackets, "" where none is."""
    text = "; ".join(filter(None, parts))
    return f"({text})" if text else ""


def verdict(row: dict) -> str:
    """How many of the collisions were preventable, clean, and count; how many a search
    could have avoided."""
    hits = row["metrics"].get("counted", {}).get("n", 0)
    found = tally(row, "counted")
    if not hits:
        return ""
    avoidable = row["metrics"].get("avoidable", {}).get("n", 0)
    search = (
        f" A search found a way out of {tally(row, 'avoidable')} of {avoidable}."
        if avoidable
        else ""
    )
    preventable = tally(row, "preventable")
    fault = tally(row, "at_fault")
    text = f"A careful and competent driver would have prevented {preventable or 'none'} of the {hits}"
    if preventable and not row.get("searched"):
        text += f" ({tally(row, 'cfr_clean') - tally(row, 'errored')} clean: nobody else did wrong)"
    blame = (
        f"the ego was at fault in {fault}" if fault else "the ego was never at fault"
    )
    return f"{text}; {blame}. So {found or 'none'} count{'s' if found == 1 else ''}.{search}"


def effect(row: dict, nominal: dict) -> str:
    """The difference of the attack to the nominal traffic."""
    found = (row["paired"].get(nominal["method"]) or {}).get("cfr")
    if not found or math.isnan(found["difference"]):
        return ""
    kind = (
        "failures"
        if tally(row, "errored") or tally(nominal, "errored")
        else "collisions"
    )
    text = f"Attack minus nominal: {100 * found['difference']:+.0f} points of {kind} over the same scenes and seeds"
    if math.isnan(found["low"]):
        return f"{text}."
    return f"{text} (95% interval {100 * found['low']:+.0f} to {100 * found['high']:+.0f})."


def cost(row: dict, nominal: dict) -> str:
    """What the attack costs in realism, "" where no rollout of either ended."""
    if value(row, "real") == value(nominal, "real") == UNKNOWN:
        return ""
    adversaries = value(row, "real_adv")
    alone = (
        f", of the adversaries alone {adversaries}" if adversaries != UNKNOWN else ""
    )
    return (
        f"What it costs: realism {value(row, 'real')}{alone} (nominal {value(nominal, 'real')}; 1 is like the "
        f"recordings); {value(row, 'aor_step')}% of the driving off the road (nominal {value(nominal, 'aor_step')}%); "
        f"other vehicles collide in {of(row, 'cfr_bg')} (nominal {of(nominal, 'cfr_bg')})."
    )


# --- several


def compared(rows: Sequence[dict]) -> list[str]:
    """A table with a row for each ego, method and intensity. Methods: those that find
    most preventable failures first, of equals most clean ones, then most that count,
    then most contacts. Egos: in each traffic, the strongest first, the one with the
    fewest first. Unknown rates come last."""
    egos = list(dict.fromkeys(row["ego"] for row in rows))
    cells, labels = by_ego(rows, egos)
    several = len(egos) > 1

    def rank(key: tuple[str, str]) -> tuple:
        row = cells[key]
        sign = 1 if several else -1
        means = [
            row["metrics"].get(name, {}).get("mean", math.nan)
            for name in (*KINDS.values(), "cfr")
        ]
        found = [math.inf if math.isnan(mean) else sign * mean for mean in means]
        return (
            (-row["eta"], labels.index(key[1]), *found)
            if several
            else (not row["eta"], *found, row["eta"])
        )

    ranked = sorted(cells, key=rank)
    ego, name = ranked[0]
    best = cells[ranked[0]]
    most = "fails most" if best["metrics"]["cfr"]["mean"] else "does not fail, not even"
    hits = f"{of(best, 'cfr')} {unit_of(best)}"
    crashed = tally(best, "errored")
    hits = f"hit or raised in {hits}" if crashed else f"hit in {hits}"
    lead = f"{ego} {most} in the traffic of {name}: {hits}"
    if several:
        lead = (
            f"{ego} fails least: it {'' if crashed else 'was '}{hits} {traffic(best)}"
        )
    kinds = [
        f"{of(best, metric).partition(' ')[0]} {kind}" for kind, metric in KINDS.items()
    ]
    lead += f", of them {kinds[0]}, {kinds[1]}; {kinds[2]}."
    table = [["ego", "traffic", "hit", *KINDS, "realism", "count per 1,000 km"]]
    shown = ("cfr", *KINDS.values(), "real", "counted_per_km")
    table += [
        [*key, *(cell(cells[key], metric) for metric in shown)]
        for key in ranked[:MOST_ROWS]
    ]
    rest = len(ranked) - MOST_ROWS
    more = [f"... and {rest} more in tables.md"] if rest > 0 else []
    shown_rows = table if several else [line[1:] for line in table]
    lost = sum(tally(row, "errored") for row in cells.values())
    left_out = (
        f" Rates per 1,000 km are without {plural(lost, 'rollout')} in which a planner raised."
        if lost
        else ""
    )
    return [*wrapped(lead), *columns(shown_rows), *more, *wrapped(COUNTS + left_out)]


# --- weaknesses, and what was measured


def weaknesses(modes: Mapping | None) -> list[str]:
    """The failure modes with the most failures that count, a line each; where none
    counts, the most frequent ones.

    They are of the attacks, where there are any, and not of nominal traffic.
    """
    groups = modes["groups"] if modes else []
    attacks = [place for place, group in enumerate(groups) if group["eta"]]
    chosen = attacks or list(range(len(groups)))
    total = sum(groups[place]["failures"] for place in chosen)
    if modes is None or not total:
        return []
    count, counted = (
        {
            mode["mode"]: sum(mode["groups"][place][name] for place in chosen)
            for mode in modes["modes"]
        }
        for name in ("count", "counted")
    )
    any_counts = any(counted.values())
    found = [
        mode for mode in modes["modes"] if mode["mode"] != OTHER and count[mode["mode"]]
    ]
    found = [mode for mode in found if counted[mode["mode"]] or not any_counts]
    found.sort(
        key=lambda mode: (-counted[mode["mode"]], -count[mode["mode"]], mode["mode"])
    )
    if not found:
        return wrapped(
            f"No weakness stands out: {sum(counted.values())} failures that count are each of another kind."
        )
    lines = [
        f"Weaknesses, {'most failures that count first' if any_counts else 'although none of the failures counts'}:"
    ]
    for place, mode in enumerate(found[:WEAKNESSES], 1):
        text = f"{place}. {mode['name']} ({count[mode['mode']]} of {plural(total, 'failure')}"
        lines += wrapped(
            f"{text}, {counted[mode['mode']]} count)" if any_counts else f"{text})",
            "   ",
        )
    return lines


def closing(
    rows: Sequence[dict],
    folder: Path | None,
    report: Path | None = None,
    notes: Sequence[str] = (),
) -> list[str]:
    """The last lines: what the numbers rest on, and where everything lies."""
    last = [line for text in (*notes, measured(rows)) for line in wrapped(text)]
    last += [f"Watch every failure: {report}"] if report else []
    return last + (
        [f"All metrics, with intervals: {folder / 'tables.md'}"] if folder else []
    )


def measured(rows: Sequence[dict]) -> str:
    """Where the numbers come from, and what they lack."""
    if not rows:
        return "No rollout was scored."
    first = max(closed_loop(rows) or rows, key=lambda row: row["n_rollouts"])
    scenes = plural(first["n_scenes"], "scene")
    seeds = plural(first["n_seeds"], "seed")
    methods = dict.fromkeys(traffic_name(row) for row in rows if row["eta"])
    attack = f"; attack: {', '.join(methods)}" if len(methods) == 1 else ""
    text = f"Measured: {first['dataset']}/{first['split']}, {scenes}, {seeds}{attack}."
    rates = [row["metrics"]["cfr"] for row in rows if "cfr" in row["metrics"]]
    if rates and all(math.isnan(found["low"]) for found in rates):
        text += f" {FEW}"
    errored = sum(count for row in rows for count in row.get("errored", {}).values())
    return text + (
        f" {plural(errored, 'rollout')} without a score: see {ERRORED_FILE}."
        if errored
        else ""
    )


# --- cells


def tally(row: dict, name: str) -> int:
    """How many rollouts a rate stands for."""
    found = row["metrics"].get(name) or {"mean": math.nan, "n": 0}
    return 0 if math.isnan(found["mean"]) else round(found["mean"] * found["n"])


def of(row: dict, name: str) -> str:
    """Such as `3 of 12`."""
    found = row["metrics"].get(name)
    return f"{tally(row, name)} of {found['n']}" if found and found["n"] else UNKNOWN


def rate(row: dict, name: str) -> str:
    """Such as `25%, 95% interval 9 to 53%`."""
    found = row["metrics"][name]
    if math.isnan(found["low"]):
        return per_cent(found["mean"])
    return f"{per_cent(found['mean'])}, 95% interval {per_cent(found['low'])[:-1]} to {per_cent(found['high'])}"


def cell(row: dict, name: str) -> str:
    """Such as `25% (3 of 12)` for a rate of rollouts, else `value`."""
    if not METRICS[name].fraction or of(row, name) == UNKNOWN:
        return value(row, name)
    return f"{per_cent(row['metrics'][name]['mean'])} ({of(row, name)})"


def gap(row: dict, name: str) -> str:
    """The paired difference to `before`, such as `-20 [-28, -12]`: points of per cent,
    or rates per 1,000 km."""
    found = (row["paired"].get("before") or {}).get(name)
    metric = METRICS[name]
    if not found or math.isnan(found["difference"]):
        return UNKNOWN
    scale = 100 if metric.fraction else 1000 if metric.per else 1
    middle, low, high = (
        f"{scale * found[end]:+,.0f}" for end in ("difference", "low", "high")
    )
    return middle if math.isnan(found["low"]) else f"{middle} [{low}, {high}]"


def value(row: dict, name: str) -> str:
    """The mean of a metric as the tables print it; a rate of metres or kilometres per
    1,000 of them."""
    found = row["metrics"].get(name)
    metric = METRICS[name]
    if not found or not found["n"] or math.isnan(found["mean"]):
        return UNKNOWN
    return (
        f"{1000 * found['mean']:,.0f}" if metric.per else number(metric, found["mean"])
    )


def per_cent(value: float) -> str:
    """Such as `25%`; one decimal below 10%."""
    return f"{100 * value:.{0 if value in (0, 1) or value >= 0.1 else 1}f}%"


def traffic(row: dict) -> str:
    """Such as `attacked by e2 at η=2` or `in nominal traffic`."""
    return (
        f"attacked by {traffic_name(row)}"
        if row["eta"]
        else f"in {row['method']} traffic"
    )


def wrapped(text: str, indent: str = "") -> list[str]:
    """The text in lines of the terminal's width, the second and later ones indented."""
    return textwrap.wrap(
        text.strip(), terminal_width(), subsequent_indent=indent, break_on_hyphens=False
    )


def columns(table: Sequence[Sequence[str]]) -> list[str]:
    """Returns aligned rows of text that fit the terminal; table: the heads, which may
    be wrapped, then rows.

    Columns that find no room stand beneath, beside the first column again, which is cut
    where it is too wide.
    """
    width = terminal_width()
    body = list(zip(*table, strict=True))
    sizes = [
        max(max(map(len, cells), default=0), *map(len, head.split() or [""]))
        for head, *cells in body
    ]
    sizes[0] = min(
        sizes[0], max(width // 3, width - sum(sizes[1:]) - 2 * (len(sizes) - 1))
    )
    lines: list[str] = []
    for place in column_groups(sizes, width):
        heads = [textwrap.wrap(table[0][column], sizes[column]) for column in place]
        height = max(map(len, heads))
        rows = list(
            zip(*([""] * (height - len(head)) + head for head in heads), strict=True)
        )
        rows += [tuple(row[column] for column in place) for row in table[1:]]
        lines += [aligned(row, [sizes[column] for column in place]) for row in rows]
    return lines


def aligned(row: Sequence[str], sizes: Sequence[int]) -> str:
    """Returns a line: the first cell on the left of its column, the others on the
    right."""
    first = row[0] if len(row[0]) <= sizes[0] else f"{row[0][: sizes[0] - 1]}…"
    cells = [text.rjust(size) for text, size in zip(row[1:], sizes[1:], strict=True)]
    return "  ".join([first.ljust(sizes[0]), *cells]).rstrip()
