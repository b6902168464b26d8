"""Rules on rates of a run, or on their changes against a former run: which hold, which
fail, and how many more rollouts would tell.

The 95% interval decides, not the estimate (docs/guide/compare.md).
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from e2rl.evaluation.comparison import RATES, Driven, difference
from e2rl.evaluation.summary import headline
from e2rl.metrics.catalogue import METRICS, Metric
from e2rl.metrics.errored import raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import LEAST, cluster_index, exact_interval, summarise
from e2rl.report.answer import headline_text, traffic_name
from e2rl.report.tables import estimate, plural
from e2rl.run.errors import InputError

PASSED = "passed"
FAILED = "failed"
UNDECIDED = "not enough rollouts"
KINDS = {FAILED: "failure", UNDECIDED: "error"}  # of JUnit
PATTERN = re.compile(  # names of methods may hold spaces
    rf"(?:(?P<method>[^:<>=]+?)\s*:)?\s*(?P<rate>{'|'.join(RATES)})"
    r"\s*(?P<sign><=|>=)\s*(?P<limit>[+-]?\d*\.?\d+)"
)
MOST = 1e9  # places
NEAR = 1e-4  # distance to a limit within which no number of places decides


@dataclass(frozen=True)
class Rule:
    """[METHOD:]RATE<=LIMIT or >=; a limit with a sign is one on a `change`."""

    text: str
    method: str | None
    rate: str
    upper: bool
    limit: float
    change: bool

    @classmethod
    def parse(cls, text: str, former: bool) -> "Rule":
        """The rule of a text, such as "preventable<=0.05", "nominal:contacts<=0.1",
        "e2@2:clean<=0.1", and where there is a `former` run "counted<=+0.02"; raises
        InputError where it is none, or its limit none of its rate."""
        match = PATTERN.fullmatch(text.strip())
        if match is None or (match["limit"][0] in "+-" and not former):
            raise InputError(
                f"{text!r}: no rule; write [METHOD:]RATE<=LIMIT or >=, such as "
                "'preventable<=0.05', or with --against RUN a change, "
                f"'preventable<=+0.02'; rates: {', '.join(RATES)}"
            )
        rule = cls(
            text,
            method=match["method"],
            rate=match["rate"],
            upper=match["sign"] == "<=",
            limit=float(match["limit"]),
            change=match["limit"][0] in "+-",
        )
        fraction = rule.metric.fraction
        low = -1.0 if rule.change else 0.0
        high = 1.0 if fraction else math.inf
        if not low <= rule.limit <= high and (fraction or not rule.change):
            span = f"from {low:g} to {high:g}" if fraction else "of 0 or more"
            mend = ", such as 0.05 for 5%" if fraction else ""
            raise InputError(
                f"{text}: {rule.rate} cannot be {rule.limit:g}; write a number "
                f"{span}{mend}"
            )
        return rule

    @property
    def metric(self) -> Metric:
        return METRICS[RATES[self.rate]]

    def traffic(self, driven: Driven) -> tuple[tuple[str, float], list[dict]]:
        """The traffic that the rule names, or the only attack, and its units;
        InputError for none or several."""
        units = {f"{name}@{eta:g}": (name, eta) for name, eta in driven.units()}
        chosen = [name for name in units if not name.endswith("@0")] or list(units)
        if self.method is not None:
            chosen = [
                name for name in units if self.method in (name, name.rpartition("@")[0])
            ]
        if len(chosen) != 1:
            names = ", ".join(f"{name}:{self.rate}" for name in units)
            raise InputError(
                f"{self.text.strip()}: of which traffic in {driven.run}? write one of "
                f"{names}"
            )
        key = units[chosen[0]]
        return key, driven.units()[key]

    def breaks(self, value: float, raised_share: float) -> bool:
        """Whether rollouts in which the planner raised, a share of all, break the
        limit, whatever becomes of the others."""
        if self.change:
            return False
        if self.metric.fraction:
            return self.upper and self.metric.raised * raised_share > self.limit
        return not self.upper and raised_share == 1 and value < self.limit


def judged(text: str, driven: Driven, former: Driven | None) -> dict[str, Any]:
    """What becomes of a rule: `outcome`, `reason`, value and interval, `more` rollouts
    (None: no number decides).

    Raises InputError where it is no `Rule`, where it names no or several traffic, or
    what the run does not know.
    """
    rule = Rule.parse(text, former=former is not None)
    metric = rule.metric
    key, rows = rule.traffic(driven)
    if not rows:
        raise InputError(
            f"{text}: the traffic raised in all of its rollouts in {driven.run}; mend "
            "the traffic"
        )
    if rule.change and former is not None:
        result = difference(rows, rule.traffic(former)[1])[metric.name]
        value = result["difference"]
    else:
        samples = [NO_SAMPLES] * len(rows)
        result = summarise(rows, samples, realism_draws=0)[metric.name]
        value = result["mean"]
    low = result["low"]
    high = result["high"]
    count = int(result["n"])
    ended = [row[metric.source] for row in rows if not raised(row)]
    if not count or (ended and all(map(math.isnan, ended))):
        raise InputError(
            f"{text}: {driven.run} knows no {rule.rate}, as searches know no progress; "
            "leave the rule out"
        )
    every = driven.traffic()[key]
    crashed = sum(map(raised, rows))
    summary = headline(every, driven.searched)
    alone = math.isnan(low) and rule.breaks(value, crashed / count)
    outcome = UNDECIDED
    if high <= rule.limit if rule.upper else low >= rule.limit:
        outcome = PASSED
    elif (
        (low > rule.limit if rule.upper else high < rule.limit)
        or alone
        and summary.raised == summary.scenes
    ):
        outcome = FAILED
    estimated = estimate(
        metric,
        {"mean": value, "low": low, "high": high},
        name="mean",
        sign="+" if rule.change else "",
    )
    unit = metric.unit or ("points" if rule.change else "%")
    reason = f"{text}: found {estimated} {unit}, {count} {driven.unit}"
    if crashed:
        reason += f", in {crashed} of them the planner raised"
    if alone:
        scenes = plural(summary.scenes, "scene")
        reason += f": these alone break the limit, in {summary.raised} of {scenes}"
    scenes_needed = None
    if outcome == UNDECIDED:
        places = cluster_index(
            [row["location"] for row in rows], [row["scene_id"] for row in rows]
        )[1]
        factor = growth(
            (value, low, high),
            rule.limit,
            places=places,
            fraction=metric.fraction and not rule.change,
        )
        scenes_needed = factor and max(1, math.ceil(count * (factor - 1)))
        advice = "no number decides, the estimate is at the limit"
        if scenes_needed:
            advice = f"about {scenes_needed} more, at further places"
        if places < LEAST:
            advice += f" ({places} places, an interval needs {LEAST})"
        elif math.isnan(low):
            advice = f"fewer than {LEAST} places know it, there is no interval"
        reason = f"{advice}; {reason}"
    reason += f"; {headline_text(summary, driven.ego, traffic_name(every[0]))}"
    names = ("scene_id", "seed", "method", "eta", "raised_by", "error")
    return {
        "rule": text,
        "outcome": outcome,
        "reason": f"{outcome}: {reason}",
        "more": scenes_needed,
        "unit": driven.unit,
        "value": value,
        "low": low,
        "high": high,
        "n": count,
        "headline": summary._asdict(),
        "errored": [
            {name: row[name] for name in names} for row in every if row["errored"] == 1
        ],
    }


def growth(
    estimate: tuple[float, float, float],
    limit: float,
    places: int,
    *,
    fraction: bool,
) -> float | None:
    """By which factor places, and so rollouts, must grow until the interval ends at the
    limit if the value stays; without an interval, to LEAST places; None: none decides.

    Of a fraction, and of a change of 0 at each place, it is m/k, the places of which
    the exact interval (Clopper and Pearson) ends at the limit, and where the one
    measured does; else the square of half-width over distance to the limit.

    Args:
        estimate: value, and the ends of its interval, NaN for none.
        limit: of the value.
        places: that the value rests on.
        fraction: the value is a fraction of events.
    """
    value, low, high = estimate
    alike = value == 0 and math.isclose(high, -low)  # of all places
    if not fraction and alike and math.isclose(high, exact_interval(0.0, places)[1]):
        low = 0.0  # as of a fraction without an event
        limit = abs(limit)
        fraction = True
    upper = value < limit
    end = high if upper else low
    if math.isnan(end) or abs(value - limit) < NEAR:
        return LEAST / places if places < LEAST else None
    if not fraction:
        return ((end - value) / (limit - value)) ** 2

    def sample(end: float) -> float:
        """The places of which the exact interval of the value ends there."""
        from scipy.optimize import brentq

        log = brentq(
            lambda log: exact_interval(value, math.exp(log))[upper] - end,
            0,
            math.log(MOST),
        )
        return math.exp(log)

    return sample(limit) / sample(end)


def junit(
    results: Sequence[Mapping[str, Any]],
    run: str,
    events: Sequence[str],
) -> bytes:
    """JUnit's XML: a test case for each rule, a failure or, where rollouts are too few,
    an error; `events` are lines about the run."""
    outcomes = [result["outcome"] for result in results]
    root = ET.Element("testsuites")
    suite = ET.SubElement(root, "testsuite", name="e2rl gate", tests=str(len(results)))
    for outcome, kind in KINDS.items():
        suite.set(f"{kind}s", str(outcomes.count(outcome)))
    for result in results:
        outcome = result["outcome"]
        reason = result["reason"]
        case = ET.SubElement(suite, "testcase", classname=run, name=result["rule"])
        if outcome in KINDS:
            ET.SubElement(case, KINDS[outcome], message=reason, type=outcome)
        ET.SubElement(case, "system-out").text = "\n".join([reason, *events])
    return ET.tostring(root, "utf-8", xml_declaration=True)
