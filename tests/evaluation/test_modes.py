"""modes.json: fractions, verdicts and typical rollouts of a run's modes, their table,
and replays of them."""

import math

import pytest

from e2rl.evaluation.modes import find_modes, read_modes
from e2rl.evaluation.rollout_files import MODES_FILE, write_json
from e2rl.sim.rollout_file import rollout_name
from tests.metrics.test_failure_modes import CROSSING, REAR_END, failure


def crashes(kind, number, method="e2", eta=2.0, **changes):
    source = {
        "dataset": "d",
        "split": "s",
        "method": method,
        "ego_policy": "idm",
        "eta": eta,
    }
    return [
        failure(kind, scene=f"{kind['approach']} {index}") | source | changes
        for index in range(number)
    ]


def run_rows():
    rows = crashes(CROSSING, 6, counted=1.0, preventable=1.0, at_fault=0.0)
    rows += crashes(
        CROSSING, 2, method="random", counted=0.0, preventable=math.nan, at_fault=0.0
    )
    rows += crashes(
        REAR_END, 4, method="random", counted=1.0, preventable=0.0, at_fault=1.0
    )
    return rows + crashes(CROSSING, 5, method="nominal", eta=0.0, cfr=0.0, approach="")


def test_modes_have_counts_fractions_by_method_and_verdicts(tmp_path):
    rows = run_rows()
    result = find_modes(rows)
    write_json(tmp_path / MODES_FILE, result)
    assert read_modes(tmp_path / MODES_FILE) == result
    crossing, rear_end = result["modes"]
    assert (result["failures"], result["rollouts"], result["unknown"]) == (
        12,
        17,
        ["duty"],
    )
    assert (
        crossing["name"]
        == "crossing from the right, partner turns left, ego keeps speed"
    )
    assert (crossing["count"], crossing["fraction"]) == (8, pytest.approx(8 / 12))
    assert [group["count"] for group in crossing["groups"]] == [6, 2, 0]
    assert [group["fraction"] for group in crossing["groups"]] == [
        1.0,
        pytest.approx(1 / 3),
        None,
    ]
    assert (crossing["counted"], crossing["preventable"], crossing["at_fault"]) == (
        0.75,
        1.0,
        0.0,
    )
    assert rear_end["at_fault"] == 1
    assert rear_end["avoidable"] is None
    assert rear_end["ego_speed"] == 10
    assert [(group["failures"], group["modes"]) for group in result["groups"]] == [
        (6, 1),
        (6, 2),
        (0, 0),
    ]
    assert [row.get("mode") for row in rows] == [1] * 8 + [2] * 4 + [None] * 5
    for mode in result["modes"]:
        typical = mode["typical"]
        same = [
            row
            for row in rows
            if all(
                row[name] == typical[name] for name in ("method", "scene_id", "seed")
            )
        ]
        assert [row["mode"] for row in same] == [mode["mode"]]
        assert typical["file"] == rollout_name(same[0])


def test_small_modes_are_gathered_but_keep_their_numbers():
    rows = (
        crashes(CROSSING, 20)
        + crashes(REAR_END, 1)
        + crashes(REAR_END | {"approach": "oncoming"}, 1)
    )
    result = find_modes(rows)
    assert [(mode["mode"], mode["name"], mode["count"]) for mode in result["modes"]][
        1:
    ] == [(0, "other", 2)]
    assert sorted(row["mode"] for row in rows)[-2:] == [2, 3]
    assert result["groups"][0]["modes"] == 1
