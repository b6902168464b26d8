"""Two runs side by side: each failure is new, gone, moved or the same; what is no pair
is refused by name."""

import math

import pytest

from e2rl.evaluation.comparison import CHANGES, Driven, compared
from e2rl.metrics.errored import errored_row
from e2rl.run.errors import InputError
from e2rl.search.tries import TRIES, TRIES_FILE
from tests.evaluation.constructed_runs import row_of, run_of


def changes_of(folder, rows, others, searched=False):
    """Groups and pairs of two runs with these rows."""
    sides = [
        run_of(folder / name, item) for name, item in (("one", rows), ("two", others))
    ]
    for side in sides if searched else ():
        (side / TRIES_FILE).write_text("")
    return compared(*map(Driven.read, sides))


def test_each_failure_is_new_gone_moved_or_the_same(tmp_path):
    first = [
        row_of(0),
        row_of(1, hit=True),
        row_of(2, hit=True),
        row_of(3, hit=True),
        row_of(4),
        row_of(5, seed=1),
    ]
    second = [
        row_of(0, hit=True),
        row_of(1),
        row_of(2, hit=True),
        row_of(3, hit={"partner": 4}),
        row_of(4),
    ]
    (group,), pairs = changes_of(tmp_path, first, others=second)
    result = {pair["scene_id"]: pair["change"] for pair in pairs}
    assert result == {
        "scene_0": "new",
        "scene_1": "gone",
        "scene_2": "same",
        "scene_3": "moved",
    }
    assert [pair["change"] for pair in pairs] == list(CHANGES), "in this order"
    assert group["of"] == 5
    assert [group[name] for name in CHANGES] == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"partner": 4}, ["counterpart"]),
        ({"contact_type": "rear"}, ["side"]),
        ({"at_fault": 1.0}, ["verdict"]),
        ({"preventable": math.nan, "counted": 0.0}, ["verdict"]),
        ({"contact_time": 2.6}, ["time"]),
        ({"contact_time": 1.5}, []),
        ({"partner": 4, "contact_time": 4.0}, ["counterpart", "time"]),
        ({"ego_speed": 3.0, "approach": "ahead"}, []),
    ],
)
def test_a_failure_moves_with_its_verdict_side_counterpart_or_time(
    tmp_path, change, what
):
    _, (pair,) = changes_of(
        tmp_path, [row_of(0, hit=True)], others=[row_of(0, hit=change)]
    )
    assert pair["what"] == what
    assert pair["change"] == ("moved" if what else "same")


def test_exchanging_the_two_exchanges_new_and_gone_and_turns_differences_round(
    tmp_path,
):
    first = [row_of(k, hit=k % 3 == 0, progress=30.0 + k) for k in range(24)]
    second = [row_of(k, hit=k % 4 == 0) for k in range(24)]
    (group,), _ = changes_of(tmp_path / "there", first, others=second)
    (back,), _ = changes_of(tmp_path / "back", second, others=first)
    assert (
        (group["new"], group["gone"], group["same"])
        == (back["gone"], back["new"], back["same"])
        == (4, 6, 2)
    )
    for name, value in group["differences"].items():
        other = back["differences"][name]
        assert value["difference"] == pytest.approx(-other["difference"]), name
        assert (value["low"], value["high"]) == pytest.approx(
            (-other["high"], -other["low"]), abs=0.05
        ), name
    assert group["differences"]["contacts"]["difference"] == pytest.approx(
        6 / 24 - 8 / 24
    )
    assert group["differences"]["progress"]["difference"] == pytest.approx(-11.5)


def test_a_run_has_no_difference_to_itself(tmp_path):
    rows = [row_of(k, hit=k % 2 == 0, progress=float(k)) for k in range(24)]
    (group,), _ = changes_of(tmp_path, rows, others=rows)
    assert group["same"] == 12
    assert not any(group[name] for name in CHANGES[:3])
    for name, value in group["differences"].items():
        assert value["difference"] == 0
        assert not (value["low"] > 0 or value["high"] < 0), name


def test_an_ego_that_reverses_makes_negative_progress(tmp_path):
    runs = [
        Driven.read(
            run_of(tmp_path / name, [row_of(k, progress=metres) for k in range(12)])
        )
        for name, metres in (("before", -0.375), ("after", 4.0))
    ]
    ((group,), _) = compared(*runs)
    assert group["differences"]["progress"]["difference"] == 4.375


def test_two_egos_of_one_run_and_none_by_chance(tmp_path):
    rows = [row_of(k, hit=k == 0) for k in range(3)] + [
        row_of(k, hit=k == 1, ego="b") for k in range(3)
    ]
    run = run_of(tmp_path, rows)
    (group,), _ = compared(Driven.read(run, "a"), Driven.read(run, "b"))
    assert (group["new"], group["gone"]) == (1, 1)
    with pytest.raises(InputError, match="has the egos a, b; name one by"):
        Driven.read(run)


@pytest.mark.parametrize(
    ("settings", "inputs", "told"),
    [
        ({"seeds": [0]}, {}, r"seeds \(\[0, 1\] and \[0\]\)"),
        ({"eta": 1.0}, {}, r"eta \(2.0 and 1.0\)"),
        ({"prior": {"checkpoint": "mine"}}, {}, r"prior\.checkpoint \(.* and mine\)"),
        ({}, {"prior.checkpoint=p": "77"}, "prior.checkpoint=p"),
        ({}, {"synthesizer=e2": {"gain": 2.0}}, "synthesizer=e2"),
        ({"budget": [640.0]}, {}, "budget"),
        ({}, {"scenes": "other"}, r"scenes \(3 and 2, 1 of one id\)"),
    ],
)
def test_runs_that_are_no_pairs_are_refused_by_what_differs(
    tmp_path, settings, inputs, told
):
    first = run_of(tmp_path / "one", [row_of(k) for k in range(3)])
    two = run_of(
        tmp_path / "two", [row_of(k) for k in (2, 9)], settings=settings, inputs=inputs
    )
    with pytest.raises(
        InputError, match=f"two: no pairs with .*one, which has other {told}"
    ):
        compared(Driven.read(first), Driven.read(two))


def test_contacts_with_people_are_compared_where_there_are_any(tmp_path):
    first, second = (
        [row_of(k, cfr_vru=float(k < count)) for k in range(12)] for count in (1, 4)
    )
    (group,), pairs = changes_of(tmp_path / "some", first, others=second)
    assert group["differences"]["contacts_vru"]["difference"] == pytest.approx(3 / 12)
    assert not pairs
    assert "contacts_object" not in group["differences"]


def test_another_planner_version_or_machine_may_differ(tmp_path):
    first = run_of(tmp_path / "one", [row_of(0)])
    two = run_of(
        tmp_path / "two",
        [row_of(0, ego="b")],
        settings={"ego": {"x": 1}, "processes": 8},
        inputs={"ego.file=b.pt": "9"},
    )
    assert compared(Driven.read(first), Driven.read(two))[0][0]["of"] == 1


def tries(scene, *hits, seed=0):
    return [
        row_of(scene, seed=seed * TRIES + number, hit=hit)
        for number, hit in enumerate(hits)
    ]


def test_searches_are_compared_by_scene_and_move_where_they_share_no_way(tmp_path):
    """However many tries there are, and in whatever order."""
    other = {"contact_type": "rear"}
    slow = {"ego_speed": 2.0}
    first = [
        *tries(0, False, True, True),
        *tries(1, True, other),
        *tries(2, False),
        *tries(3, True),
    ]
    second = [
        *tries(0, False),
        *tries(1, slow, False, True),
        *tries(2, False, True),
        *tries(3, slow, other),
    ]
    (group,), pairs = changes_of(tmp_path, first, others=second, searched=True)
    assert {pair["scene_id"]: pair["change"] for pair in pairs} == {
        **{"scene_0": "gone", "scene_1": "same", "scene_2": "new", "scene_3": "moved"}
    }
    assert group["of"] == 4
    assert group["unit"] == "searches of a scene"
    assert group["differences"]["preventable"]["difference"] == 0
    assert "progress" not in group["differences"]


def test_a_search_shows_its_failure_or_what_came_nearest(tmp_path):
    nearest = [
        row_of(0, seed=number, margin=margin)
        for number, margin in enumerate((-9.0, -0.5, -3.0))
    ]
    _, (pair,) = changes_of(
        tmp_path, nearest, others=tries(0, False, False, True), searched=True
    )
    assert pair["first"]["seed"] == 1
    assert pair["second"]["seed"] == 2


def raised(scene, seed=0, by="ego"):
    return errored_row(
        row_of(scene, seed)
        | {"reason": "raised KeyError", "detail": "lane", "raised_by": by}
    )


@pytest.mark.parametrize("searched", [False, True])
def test_a_planner_that_raises_is_a_failure_of_its_own_kind(tmp_path, searched):
    first = [
        row_of(0),
        raised(1),
        raised(2),
        row_of(3, hit=True),
        raised(4, by="traffic"),
    ]
    second = [raised(0), row_of(1), raised(2), raised(3), row_of(4)]
    (group,), pairs = changes_of(tmp_path, first, others=second, searched=searched)
    result = {pair["scene_id"]: (pair["change"], pair["what"]) for pair in pairs}
    assert result == {
        **{
            "scene_0": ("new", []),
            "scene_1": ("gone", []),
            "scene_2": ("same", []),
            "scene_3": ("moved", ["ending"]),
        }
    }
    assert group["preventable"] == {"new": 1, "gone": 1, "moved": 1, "same": 1}, (
        "to raise is a preventable failure"
    )
    assert group["differences"]["preventable"]["difference"] == 0
    assert group["of"] == 4, "what the traffic lost is no pair"
    assert group["differences"]["contacts"]["difference"] == 0
