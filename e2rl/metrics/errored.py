"""Rollouts that errored: they ended since the planner or the traffic raised, or became
NaN or infinite.

One in which the planner raised is a failure of the planner, whatever would have
happened; of one in which the traffic raised nothing is known. What raised is not known
of runs of earlier versions; their rollouts are the planner's.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

from e2rl.metrics.catalogue import LATER, WORDS, declare, event, row_columns
from e2rl.sim.rollout_file import UNPRINTABLE

TRAFFIC = "traffic"  # in the column `raised_by`
LONGEST = 200  # characters of a message

declare(
    event(
        "errored",
        "the planner raised, or planned what is NaN; counts as a failure",
        raised=1.0,
        tables="main",
    )
)


def raised(row: Mapping[str, Any]) -> bool:
    """Returns whether the planner raised in the rollout of a row."""
    return row.get("errored") == 1 and row.get("raised_by") != TRAFFIC


def lost(row: Mapping[str, Any]) -> bool:
    """Returns whether the traffic raised in the rollout of a row, which counts neither
    for nor against the planner."""
    return row.get("errored") == 1 and row.get("raised_by") == TRAFFIC


def errored_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the row of a rollout that errored: nothing of it is known but by whom and
    with what message it ended.

    Args:
        entry: of errored.json, whose `raised_by` and `location` earlier versions did
            not write.
    """
    kind = str(entry["reason"]).removeprefix("raised ")
    message = ": ".join(filter(None, (kind, str(entry.get("detail", "")))))
    message = re.sub(UNPRINTABLE, " ", " ".join(message.split()))[:LONGEST]
    identity = {
        name: entry[name]
        for name in (
            "dataset",
            "split",
            "method",
            "ego_policy",
            "eta",
            "scene_id",
            "seed",
        )
    }
    about = {"location": entry.get("location", ""), "partner": -1}
    ending = {"errored": 1.0, "raised_by": entry.get("raised_by", ""), "error": message}
    unknown = dict.fromkeys(row_columns(), math.nan) | dict.fromkeys(WORDS, "")
    return unknown | LATER | identity | about | ending
