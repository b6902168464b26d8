"""Scenes in which searches fail several egos: a scene counts once, trainings are
pooled, egos are compared by scene."""

import pytest

from e2rl.evaluation.ego_set import EgoSet
from e2rl.evaluation.summary import scene_rows
from e2rl.report.comparison_tables import searched_table
from e2rl.search.tries import TRIES

TRAINED = ["a_0", "a_1"]
OTHERS = ["b_0", "b_1"]
EGOS = EgoSet({}, ["a", "b"], pairs=[("a", "b")], trainings={"a": TRAINED, "b": OTHERS})


def tries(ego, failed, scenes=60, each=3, seed=0):
    """`each` tries of every scene, each at its own place; the last try of scenes
    `failed` is a preventable contact."""
    about = {
        "dataset": "d",
        "split": "s",
        "method": "search",
        "ego_policy": ego,
        "eta": 2.0,
    }
    rows = []
    for scene in range(scenes):
        for number in range(each):
            hit = float(scene in failed and number == each - 1)
            events = {"cfr": hit, "cfr_counted": hit, "cfr_preventable": hit}
            place = {
                "scene_id": f"{scene}",
                "location": f"{scene}",
                "seed": seed * TRIES + number,
            }
            rows.append(about | place | events)
    return rows


def test_a_scene_counts_once_however_often_it_is_tried():
    rows = tries("a_0", {1, 2}) + tries("a_0", {1}, seed=1)
    found = scene_rows(rows + rows)
    assert len(found) == 120 and sum(row["cfr_preventable"] for row in found) == 3
    assert {row["seed"] for row in found} == {0, 1}


def test_trainings_are_pooled_and_compared_by_scene():
    """Policy a fails in 12 and 18 of 60 scenes, policy b in 30 in both of its
    trainings."""
    rows = tries("a_0", set(range(12))) + tries("a_1", set(range(18)))
    rows += tries("b_0", set(range(30))) + tries("b_1", set(range(30)))
    table = searched_table(rows, EGOS)
    lines = {line[0]: line[1:] for line in table.rows}
    ours, theirs = (lines[f"{name} (2 trainings), search"] for name in ("a", "b"))
    assert (
        ours[0].split()[0] == "25.0"
        and theirs[0].split()[0] == "50.0"
        and ours[3].split()[0] == "-25.0"
    )
    low, high = (float(end.strip("[],*")) for end in ours[3].split()[1:])
    assert low < -25 < high < 0 and ours[3].endswith("*"), (
        "of 60 places and two trainings"
    )
    assert ours[-1].split()[0] == "-50" and theirs[3] == "–"
    assert len(lines) == 6 and lines["a_1, search"][0].split()[0] == "30.0"


@pytest.mark.parametrize("pairs", [[], [("a_0", "b_0"), ("a_0", "b_1")]])
def test_egos_may_be_compared_with_none_or_with_the_first(pairs):
    rows = tries("a_0", {1}) + tries("b_0", {1}) + tries("b_1", set())
    table = searched_table(rows, EgoSet({}, ["a_0", "b_0", "b_1"], pairs=pairs))
    assert [line[0] for line in table.rows] == [
        "a_0, search",
        "b_0, search",
        "b_1, search",
    ]
    assert (table.rows[0][4] == "–") == (not pairs)
