"""Whether two tables are equal: every number counts, but those of wall time."""

import copy
import math

import pytest
from e2rl.evaluation.table_comparison import compare_tables

from e2rl.run.errors import InputError


def table():
    def numbers(mean):
        return {"mean": mean, "low": 0.1, "high": math.nan, "n": 4}

    metrics = {"cfr": numbers(0.25), "real": numbers(0.75), "seconds_per_rollout": numbers(1.5)}
    row = {"dataset": "d", "split": "s", "method": "e2", "ego": "idm", "eta": 2.0, "n_rollouts": 4, "git": "abc"}
    paired = {"nominal": {"cfr": {"difference": 0.2}, "seconds_per_rollout": {"difference": 1.0}}}
    return [row | {"metrics": metrics, "paired": paired}, row | {"eta": 1.0, "metrics": metrics, "paired": {}}]


def changed(**values):
    """The table with other values in its first row at dotted keys."""
    rows = [copy.deepcopy(row) for row in table()]  # each with parts of its own
    for path, value in values.items():
        *parents, last = path.split("__")
        part = rows[0]
        for key in parents:
            part = part[key]
        part[last] = value
    return rows


def test_tables_are_equal_but_for_wall_times_and_where_they_were_made():
    now = changed(git="other", metrics__seconds_per_rollout__mean=9.0)
    found = compare_tables(table(), now)
    assert found.different == [] and found.close == 0
    assert found.equal == 2 * (1 + 2 * 4) + 1 and found.text() == "all 19 numbers of its tables are equal"


def test_each_number_that_differs_is_named_with_both_values():
    now = changed(metrics__cfr__mean=0.5, paired__nominal__cfr__difference=math.nan, n_rollouts=3)
    found = compare_tables(table(), now)
    assert [entry[0] for entry in found.different] == [
        "d s e2 idm 2.0: n_rollouts",
        "d s e2 idm 2.0: cfr: mean",
        "d s e2 idm 2.0: paired: nominal: cfr: difference",
    ]
    assert "d s e2 idm 2.0: cfr: mean: 0.25 then, 0.5 now" in found.text() and "16 of 19" in found.text()


def test_rounding_is_told_apart():
    found = compare_tables(table(), changed(metrics__cfr__mean=0.25 * (1 + 1e-9)))
    assert (found.close, found.different) == (1, [])
    assert "18 of 19 numbers of its tables are equal, 1 but for a millionth" in found.text()


def test_rows_that_one_table_lacks_differ():
    found = compare_tables(table(), table()[:1])
    assert found.equal == 10 and {entry[2] for entry in found.different} == {"missing"}
    found = compare_tables(table()[:1], table())
    assert len(found.different) == 9 and {entry[1] for entry in found.different} == {"missing"}


@pytest.mark.parametrize("rows", [[{}], [{"metrics": 1}], ["x"], [None]])
def test_what_is_no_table_is_named(rows):
    with pytest.raises(InputError, match=r"metrics\.json: damaged"):
        compare_tables(rows, rows)
