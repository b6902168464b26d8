"""Tables, files and rules of rates."""

import json
from types import SimpleNamespace

import pytest

from e2rl.report.gate import FAILED, PASSED, UNDECIDED
from e2rl.report.rate_gate import RateRun, judged_rate
from e2rl.report.rates import EgoRates, rate_lines, write_rates
from e2rl.run.errors import InputError
from e2rl.tail.rate import Estimate
from e2rl.tail.sampler import REACHED, SPENT, Tally
from e2rl.tail.summary import UNITS, rates_of, scene_rates

COUNT = 40
KM = 0.1


def rates(ego, factor=1.0):
    """An ego that fails in every other of COUNT scenes with 0.01 times a factor."""
    estimates = []
    for scene in range(COUNT):
        likely = Tally(0.01 * factor, 0.01, contact=0.02 * factor, rollouts=50)
        likely.end = REACHED
        tally = likely if scene % 2 else Tally(bound=1e-4, rollouts=70, end=SPENT)
        estimates.append(Estimate(scene, 0, tally, KM, 0, 0, []))
    names = SimpleNamespace(scene_id=[f"scene {k}" for k in range(COUNT)])
    scenes = scene_rates(estimates, names, "preventable")
    return EgoRates(ego, scenes, target="preventable", steps=80)


@pytest.fixture
def run(tmp_path):
    write_rates(tmp_path, [rates("mine")])
    return tmp_path


def test_the_table_has_the_rate_and_what_may_be_added(run):
    lines = rate_lines([rates("mine")])
    text = "\n".join(lines)
    assert "preventable failures were drawn in 20 of 40 scenes, 2,400 rollouts" in text
    assert "| 50 [" in text  # 0.005 a scene of 0.1 km
    assert "at most about 0.5 more" in text


def test_two_egos_have_their_ratio():
    text = "\n".join(rate_lines([rates("worse", 3.0), rates("mine")]))
    assert "| worse | mine   | preventable | 3 [3, 3]" in text


@pytest.mark.parametrize(
    ("limit", "outcome"), [("200", PASSED), ("10", FAILED), ("51", UNDECIDED)]
)
def test_the_interval_decides(run, limit, outcome):
    result = judged_rate(
        f"preventable_per_1000km<={limit}", RateRun.read(run, None), None
    )
    assert result["outcome"] == outcome
    assert result["value"] == pytest.approx(50)


def test_undecided_rules_say_how_many_scenes_are_needed(run):
    result = judged_rate("preventable_per_1000km<=55", RateRun.read(run, None), None)
    assert "more scenes would tell" in result["reason"]


@pytest.mark.parametrize("unit", UNITS)
def test_what_was_not_drawn_is_added_to_the_interval(run, unit):
    """The limit is above the interval, and below it with what is unresolved."""
    (rate,) = [
        rate
        for rate in rates_of(rates("mine").scenes, steps=80)
        if rate.event == "preventable"
    ]
    high = rate.bounds[unit].high
    more = rate.unresolved[unit]
    for share, outcome in ((0.9, UNDECIDED), (1.1, PASSED)):
        rule = f"preventable_per_{unit}<={high + share * more:.9f}"
        result = judged_rate(rule, RateRun.read(run, None), None)
        assert result["outcome"] == outcome
        assert result["high"] == pytest.approx(high + more)


def test_ratios_are_judged_against_a_former_run(run, tmp_path_factory):
    worse = tmp_path_factory.mktemp("worse")
    write_rates(worse, [rates("mine", 3.0)])
    rule = "preventable_per_1000km<=x1.2"
    now = RateRun.read(worse, None)
    former = RateRun.read(run, None)
    assert judged_rate(rule, now, former)["outcome"] == FAILED
    assert judged_rate(rule, former, now)["outcome"] == PASSED


@pytest.mark.parametrize(
    "rule",
    ["preventable<=0.1", "preventable_per_1000km>=1", "preventable_per_1000km<=x2"],
)
def test_what_is_no_rule_is_refused(run, rule):
    with pytest.raises(InputError, match="no rule on a run of e2rl rate"):
        judged_rate(rule, RateRun.read(run, None), None)


def test_a_damaged_file_is_refused(run):
    entries = json.loads((run / "rates.json").read_text())
    del entries[0]["scenes"][0]["km"]
    (run / "rates.json").write_text(json.dumps(entries))
    with pytest.raises(InputError, match="km is missing"):
        RateRun.read(run, None)
