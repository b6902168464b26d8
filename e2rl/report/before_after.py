"""What training changed: the ego before and after it in lines of the terminal, side by
side."""

import math
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path

from e2rl.evaluation.rates import EgoRates
from e2rl.evaluation.rollout_files import ATLAS_FILE
from e2rl.metrics.atlas import CELL
from e2rl.metrics.catalogue import METRICS
from e2rl.report.answer import (
    COUNTS,
    LINES,
    PER_DISTANCE,
    cell,
    closing,
    tally,
    traffic_name,
    wrapped,
)
from e2rl.report.rates import WORDS, number, text
from e2rl.report.tables import UNKNOWN, plural
from e2rl.run.terminal import columns
from e2rl.search.tries import SEARCH

MOST_CELLS = 7  # of an atlas
CHANGES = {  # rows of the comparison of before and after
    "hit": "cfr",
    "preventable": "cfr_preventable",
    "count": "cfr_counted",
    "progress [m]": "progress",
    "clean": "cfr_clean",
    PER_DISTANCE: "counted_per_km",
}
OTHERS = {"people touched": "cfr_vru", "objects touched": "cfr_object"}


def compared_answer(
    before: Sequence[dict],
    after: Sequence[dict],
    atlases: tuple[Mapping, Mapping] | None = None,
    rates: tuple[EgoRates, EgoRates] | None = None,
    folder: Path | None = None,
) -> list[str]:
    """Returns the lines that say what training changed: the ego before and after it,
    side by side.

    Args:
        before: rows of metrics.json of the stage `before`.
        after: rows of the stage `after`, which are paired with those before under the
            name `before`.
        atlases: of both stages (`evaluation.atlas.group_atlas`); None: nothing was
            searched for.
        rates: in the prior's traffic, of both stages; None: they were not estimated.
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
    lines += rate_lines(*rates) if rates else []
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


def rate_lines(before: EgoRates, after: EgoRates) -> list[str]:
    """What training made of the rates in the prior's traffic: a sentence for each
    event."""
    words = {"contact": WORDS["contact"], before.target: WORDS[before.target]}
    lines = []
    for event, name in words.items():
        old, new = (text(side.rates[event]["1000km"]) for side in (before, after))
        ratio = before.ratio_to(after, event)
        at_least = ratio.value == inf and not math.isnan(ratio.low)
        times = f"at least {number(ratio.low)}" if at_least else text(ratio)
        lines += wrapped(
            f"In the prior's traffic {old} {name} per 1,000 km before training, {new} "
            f"after it; before over after {times}."
        )
    return lines


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
