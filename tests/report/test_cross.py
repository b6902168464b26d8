"""The matrix of known outcomes in words and as tables."""

import pytest

from e2rl.report.cross import cross_tables, headline
from tests.evaluation.attack_sets import known_matrix


@pytest.fixture
def matrix():
    return known_matrix()


def test_the_headline_names_the_set_and_the_planner_of_most_failures(matrix):
    assert headline(matrix) == (
        "Preventable failures in attacks on others: 25% of rollouts; most in those on b "
        "(33% of 6), most of a (67% of 3). No attacks are on c."
    )


def test_a_row_is_who_drives_and_a_column_against_whom(matrix):
    preventable, contacts = cross_tables(matrix, narrow=True)
    assert preventable.head == ["", "a", "b", "others"]
    assert preventable.rows == [
        ["a", "100", "67", "67"],
        ["b", "33", "100", "33"],
        ["c", "0", "0", "0"],
        ["others", "17", "33", "25"],
        ["attacks", "3", "3", ""],
        ["scenes", "3", "3", ""],
        ["nats", "5", "5", ""],
    ]
    assert contacts.rows[2] == ["c", "0", "67", "33"]


def test_a_number_leads_to_the_failures_of_its_cell(matrix):
    table = cross_tables(matrix)[0]
    assert table.links[2] == ["#group=against-a/c", "#group=against-b/c"]


def test_columns_have_numbers_where_names_find_no_room(matrix):
    names = {ego: ego * 40 for ego in matrix.egos}
    for entry in matrix.sets:
        entry["name"] = names[entry["name"]]
    for cell in matrix.cells:
        cell["ego"] = names.get(cell["ego"], "")
        cell["set"] = names.get(cell["set"], "")
    matrix.egos[:] = names.values()
    table = cross_tables(matrix, narrow=True)[0]
    assert table.head == ["", "1", "2", "others"]
    assert table.rows[1] == [f"2 {names['b']}", "33", "100", "33"]
