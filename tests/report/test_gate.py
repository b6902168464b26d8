"""The gate: the interval decides, its status and files say so, and the number of further rollouts suffices."""

import json
import math
import xml.etree.ElementTree as ET

import pytest
from scipy.stats import binom

from e2rl.metrics.statistics import LEAST, Z, exact_interval
from e2rl.report.gate import growth, main
from tests.evaluation.constructed_runs import row_of, run_of


def gate(capsys, *arguments):
    """Status and what is said."""
    with pytest.raises(SystemExit) as end:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return end.value.code, said.out + said.err


def run_with(folder, places, hits, **settings):
    """A run of one rollout at each place, `hits` of them contacts, and a nominal one without."""
    rows = [row_of(k, hit=k < hits, progress=30.0 + k % 7) for k in range(places)]
    return run_of(folder, rows + [row_of(k, method="nominal", eta=0.0) for k in range(places)], settings)


@pytest.mark.parametrize(("limit", "places"), [(0.05, 20), (0.1, 12), (0.01, 30)])
def test_without_an_event_the_number_is_that_of_the_binomial(limit, places):
    """(1 - limit)^m = 0.025."""
    high = exact_interval(0.0, places)[1]
    needed = places * growth((0.0, 0.0, high), limit, places, True)
    assert needed == pytest.approx(math.log(0.025) / math.log(1 - limit), rel=1e-6)
    assert binom.pmf(0, math.ceil(needed), limit) <= 0.025 < binom.pmf(0, math.floor(needed), limit)


@pytest.mark.parametrize(("value", "limit"), [(0.2, 0.21), (0.2, 0.19), (0.5, 0.51)])
def test_of_many_places_the_number_is_that_of_the_normal_law(value, limit):
    """m = z^2 p (1 - p) / (limit - p)^2."""
    ends = exact_interval(value, 100)
    needed = 100 * growth((value, *ends), limit, 100, True)
    assert needed == pytest.approx(Z**2 * value * (1 - value) / (limit - value) ** 2, rel=0.05)
    assert exact_interval(value, needed)[value < limit] == pytest.approx(limit, abs=1e-6)


def test_intervals_of_means_shrink_with_the_root():
    half, gap = 4.0, 1.0
    assert growth((30.0, 30 - half, 30 + half), 30 - gap, 50, False) == pytest.approx((half / gap) ** 2)
    assert growth((30.0, 26.0, 34.0), 30.0, 50, False) is None
    assert growth((0.2, 0.1, 0.3), 0.2 + 1e-12, 50, True) is None
    assert growth((0.1, math.nan, math.nan), 0.2, 4, True) == LEAST / 4


def test_the_rollouts_that_it_asks_for_decide(tmp_path, capsys):
    run, file = run_with(tmp_path / "few", 30, 0), tmp_path / "gate.json"
    status, said = gate(capsys, run, "preventable<=0.05", "--json", file)
    (result,) = json.loads(file.read_text())
    assert (
        status == 3
        and f"not enough rollouts: about {result['more']} more, at further places; preventable<=0.05: found 0.0" in said
    )
    enough = run_with(tmp_path / "enough", 30 + result["more"], 0)
    assert gate(capsys, enough, "preventable<=0.05")[0] == 0
    assert gate(capsys, run_with(tmp_path / "short", 29 + result["more"], 0), "preventable<=0.05")[0] == 3


@pytest.mark.parametrize(
    ("rules", "status"),
    [
        (["preventable<=0.6"], 0),
        (["preventable<=0.2"], 1),
        (["preventable<=0.45"], 3),
        (["contacts>=0.2"], 0),
        (["contacts>=0.6"], 1),
        (["nominal:contacts<=0.2", "e2@2:progress>=20"], 0),
        (["preventable<=0.45", "contacts<=0.6"], 3),
        (["preventable<=0.45", "contacts<=0.2"], 1),
        (["progress<=20"], 1),
        (["preventable<=0.4"], 3),
    ],
)
def test_the_interval_decides_and_a_failure_outweighs_doubt(tmp_path, capsys, rules, status):
    """40 of 100 places: the interval is about 0.31 to 0.50."""
    found, said = gate(capsys, run_with(tmp_path, 100, 40), *rules)
    assert found == status and len(said.splitlines()) == len(rules) and all(rule in said for rule in rules)


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        (["preventable<0.05"], "no rule"),
        (["crashes<=0.05"], "rates: contacts, counted"),
        (["idm:contacts<=0.05"], "of which traffic in"),
        (["contacts<=+0.02"], "with --against RUN"),
        (["contacts<=0.05", "--ego", "b"], "has the egos a"),
    ],
)
def test_bad_rules_have_the_status_of_bad_input(tmp_path, capsys, rules, said):
    status, text = gate(capsys, run_with(tmp_path, 12, 1), *rules)
    assert status == 2 and said in text and len(text.splitlines()) == 1


def test_an_attack_must_be_named_where_there_are_several(tmp_path, capsys):
    run = run_of(tmp_path, [row_of(k, eta=eta) for k in range(40) for eta in (1.0, 2.0)])
    status, said = gate(capsys, run, "contacts<=0.2")
    assert status == 2 and "e2@1:contacts, e2@2:contacts" in said
    assert gate(capsys, run, "e2@1:contacts<=0.2")[0] == 0


def test_changes_are_measured_against_a_former_run(tmp_path, capsys):
    before, after = run_with(tmp_path / "before", 200, 60), run_with(tmp_path / "after", 200, 20)
    against = ("--against", before)
    assert gate(capsys, after, "contacts<=+0.02", *against)[0] == 0
    assert gate(capsys, after, "contacts<=-0.1", *against)[0] == 0
    assert gate(capsys, before, "contacts<=+0.02", "--against", after)[0] == 1
    assert gate(capsys, after, "contacts<=-0.2", *against)[0] == 3
    assert "no rule is on a change" in gate(capsys, after, "contacts<=0.2", *against)[1]
    other = run_with(tmp_path / "other", 200, 20, seeds=[7])
    status, said = gate(capsys, other, "contacts<=+0.02", *against)
    assert status == 2 and "which has other seeds" in said


SCHEMA = {  # of JUnit: element: (attributes it must have, attributes it may have, children)
    "testsuites": ((), (), {"testsuite"}),
    "testsuite": (("name", "tests", "failures", "errors"), ("skipped", "time"), {"testcase"}),
    "testcase": (("classname", "name"), ("time",), {"failure", "error", "skipped", "system-out"}),
    "failure": (("message",), ("type",), set()),
    "error": (("message",), ("type",), set()),
    "system-out": ((), (), set()),
}


def check(node):
    must, may, children = SCHEMA[node.tag]
    assert set(must) <= set(node.attrib) <= {*must, *may} and {child.tag for child in node} <= children
    for child in node:
        check(child)


def test_the_files_for_continuous_integration_hold_what_was_decided(tmp_path, capsys):
    rules = ["preventable<=0.6", "preventable<=0.2", "preventable<=0.45"]
    files = [tmp_path / "out" / "gate.xml", tmp_path / "out" / "gate.json"]
    run = run_with(tmp_path / "run", 100, 40)
    gate(capsys, run, *rules, "--junit", files[0], "--json", files[1])
    root = ET.fromstring(files[0].read_text())
    check(root)
    (suite,) = root
    assert [suite.get(name) for name in ("tests", "failures", "errors")] == ["3", "1", "1"]
    assert [[child.tag for child in case][0] for case in suite] == ["system-out", "failure", "error"]
    results = json.loads(files[1].read_text())
    assert [each["outcome"] for each in results] == ["passed", "failed", "not enough rollouts"]
    assert [case.get("name") for case in suite] == rules == [each["rule"] for each in results]
    assert all(each["value"] == 0.4 and each["low"] < 0.4 < each["high"] for each in results)
