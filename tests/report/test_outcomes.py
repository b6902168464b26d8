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
    SPENT,
    UNATTACKED,
    UNREACHED,
    UNSPENT,
    outcome,
    outcome_line,
    outcome_table,
)

QUIET = {
    "scene_id": "a",
    "errored": 0.0,
    "cfr": 0.0,
    "cfr_preventable": 0.0,
    "eta": 2.0,
    "ttc_c": 0.1,
    "margin": -9.0,
    "min_dtc": 5.04,
}
ROWS = {  # what differs from QUIET
    PREVENTABLE: {"cfr": 1.0, "cfr_preventable": 1.0, "margin": 2.0},
    RAISED: {"errored": 1.0, "raised_by": "ego", "cfr": math.nan},
    CONTACT: {"cfr": 1.0, "margin": 0.3},
    CLOSE: {"margin": -2.0},
    UNREACHED: {"margin": -2.1},
    FAR: {"margin": -2.1, "eta": 0.0, "ttc_c": math.nan},
    UNATTACKED: {"ttc_c": math.nan, "margin": -1.0},
    OVERLAP: {"cfr": math.nan, "cfr_preventable": math.nan},
    LOST: {"errored": 1.0, "raised_by": "traffic", "cfr": math.nan},
}


@pytest.mark.parametrize("name", ROWS)
def test_a_rollout_has_its_outcome(name):
    assert outcome(QUIET | ROWS[name]) == name


def test_traffic_without_intensity_chooses_no_adversary():
    assert outcome(QUIET | ROWS[UNATTACKED] | {"eta": 0.0}) == CLOSE


def test_a_scene_has_the_worst_outcome_of_its_rollouts_and_the_smallest_gap():
    near = QUIET | ROWS[CLOSE] | {"min_dtc": 0.31}
    rows = [QUIET | ROWS[UNREACHED], near, QUIET | {"scene_id": "b"}]
    assert outcome_line(rows) == f"Of 2 scenes: {CLOSE} in 1; {UNREACHED} in 1."
    table = outcome_table({"ego, e2": rows, "ego, other": rows[2:]}, searched=False)
    assert table["rows"] == [
        ["a", f"{CLOSE}, gap 0.31 m (2)", ""],
        ["b", *2 * [f"{UNREACHED}, gap 5 m (1)"]],
    ]
    assert table["names"] == [CLOSE, UNREACHED]


def test_a_contact_has_no_gap():
    rows = [QUIET | ROWS[CONTACT] | {"min_dtc": 0.0}, QUIET]
    table = outcome_table({"ego, e2": rows}, searched=False)
    assert table["rows"] == [["a", f"{CONTACT} (2)"]]


def test_where_every_scene_has_a_failure_there_is_nothing_to_explain():
    rows = [QUIET | ROWS[PREVENTABLE], QUIET]
    assert outcome_table({"ego, e2": rows}, searched=False) is None


def test_only_a_search_has_spent_a_budget():
    for searched, text, other in ((True, SPENT, UNSPENT), (False, UNSPENT, SPENT)):
        caption = outcome_table({"ego, e2": [QUIET]}, searched=searched)["caption"]
        assert text in caption
        assert other not in caption
