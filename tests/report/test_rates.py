"""Tables, files and rules of rates."""

import json

import pytest
import torch

from e2rl.driving.scored import Scored
from e2rl.evaluation.rates import EgoRates, write_rates
from e2rl.report.gate import FAILED, PASSED, UNDECIDED
from e2rl.report.rate_gate import judged_rate, rates_of_run
from e2rl.report.rates import number, rate_tables, summary_lines
from e2rl.run.errors import InputError
from e2rl.tail.interval import Side, of_ratio
from tests.report.known_rates import COUNT, KM, ego_rates


@pytest.fixture
def run(tmp_path):
    write_rates(tmp_path, [ego_rates("mine")], Scored())
    return tmp_path


def cells(table):
    """The rows of a table by their first cells."""
    return [dict(zip(table.head, row, strict=True)) for row in table.rows]


def test_the_lines_have_the_rate_and_what_was_spent():
    lines = summary_lines(ego_rates("mine"))
    assert "mine in traffic as the prior has it: 50 [" in lines[0]
    assert lines[1] == "They were drawn in 20 of 40 scenes, by 2,400 rollouts."


def test_the_interval_s_end_holds_what_was_not_drawn():
    """20 of 40 scenes of 0.1 km may have 1e-4 each: 0.5 per 1,000 km."""
    mine = ego_rates("mine")
    names = sorted(scene["scene_id"] for scene in mine.scenes)
    without = of_ratio(
        Side(
            [torch.tensor([scene["probability"]]) for scene in mine.scenes],
            torch.full((COUNT,), KM / 1000).double(),
            torch.tensor([names.index(scene["scene_id"]) for scene in mine.scenes]),
        )
    )
    bounds = mine.rates["preventable"]["1000km"]
    assert bounds.high == pytest.approx(without.high + 0.5)


def test_two_egos_have_their_ratio():
    tables = rate_tables([ego_rates("worse", 3.0), ego_rates("mine")])
    (row,) = [row for row in cells(tables[1]) if row["event"] == "preventable"]
    assert row["ratio per km"] == "3 [3, 3]"


def test_the_ratio_of_two_that_never_fail_is_unknown():
    tables = rate_tables([ego_rates("one", 0.0), ego_rates("other", 0.0)])
    (row,) = [row for row in cells(tables[1]) if row["event"] == "contact"]
    assert row["ratio per km"] == "–"


def test_failures_are_counted_by_what_they_cost():
    """-log 0.01 is 4.6 nats, in half of the scenes; beyond 11.5 nobody looked."""
    table = rate_tables([ego_rates("mine")])[1]
    assert {row["nats"]: row["scenes"] for row in cells(table)} == {
        "5": "20 of 40",
        "10": "20 of 40",
    }


def test_rates_are_read_as_they_were_written(run):
    (read,) = EgoRates.read(run)
    written = ego_rates("mine")
    assert read.rates == written.rates
    names = [scene["scene_id"] for scene in written.scenes]
    assert [scene["scene_id"] for scene in read.scenes] == names


@pytest.mark.parametrize(
    ("limit", "outcome"), [("200", PASSED), ("10", FAILED), ("51", UNDECIDED)]
)
def test_the_interval_decides(run, limit, outcome):
    result = judged_rate(
        f"preventable_per_1000km<={limit}", rates_of_run(run, None), None
    )
    assert result["outcome"] == outcome
    assert result["value"] == pytest.approx(50)


def test_undecided_rules_say_how_many_scenes_are_needed(run):
    result = judged_rate("preventable_per_1000km<=55", rates_of_run(run, None), None)
    assert "more scenes would tell" in result["reason"]


def test_ratios_are_judged_against_a_former_run(run, tmp_path_factory):
    worse = tmp_path_factory.mktemp("worse")
    write_rates(worse, [ego_rates("mine", 3.0)], Scored())
    rule = "preventable_per_1000km<=x1.2"
    now = rates_of_run(worse, None)
    former = rates_of_run(run, None)
    assert judged_rate(rule, now, former)["outcome"] == FAILED
    assert judged_rate(rule, former, now)["outcome"] == PASSED


@pytest.mark.parametrize(
    "rule",
    ["preventable<=0.1", "preventable_per_1000km>=1", "preventable_per_1000km<=x2"],
)
def test_what_is_no_rule_is_refused(run, rule):
    with pytest.raises(InputError, match="no rule on a run of e2rl rate"):
        judged_rate(rule, rates_of_run(run, None), None)


def test_a_damaged_file_is_refused(run):
    entries = json.loads((run / "rates.json").read_text())
    del entries[0]["scenes"][0]["km"]
    (run / "rates.json").write_text(json.dumps(entries))
    with pytest.raises(InputError, match="km is missing"):
        rates_of_run(run, None)


@pytest.mark.parametrize(
    ("value", "digits", "words"),
    [(0.00312, 3, "0.00312"), (24.4, 2, "24"), (1234.5, 2, "1,234"), (0.0, 2, "0")],
)
def test_numbers_have_all_digits_before_the_point(value, digits, words):
    assert number(value, digits) == words
