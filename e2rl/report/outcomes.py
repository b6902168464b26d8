"""Why scenes have no preventable failure: what came nearest to one."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from e2rl.metrics.errored import raised
from e2rl.report.tables import Table, grouped, plural

Row = dict[str, Any]  # of rollouts.csv
NEAR = 2.0  # s and m, as in the column `margin`
PREVENTABLE = "a preventable failure"
RAISED = "the planner raised"
CONTACT = "contacts but no preventable one"
CLOSE = "somebody near, but no contact"
FAR = "nobody near"
UNATTACKED = "no adversary chosen"
OVERLAP = "an overlap at the start"
LOST = "the traffic raised"
OUTCOMES = (  # of rollouts; a scene has the first that any of its rollouts has
    PREVENTABLE,
    RAISED,
    CONTACT,
    CLOSE,
    FAR,
    UNATTACKED,
    OVERLAP,
    LOST,
)


def outcome(row: Row) -> str:
    """What a rollout came to, one of OUTCOMES."""
    if row["errored"] == 1:
        return RAISED if raised(row) else LOST
    if row["cfr_preventable"] == 1:
        return PREVENTABLE
    if row["cfr"] == 1:
        return CONTACT
    if row["cfr"] != 0:
        return OVERLAP
    if row["eta"] and math.isnan(row["ttc_c"]):
        return UNATTACKED
    return CLOSE if row["margin"] >= -NEAR else FAR


def scene_outcomes(rows: Sequence[Row]) -> dict[str, str]:
    """What came nearest to a preventable failure in each scene of some rollouts."""
    scenes = grouped(rows, lambda row: row["scene_id"])
    return {
        scene: min(map(outcome, tries), key=OUTCOMES.index)
        for scene, tries in scenes.items()
    }


def outcome_line(rows: Sequence[Row]) -> str:
    """In how many scenes which outcome was the nearest to a preventable failure."""
    outcomes = scene_outcomes(rows)
    counts = Counter(outcomes.values())
    texts = [f"{name} in {counts[name]}" for name in OUTCOMES if counts[name]]
    return f"Of {plural(len(outcomes), 'scene')}: {'; '.join(texts)}."


def outcome_tables(groups: Mapping[str, Sequence[Row]]) -> list[Table]:
    """A table of what came nearest to a preventable failure in each scene, where any is
    without one.

    Args:
        groups: rollouts by the names of ego and traffic.
    """
    columns = [scene_outcomes(rows) for rows in groups.values()]
    tries = [Counter(row["scene_id"] for row in rows) for rows in groups.values()]
    lines = []
    for scene in dict.fromkeys(scene for column in columns for scene in column):
        cells = [
            f"{column[scene]} ({count[scene]})" if scene in column else ""
            for column, count in zip(columns, tries, strict=True)
        ]
        lines.append([scene, *cells])
    caption = (
        "What came nearest to a preventable failure, (n) rollouts. Near: within "
        f"{NEAR:g} s and m of a contact at constant velocities, `margin` ≥ −{NEAR:g}."
    )
    table = Table(caption, ["", *groups], rows=lines, title="Scene by scene")
    failed = all(set(column.values()) == {PREVENTABLE} for column in columns)
    return [] if failed else [table]
