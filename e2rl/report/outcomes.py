"""Why scenes have no preventable failure: what came nearest to one."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from e2rl.metrics.errored import raised
from e2rl.report.tables import grouped, plural

Row = dict[str, Any]  # of rollouts.csv
NEAR = 2.0  # s and m, as in the column `margin`
PREVENTABLE = "a preventable failure"
RAISED = "the planner raised"
CONTACT = "contacts but no preventable one"
CLOSE = "near a collision, but no contact"
UNREACHED = "no adversary near a collision"
FAR = "nobody near a collision"
UNATTACKED = "no adversary chosen"
OVERLAP = "an overlap at the start"
LOST = "the traffic raised"
OUTCOMES = (  # of rollouts; a scene has the first that any of its rollouts has
    PREVENTABLE,
    RAISED,
    CONTACT,
    CLOSE,
    UNREACHED,
    FAR,
    UNATTACKED,
    OVERLAP,
    LOST,
)
APART = (CLOSE, UNREACHED, FAR, UNATTACKED)  # without a contact
CAPTION = (
    "What came nearest to a preventable failure, (n) rollouts. Near: within "
    f"{NEAR:g} s and m of a contact at constant velocities, `margin` ≥ −{NEAR:g}. Gap: "
    "the smallest to anybody, also to who drives alongside or stands. Whether an "
    "adversary could come nearer, or did not happen to, no column tells."
)
SPENT = "The tries of a scene ended with the run's budget: more may find more."
UNSPENT = "A `budget` spends further tries on these scenes."


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
    if row["margin"] >= -NEAR:
        return CLOSE
    return UNREACHED if row["eta"] else FAR


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


def outcome_table(
    groups: Mapping[str, Sequence[Row]],
    searched: bool,
) -> dict[str, Any] | None:
    """What came nearest to a preventable failure in each scene: `head`, `rows` and
    `caption` of a table, and the `names` of the outcomes in it; None where all scenes
    have one.

    Args:
        groups: rollouts by the names of ego and traffic.
        searched: the rollouts are tries.
    """
    scenes = [grouped(rows, lambda row: row["scene_id"]) for rows in groups.values()]
    outcomes = [scene_outcomes(rows) for rows in groups.values()]
    lines = [
        [
            scene,
            *(
                outcome_cell(outcome.get(scene, ""), tries.get(scene, ()))
                for outcome, tries in zip(outcomes, scenes, strict=True)
            ),
        ]
        for scene in dict.fromkeys(scene for tries in scenes for scene in tries)
    ]
    found = {name for outcome in outcomes for name in outcome.values()}
    if found == {PREVENTABLE}:
        return None
    return {
        "head": ["scene", *groups],
        "rows": lines,
        "caption": f"{CAPTION} {SPENT if searched else UNSPENT}",
        "names": [name for name in OUTCOMES if name in found],
    }


def outcome_cell(name: str, rows: Sequence[Row]) -> str:
    """The outcome of a scene in one traffic, the smallest gap where nothing touched,
    and the number of rollouts."""
    gaps = [row["min_dtc"] for row in rows if row.get("min_dtc", 0.0) > 0.0]
    gap = f", gap {min(gaps):.2g} m" if gaps and name in APART else ""
    return f"{name}{gap} ({len(rows)})" if rows else ""
