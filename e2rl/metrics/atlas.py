"""The atlas of a run's failures: in how many different ways an ego fails preventably,
and each way's likeliest failure (docs/reference/metrics.md).

A cell is made of from where the partner came, what it did, which duty it broke, how
fast the ego was, and where the ego was hit. Only preventable failures enter. A cell
keeps the failure that moved the traffic least away from the prior.
"""

import math
from collections.abc import Iterable

from e2rl.metrics.failure_modes import Row, identity, is_failure, word

CELL = (
    "approach",
    "partner_manoeuvre",
    "duty",
    "speed_band",
    "contact_type",
)  # names of a cell's words
BAND = 5.0  # m/s of the ego, width of a speed band
Cell = tuple[str, ...]  # values of CELL


def cell_of(row: Row) -> Cell | None:
    """The cell of a row of rollouts.csv, "" for a word that it does not know; None if
    it has no preventable failure."""
    if row.get("cfr_preventable") != 1 or not is_failure(row):
        return None
    words = {name: word(row, name) for name in CELL} | {
        "speed_band": speed_band(
            number(
                row,
                "ego_speed",
                unknown=math.nan,
            )
        )
    }
    return tuple(words[name] for name in CELL)


def speed_band(speed: float) -> str:
    """The band of a speed [m/s], such as "5 to 10 m/s", which 10 m/s is not in; ""
    where the speed is unknown."""
    if not math.isfinite(speed):
        return ""
    low = speed // BAND * BAND
    return f"{low:g} to {low + BAND:g} m/s"


def by_likelihood(row: Row) -> tuple:
    """Sorts failures, the likeliest first: by the path KL [nats] that moved the traffic
    away from the prior, infinite where it is unknown (`transport`), then by the realism
    of the adversaries, the higher first, then by scene and seed."""
    cost = number(
        row,
        "transport",
        unknown=math.inf,
    )
    realism = number(
        row,
        "real_adv",
        unknown=-math.inf,
    )
    return (
        cost,
        -realism,
        row["scene_id"],
        row["seed"],
        *identity(row),
    )  # the last tells methods and egos apart


def number(row: Row, column: str, unknown: float) -> float:
    """The row's value in a column; `unknown` where it has none."""
    value = float(row.get(column, math.nan))
    return unknown if math.isnan(value) else value


def atlas_of(rows: Iterable[Row]) -> dict[Cell, list[Row]]:
    """The atlas of rows of rollouts.csv: the failures in each cell, the likeliest
    first, as are the cells. The order of the rows does not matter."""
    cells: dict[Cell, list[Row]] = {}
    for row in sorted(rows, key=by_likelihood):
        if (cell := cell_of(row)) is not None:
            cells.setdefault(cell, []).append(row)
    return cells
