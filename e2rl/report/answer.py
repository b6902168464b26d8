"""The answer of a run: the last lines on the terminal, in sentences, at most 25 of them and at most 100 columns wide.

It reads the rows of metrics.json and the content of modes.json, and computes nothing anew.
"""

import math
import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from e2rl.metrics.catalogue import META_STAGE, METRICS, OPEN_LOOP_STAGE, STAGES
from e2rl.report.tables import UNKNOWN, column_names, number

LINES, NARROWEST, WIDEST = 25, 80, 100
WEAKNESSES, MOST_ROWS = 3, 10  # lines of failure modes; rows of a comparison
OTHER = 0  # number of the small failure modes together
COUNTS = "count: the ego was at fault, or a careful and competent driver would prevent it."
FEW = "No intervals: they need scenes of at least ten places."


def terminal_width() -> int:
    """Returns the columns of the terminal, between 80 and 100; 100 where the output is no terminal."""
    return min(max(shutil.get_terminal_size((WIDEST, 24)).columns, NARROWEST), WIDEST)


def answer_lines(
    rows: Sequence[dict],
    modes: Mapping | None = None,
    folder: Path | None = None,
    report: Path | None = None,
    notes: Sequence[str] = (),
    width: int | None = None,
) -> list[str]:
    """Returns the lines that say what an evaluation found.

    One attack on one ego is told in sentences. Several egos, methods or intensities have a table of one row each.

    Args:
        rows: of metrics.json.
        modes: the content of modes.json; without it no weaknesses are named.
        folder: of the run, which holds tables.md.
        report: the failure report, where one was written.
        notes: further lines, such as the scenes that were left out.
        width: columns; None: those of the terminal.
    """
    width = width or terminal_width()
    driven = closed_loop(rows)
    lines = []
    if driven:
        nominal = [row for row in driven if not row["eta"]]
        attacks = [row for row in driven if row["eta"]]
        if len({row["ego"] for row in driven}) == 1 and len(attacks) <= 1 and len(nominal) <= 1:
            lines += told(attacks[0] if attacks else nominal[0], nominal[0] if attacks and nominal else None, width)
        else:
            lines += compared(driven, width)
        lines += weaknesses(modes, width)
    lines += [line for row in rows if row.get("stage") in STAGES for line in prior_line(row, width)]
    last = closing(rows, width, folder, report, notes)
    return [*lines[: LINES - len(last)], *last]


def compared_answer(
    before: Sequence[dict],
    after: Sequence[dict],
    modes: Sequence[Mapping] = (),
    folder: Path | None = None,
    width: int | None = None,
) -> list[str]:
    """Returns the lines that say what training changed: the ego before and after it, side by side.

    Args:
        before: rows of metrics.json of the stage `before`.
        after: rows of the stage `after`, which are paired with those before under the name `before`.
        modes: contents of the two stages' modes.json; without them no weaknesses are named.
        folder: of the run, which holds tables.md.
        width: columns; None: those of the terminal.
    """
    width = width or terminal_width()
    earlier = {(row["method"], row["eta"]): row for row in closed_loop(before)}
    later = {(row["method"], row["eta"]): row for row in closed_loop(after)}
    pairs = [(earlier[key], row) for key, row in later.items() if key in earlier]
    lines: list[str] = []
    if pairs:
        old, new = max(pairs, key=lambda pair: pair[1]["eta"])
        lines += wrapped(
            f"After training, {new['ego']} was hit in {of(new, 'cfr')} rollouts {traffic(new)} ({rate(new, 'cfr')}); "
            f"before it in {of(old, 'cfr')} ({rate(old, 'cfr')}).",
            width,
        )
    kinds = {"hit": "cfr", "count": "cfr_counted", "count per 1,000 km": "counted_per_km", "progress [m]": "progress"}
    table = [["", "before", "after", "difference"]]
    for title, name in kinds.items():
        for old, new in pairs:
            cells = [cell(old, name), cell(new, name), gap(new, "before", name)]
            table.append([f"{title}, {traffic_name(new)}", *cells])
    last = closing(after, width, folder)
    lines += [*columns(table[: LINES - len(lines) - len(last) - 1], width), COUNTS] if pairs else []
    for stage, found in zip(("before", "after"), modes, strict=False):
        lines += weaknesses(found, width, f"Weaknesses {stage} training", most=1)
    return [*lines[: LINES - len(last)], *last]


# --- one attack on one ego


def told(row: dict, nominal: dict | None, width: int) -> list[str]:
    """Sentences about one row of metrics.json, beside the nominal traffic where that was driven."""
    kind = "attacked " if row["eta"] else ""
    text = f"{row['ego']} was hit in {of(row, 'cfr')} {kind}rollouts ({rate(row, 'cfr')})"
    sentences = [f"{text}, {of(nominal, 'cfr')} nominal." if nominal else f"{text}.", verdict(row), rates(row, nominal)]
    sentences += [effect(row, nominal), cost(row, nominal)] if nominal else []
    return [line for sentence in sentences for line in wrapped(sentence, width, "  ")]


def verdict(row: dict) -> str:
    """How many of the collisions count, and why; how many a search could have avoided."""
    hits, found = row["metrics"].get("counted", {}).get("n", 0), tally(row, "counted")
    if not hits:
        return ""
    avoidable = row["metrics"].get("avoidable", {}).get("n", 0)
    search = f" A search found a way out of {tally(row, 'avoidable')} of {avoidable}." if avoidable else ""
    if not found:
        return f"None counts: the ego was not at fault, and no careful driver would have prevented it.{search}"
    reasons = {
        "the ego was at fault": tally(row, "at_fault"),
        "a careful and competent driver would have prevented it": tally(row, "preventable"),
    }
    because = " or ".join(f"{reason} ({count})" for reason, count in reasons.items() if count)
    which = f"{found} of the {hits}" if found < hits else f"All {hits}" if hits > 1 else "It"
    return f"{which} count{'s' if found == 1 else ''}, because {because}.{search}"


def rates(row: dict, nominal: dict | None) -> str:
    """Failures that count per 1,000 km, in the attack and in nominal traffic."""
    rate, usual = per_thousand(row), per_thousand(nominal) if nominal else UNKNOWN
    if rate == UNKNOWN:
        return ""
    text = f"Failures that count per 1,000 km driven: {rate}"
    return f"{text} attacked, {usual} nominal." if nominal else f"{text}."


def effect(row: dict, nominal: dict) -> str:
    """The difference of the attack to the nominal traffic."""
    found = (row["paired"].get(nominal["method"]) or {}).get("cfr")
    if not found or math.isnan(found["difference"]):
        return ""
    text = f"Attack minus nominal: {100 * found['difference']:+.0f} points of collisions over the same scenes and seeds"
    if math.isnan(found["low"]):
        return f"{text}."
    return f"{text} (95% interval {100 * found['low']:+.0f} to {100 * found['high']:+.0f})."


def cost(row: dict, nominal: dict) -> str:
    """What the attack costs in realism."""
    adversaries = value(row, "real_adv")
    alone = f", of the adversaries alone {adversaries}" if adversaries != UNKNOWN else ""
    return (
        f"What it costs: realism {value(row, 'real')}{alone} (nominal {value(nominal, 'real')}; 1 is like the "
        f"recordings); {value(row, 'aor_step')}% of the driving off the road (nominal {value(nominal, 'aor_step')}%); "
        f"other vehicles collide in {of(row, 'cfr_bg')} (nominal {of(nominal, 'cfr_bg')})."
    )


# --- several


def compared(rows: Sequence[dict], width: int) -> list[str]:
    """A table with a row for each ego, method and intensity. Methods: those that find most failures that count first.
    Egos: in each traffic the one with the fewest first."""
    egos = list(dict.fromkeys(row["ego"] for row in rows))
    names = {id(row): name for ego in egos for row, name in named(rows, ego)}
    order = list(dict.fromkeys(names[id(row)] for row in sorted(rows, key=lambda row: -row["eta"])))
    counted = {id(row): row["metrics"]["cfr_counted"]["mean"] for row in rows}
    if len(egos) > 1:
        ranked = sorted(rows, key=lambda row: (order.index(names[id(row)]), low_first(counted[id(row)])))
        best = ranked[0]
        lead = f"{best['ego']} fails least: it was hit in {of(best, 'cfr')} rollouts {traffic(best)}, of which "
        lead += f"{of(best, 'cfr_counted').partition(' ')[0]} count."
    else:
        ranked = sorted(rows, key=lambda row: (not row["eta"], low_first(-counted[id(row)]), row["eta"]))
        best = ranked[0]
        lead = f"{best['ego']} fails most in the traffic of {names[id(best)]}: hit in {of(best, 'cfr')} rollouts, of "
        lead += f"which {of(best, 'cfr_counted').partition(' ')[0]} count."
    head = ["ego", "traffic", "hit", "count", "realism", "count per 1,000 km"]
    table = [
        [row["ego"], names[id(row)], *(cell(row, name) for name in ("cfr", "cfr_counted", "real", "counted_per_km"))]
        for row in ranked[:MOST_ROWS]
    ]
    table = [head, *table] if len(egos) > 1 else [cells[1:] for cells in [head, *table]]
    rest = len(ranked) - MOST_ROWS
    more = [f"... and {rest} more in tables.md"] if rest > 0 else []
    return [*wrapped(lead, width), *columns(table, width), *more, COUNTS]


def named(rows: Sequence[dict], ego: str) -> Iterable[tuple[dict, str]]:
    """The rows of an ego with the names of their traffic."""
    own = [row for row in rows if row["ego"] == ego]
    return zip(own, column_names(own), strict=True)


def low_first(rate: float) -> float:
    """A rate to sort by; unknown ones come last."""
    return math.inf if math.isnan(rate) else rate


# --- weaknesses, and what was measured


def weaknesses(modes: Mapping | None, width: int, title: str = "Weaknesses", most: int = WEAKNESSES) -> list[str]:
    """The failure modes with the most failures that count, a line each; where none counts, the most frequent ones."""
    found = [mode for mode in (modes["modes"] if modes else ()) if mode["mode"] != OTHER]
    if modes is None or not found:
        return []
    counts = {mode["mode"]: round((mode["counted"] or 0) * mode["count"]) for mode in found}
    any_counts = any(counts.values())
    chosen = [mode for mode in found if counts[mode["mode"]] or not any_counts]
    chosen.sort(key=lambda mode: (-counts[mode["mode"]], -mode["count"], mode["mode"]))
    lines = [f"{title}, {'most failures that count first' if any_counts else 'although none of the failures counts'}:"]
    for place, mode in enumerate(chosen[:most], 1):
        text = f"{place}. {mode['name']} ({mode['count']} of {plural(modes['failures'], 'failure')}"
        lines += wrapped(f"{text}, {counts[mode['mode']]} count)" if any_counts else f"{text})", width, "   ")
    return lines


def prior_line(row: dict, width: int) -> list[str]:
    """The line of a row of the stages open loop and meta-metric, which measure the traffic's prior."""
    text = ""
    if row["stage"] == OPEN_LOOP_STAGE:
        best, plain = (row["metrics"].get(name, {}).get("mean", math.nan) for name in ("min_ade_3", "cv_ade_3"))
        if not math.isnan(best):
            text = f"{row['method']}, open loop: each vehicle's best sample is {best:.2f} m beside the recording over "
            text += f"3 s, constant velocity {plain:.2f} m."
    elif row["stage"] == META_STAGE and row["metrics"].get("meta_metric", {}).get("n"):
        found = row["metrics"]["meta_metric"]
        text = f"{row['method']}: realism meta-metric {found['mean']:.3f} of {found['n']} scenes."
    return wrapped(text, width) if text else []


def closing(
    rows: Sequence[dict], width: int, folder: Path | None, report: Path | None = None, notes: Sequence[str] = ()
) -> list[str]:
    """The last lines: what the numbers rest on, and where everything lies."""
    last = [line for text in (*notes, measured(rows)) for line in wrapped(text, width)]
    last += [f"Watch every failure: {report}"] if report else []
    return last + ([f"All metrics, with intervals: {folder / 'tables.md'}"] if folder else [])


def measured(rows: Sequence[dict]) -> str:
    """Where the numbers come from, and what they lack."""
    if not rows:
        return "No rollout was scored."
    first = max(rows, key=lambda row: row["n_rollouts"])
    scenes, seeds = plural(first["n_scenes"], "scene"), plural(first["n_seeds"], "seed")
    methods = dict.fromkeys(traffic_name(row) for row in rows if row["eta"])
    attack = f"; attack: {', '.join(methods)}" if len(methods) == 1 else ""
    text = f"Measured: {first['dataset']}/{first['split']}, {scenes}, {seeds}{attack}."
    if all(math.isnan(row["metrics"]["cfr"]["low"]) for row in rows if "cfr" in row["metrics"]):
        text += f" {FEW}" if any("cfr" in row["metrics"] for row in rows) else ""
    ended = sum(count for row in rows for count in row.get("ended", {}).values())
    return text + (f" {plural(ended, 'rollout')} failed without a score: see ended.json." if ended else "")


# --- cells


def closed_loop(rows: Sequence[dict]) -> list[dict]:
    """The rows of rollouts, without those of the stages that measure the prior."""
    return [row for row in rows if row.get("stage") not in STAGES and row["n_rollouts"]]


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
    """Such as `25% (3 of 12)` for a rate of rollouts, a number per 1,000 km, or the mean of another metric."""
    if METRICS[name].fraction:
        return UNKNOWN if of(row, name) == UNKNOWN else f"{per_cent(row['metrics'][name]['mean'])} ({of(row, name)})"
    return per_thousand(row, name) if METRICS[name].per else value(row, name)


def gap(row: dict, other: str, name: str) -> str:
    """A paired difference such as `-20 [-28, -12]`, of shares in per cent points, of rates per 1,000 km."""
    found, metric = (row["paired"].get(other) or {}).get(name), METRICS[name]
    if not found or math.isnan(found["difference"]):
        return UNKNOWN
    scale = 100 if metric.fraction else 1000 if metric.per else 1
    middle, low, high = (f"{scale * found[end]:+,.0f}" for end in ("difference", "low", "high"))
    return middle if math.isnan(found["low"]) else f"{middle} [{low}, {high}]"


def value(row: dict, name: str) -> str:
    """The mean of a metric, as the tables print it."""
    found = row["metrics"].get(name)
    return number(METRICS[name], found["mean"]) if found and found["n"] else UNKNOWN


def per_thousand(row: dict, name: str = "counted_per_km") -> str:
    """A rate per 1,000 km."""
    found = row["metrics"].get(name, {}).get("mean", math.nan)
    return UNKNOWN if math.isnan(found) else f"{1000 * found:,.0f}"


def per_cent(value: float) -> str:
    """Such as `25%`; one decimal below 10%."""
    return f"{100 * value:.{0 if value in (0, 1) or value >= 0.1 else 1}f}%"


def traffic(row: dict) -> str:
    """Such as `attacked by e2 at η=2` or `in nominal traffic`."""
    return f"attacked by {traffic_name(row)}" if row["eta"] else f"in {row['method']} traffic"


def traffic_name(row: dict) -> str:
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def wrapped(text: str, width: int, indent: str = "") -> list[str]:
    """The text in lines of at most `width` columns, the second and later ones indented."""
    return textwrap.wrap(text.strip(), width, subsequent_indent=indent, break_on_hyphens=False)


def columns(table: Sequence[Sequence[str]], width: int) -> list[str]:
    """Aligned rows of text; the last columns are left out, and then the first is cut, where they are too wide."""
    sizes = [max(map(len, column)) for column in zip(*table, strict=True)]
    while len(sizes) > 3 and sum(sizes) + 2 * (len(sizes) - 1) > width:
        sizes.pop()
    sizes[0] = max(8, min(sizes[0], width - sum(sizes[1:]) - 2 * (len(sizes) - 1)))
    lines = []
    for first, *others in table:
        name = first if len(first) <= sizes[0] else f"{first[: sizes[0] - 1]}…"
        cells = [text.rjust(size) for text, size in zip(others, sizes[1:], strict=False)]
        lines.append("  ".join([name.ljust(sizes[0]), *cells]).rstrip()[:width])
    return lines
