"""In how many scenes searches have failed each of several egos: trainings of one policy pooled, egos compared.

Tries of different egos are no pairs, since a search goes on by what it has found; scenes with equal budgets are.
"""

import math
from collections.abc import Mapping, Sequence

from e2rl.evaluation.budget import EVENTS, scene_rows
from e2rl.evaluation.ego_set import EgoSet
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.report.tables import Table, difference_cell, mean_cell

TITLE = "Scenes in which each ego fails"
CAPTION = (
    "Scenes with a try that ends in a contact (`cfr`), in one that counts, in a preventable one. Each search of a scene"
    " counts once. 95% intervals by place and, of several trainings of one policy, by training. Differences are of the"
    " same scenes; a star: the interval leaves out 0."
)


def ego_table(rows: Sequence[Mapping], egos: EgoSet) -> Table:
    """The table of egos, from the rows of all tries: EVENTS of scenes, and differences to the ego that all are compared
    with, in points and relative to it."""
    every = scene_rows(rows)
    summaries = egos.metric_rows(every, [NO_SAMPLES] * len(every))
    others = {first: second for first, second in reversed(egos.pairs)}
    lines = []
    for row in summaries:
        pair = (row["paired"].get(f"ego {others[row['ego']]}") or {}) if row["ego"] in others else {}
        several = f" ({row['n_trainings']} trainings)" if "n_trainings" in row else ""
        cells = [mean_cell(METRICS[name], row) for name in EVENTS]
        cells += [difference_cell(METRICS[name], pair.get(name)) for name in EVENTS]
        lines.append([f"{row['ego']}{several}, {row['method']}", *cells, relative(pair.get(EVENTS[0]))])
    (reference,) = set(others.values()) or {""}
    head = ["ego", *(f"{name} [%]" for name in EVENTS), *(f"{name} minus {reference}" for name in EVENTS)]
    return Table(CAPTION, [*head, f"{EVENTS[0]} relative to {reference} [%]"], lines, TITLE)


def relative(pair: Mapping[str, float] | None) -> str:
    """The relative difference of a pair in per cent, with its interval where it is known."""
    if not pair or math.isnan(pair["relative"]):
        return "–"
    middle, low, high = (100 * pair[name] for name in ("relative", "relative_low", "relative_high"))
    return f"{middle:+.0f}" if math.isnan(low) else f"{middle:+.0f} [{low:+.0f}, {high:+.0f}]"
