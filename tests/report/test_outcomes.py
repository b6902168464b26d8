"""Why scenes have no preventable failure, of known rows."""

import math

import pytest

from e2rl.report.outcomes import (
    CLOSE,
    CONTACT,
    FAR,
    LOST,
    OVERLAP,
    PREVENTABLE,
    RAISED,
    UNATTACKED,
    outcome,
    outcome_line,
    outcome_tables,
)

QUIET = {
    "scene_id": "a",
    "errored": 0.0,
    "cfr": 0.0,
    "cfr_preventable": 0.0,
    "eta": 2.0,
    "ttc_c": 0.1,
    "margin": -9.0,
}
ROWS = {  # what differs from QUIET
    PREVENTABLE: {"cfr": 1.0, "cfr_preventable": 1.0, "margin": 2.0},
    RAISED: {"errored": 1.0, "raised_by": "ego", "cfr": math.nan},
    CONTACT: {"cfr": 1.0, "margin": 0.3},
    CLOSE: {"margin": -2.0},
    FAR: {"margin": -2.1},
    UNATTACKED: {"ttc_c": math.nan, "margin": -1.0},
    OVERLAP: {"cfr": math.nan, "cfr_preventable": math.nan},
    LOST: {"errored": 1.0, "raised_by": "traffic", "cfr": math.nan},
}


@pytest.mark.parametrize("name", ROWS)
def test_a_rollout_has_its_outcome(name):
    assert outcome(QUIET | ROWS[name]) == name


def test_traffic_without_intensity_chooses_no_adversary():
    assert outcome(QUIET | ROWS[UNATTACKED] | {"eta": 0.0}) == CLOSE


def test_a_scene_has_the_worst_outcome_of_its_rollouts():
    rows = [QUIET | ROWS[FAR], QUIET | ROWS[CLOSE], QUIET | {"scene_id": "b"}]
    assert outcome_line(rows) == f"Of 2 scenes: {CLOSE} in 1; {FAR} in 1."
    (table,) = outcome_tables({"ego, e2": rows, "ego, other": rows[2:]})
    assert table.rows == [["a", f"{CLOSE} (2)", ""], ["b", *2 * [f"{FAR} (1)"]]]
    assert not outcome_tables({"ego, e2": [QUIET | ROWS[PREVENTABLE]]})
