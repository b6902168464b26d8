"""Tries: reproducible from their seed, and spread over their ranges."""

from dataclasses import replace
from random import Random

import pytest

from e2rl.run.errors import InputError
from e2rl.search.tries import Family, family_of
from e2rl.traffic.decisions import RULE, WHOM, Decisions

TIMED = Family("timed", "e2", ranges={"moment": (1.0, 5.0), "strength": (0.5, 1.5)})


def drawn(count, family=TIMED, seed=7):
    return [family.draw(0, number, seed=seed) for number in range(count)]


def test_a_try_is_reproducible_from_its_seed_and_number():
    assert drawn(5) == drawn(5)
    assert drawn(5) != drawn(5, seed=8)
    assert len({single.seed for single in drawn(50)}) == 50


def test_decisions_lie_in_their_range_and_others_follow_the_rule():
    for single in drawn(50):
        result = Decisions(*single.decisions)
        assert 1 <= result.moment <= 5
        assert 0.5 <= result.strength <= 1.5
        assert result._replace(moment=RULE.moment, strength=RULE.strength) == RULE


def test_a_family_without_ranges_is_the_rule():
    assert [
        single.decisions for single in drawn(3, family=Family("rule", "e2", ranges={}))
    ] == [RULE] * 3


def test_tries_look_elsewhere_than_those_before_of_whatever_family():
    """The largest gap between moments of ten tries of a scene, of two families in turn,
    is below that of independent draws."""
    other = replace(TIMED, name="other")

    def gap(moments):
        ordered = sorted(moments)
        return max(b - a for a, b in zip([1.0, *ordered], [*ordered, 5.0], strict=True))

    def spread(seed):
        tries = [
            drawn(10, family=family, seed=seed)[position::2]
            for position, family in enumerate((TIMED, other))
        ]
        return [Decisions(*first.decisions).moment for first in sum(tries, [])]

    draw = Random(0)
    independent = [[draw.uniform(1.0, 5.0) for _ in range(10)] for _ in range(40)]
    gaps = [gap(spread(seed)) for seed in range(40)]
    loose = list(map(gap, independent))
    assert sum(gaps) < 0.8 * sum(loose)
    assert max(gaps) < max(loose)


def test_a_family_is_read_from_its_configuration():
    inputs = {
        "whom": "crossing",
        "patience": [1, 3],
        "chance": 0.3,
        "method": "e2_pursuit",
        "changes": {"reselect": 1},
    }
    family = family_of("crossing", inputs, where="search.families")
    assert (family.method, family.chance, family.changes) == (
        "e2_pursuit",
        0.3,
        {"reselect": 1},
    )
    assert family.ranges == {
        "whom": float(WHOM.index("crossing")),
        "patience": (1.0, 3.0),
    }


@pytest.mark.parametrize(
    "given",
    [
        {"speed": 3}, {"whom": "trucks"}, {"patience": "late"}, {"patience": [1, 2, 3]}, {"patience": [2, 1]}, 3,
        {"strength": -3},
        {"chance": 2}, {"chance": "x"}, {"nfe": 0}, {"changes": "abc"},
    ],
)  # fmt: skip
def test_what_is_no_decision_is_told_where_it_stands(given):
    with pytest.raises(InputError, match=r"search\.families\.odd"):
        family_of("odd", given, where="search.families")
