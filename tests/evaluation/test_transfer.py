"""A matrix of known outcomes."""

from math import isnan

import pytest

from e2rl.evaluation.transfer import AGAIN, REPLAY, Matrix
from tests.evaluation.attack_sets import OUTCOMES, known_matrix


@pytest.fixture
def matrix():
    return known_matrix()


def test_a_cell_has_the_rates_of_its_attacks(matrix):
    for (method, ego), outcomes in OUTCOMES.items():
        name = method.removeprefix("against-")
        hit = matrix.rate(REPLAY, name, ego, "hit")
        preventable = matrix.rate(REPLAY, name, ego, "preventable")
        assert hit["mean"] == pytest.approx(sum(k > 0 for k in outcomes) / 3)
        assert preventable["mean"] == pytest.approx(sum(k > 1 for k in outcomes) / 3)
        assert hit["n"] == 3


@pytest.mark.parametrize(
    ("name", "ego", "expected"),
    [
        ("a", "", 1 / 6),
        ("b", "", 2 / 6),
        ("", "a", 2 / 3),
        ("", "b", 1 / 3),
        ("", "c", 0),
    ],
)
def test_sums_leave_a_planner_s_own_attacks_out(matrix, name, ego, expected):
    rate = matrix.rate(REPLAY, name, ego, "preventable")
    assert rate["mean"] == pytest.approx(expected)


def test_what_was_not_driven_is_not_known(matrix):
    assert isnan(matrix.rate(AGAIN, "a", "b", "hit")["mean"])


def test_the_nats_of_a_set_are_the_median(matrix):
    assert matrix.sets[0]["nats"] == 5.0


def test_the_matrix_is_read_as_it_was_written(matrix, tmp_path):
    matrix.write(tmp_path)
    result = Matrix.read(tmp_path)
    assert result.sets == matrix.sets
    assert result.rate(REPLAY, "b", "a", "hit") == matrix.rate(REPLAY, "b", "a", "hit")
