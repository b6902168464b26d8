"""A gate for continuous integration: is a rate of a run, or its change against a former run, surely within a limit?

The 95% interval decides, not the estimate: a rule holds where the whole interval does, fails where none of it does.
Else rollouts are too few. How many more decide, if the estimate stays, is n (n'/n0 - 1) for n rollouts:

- of a fraction p, n0 and n' are the places of which the exact interval (Clopper, Pearson) ends where the interval found
  does, and where the limit is. Of p = 0 that is n' = ln(0.025) / ln(1 - limit);
- of progress, and of differences, n'/n0 is the square of (half-width / distance of the estimate to the limit).
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from scipy.optimize import brentq

from e2rl.evaluation.comparison import RATES, Driven
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import LEAST, cluster_index, exact_interval, paired_differences, summarise
from e2rl.report.tables import estimate, plural
from e2rl.run.errors import InputError

PASSED, FAILED, UNDECIDED = "passed", "failed", "not enough rollouts"
STATUS = {PASSED: 0, FAILED: 1, UNDECIDED: 3}  # of the command; 2 is that of bad input
RULE = re.compile(r"(?:([^:<>=]+):)?([a-z_]+)(<=|>=)([+-]?)(\d*\.?\d+)")
MOST = 1e9  # places


class Rule(NamedTuple):
    """A limit on one of RATES, such as "preventable<=0.05".

    method: whose traffic, METHOD or METHOD@ETA (None: the only attacked one); most: the limit is an upper one;
    change: it is one on the difference to a former run, as its sign says.
    """

    text: str
    method: str | None
    rate: str
    most: bool
    limit: float
    change: bool

    @classmethod
    def of(cls, text: str) -> "Rule":
        """The rule of a text; InputError where it is none."""
        found = RULE.fullmatch(text.replace(" ", ""))
        if found is None or found[2] not in RATES:
            rates = ", ".join(RATES)
            raise InputError(
                f"{text!r}: no rule; write [METHOD:]RATE<=LIMIT or >=, such as 'preventable<=0.05', or a change as "
                f"'preventable<=+0.02' with --against; rates: {rates}"
            )
        method, rate, sign, change, limit = found.groups()
        return cls(text, method, rate, sign == "<=", float(change + limit), bool(change))

    def rows(self, driven: Driven) -> list[dict]:
        """The rows of a run that it is about; InputError where it names none, or several."""
        groups = {f"{method}@{eta:g}": rows for (method, eta), rows in driven.units().items()}
        wanted = [name for name in groups if self.method in (name, name.rpartition("@")[0])]
        if self.method is None:
            wanted = [name for name in groups if not name.endswith("@0")] or list(groups)
        if len(wanted) != 1:
            reason = "several" if wanted else "no such"
            known = ", ".join(f"'{name}:{self.rate}...'" for name in groups)
            raise InputError(f"{self.text}: {reason} traffic in {driven.run}; name one of {known}")
        return groups[wanted[0]]


def judged(rule: Rule, driven: Driven, former: Driven | None = None) -> dict[str, Any]:
    """What becomes of a rule: `outcome`, value and interval, `more` rollouts (None: no number decides), `reason`.
    Raises InputError for a rate that the run does not know, and for a change without a former run."""
    rows, metric = rule.rows(driven), METRICS[RATES[rule.rate]]
    if rule.change and former is None:
        raise InputError(f"{rule.text}: a limit with a sign is one on a change; name the former run by --against")
    if former is None or not rule.change:
        former, found = None, summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0)[metric.name]
    else:
        others = rule.rows(former)
        samples = [[NO_SAMPLES] * len(each) for each in (rows, others)]
        found = paired_differences(rows, samples[0], others, samples[1], realism_draws=0)[metric.name]
    if not found["n"]:
        raise InputError(f"{rule.text}: {driven.run} knows no {rule.rate}; a search knows no progress")
    value, low, high = (found[name] for name in ("mean" if former is None else "difference", "low", "high"))
    holds, broken = (high <= rule.limit, low > rule.limit) if rule.most else (low >= rule.limit, high < rule.limit)
    outcome, unit = PASSED if holds else FAILED if broken else UNDECIDED, "scene" if driven.searched else "rollout"
    places = cluster_index(*([row[name] for row in rows] for name in ("location", "scene_id")))[1]
    more, advice = None, ""
    if outcome == UNDECIDED:
        factor = growth((value, low, high), rule.limit, places, metric.fraction and former is None)
        more = None if factor is None else max(1, math.ceil(found["n"] * (factor - 1)))
        advice = ": the estimate is at the limit, no number decides" if more is None else f": about {more} more {unit}s"
        advice += f", at {LEAST} places or more; these are at {places}" if places < LEAST else ""
    text = estimate(metric, {"value": value, "low": low, "high": high}, "value", "+" if former else "")
    kind = metric.unit if not metric.fraction else "points" if former else "%"
    reason = f"{outcome}{advice}; {rule.text}: found {text} {kind}, {plural(found['n'], unit)}"
    found = {"value": value, "low": low, "high": high, "n": found["n"], "unit": unit, "places": places}
    return {"rule": rule.text, "outcome": outcome, "more": more, "reason": reason} | found


def growth(found: tuple[float, float, float], limit: float, places: int, fraction: bool) -> float | None:
    """By how many times the places must grow until the interval (value, low, high) ends at the limit, if the value
    stays (see above); None: never. Without an interval, to LEAST places."""
    value, low, high = found
    upper, gap = value < limit, abs(value - limit)
    bound = high if upper else low
    if math.isnan(bound) and places < LEAST:
        return LEAST / places
    if math.isnan(bound) or gap == 0:
        return None
    if not fraction:
        return ((bound - value) / gap) ** 2

    def sample(end: float) -> float:
        """The places of which the exact interval ends there."""
        return math.exp(brentq(lambda log: exact_interval(value, math.exp(log))[upper] - end, 0, math.log(MOST)))

    return sample(limit) / sample(bound)


def junit(results: Sequence[Mapping[str, Any]], run: str) -> bytes:
    """JUnit's XML: a test case for each rule, a failure or, where rollouts are too few, an error."""
    kinds = {FAILED: "failure", UNDECIDED: "error"}
    counts = {f"{kind}s": str(sum(each["outcome"] == name for each in results)) for name, kind in kinds.items()}
    root = ET.Element("testsuites")
    suite = ET.SubElement(root, "testsuite", name="e2rl gate", tests=str(len(results)), skipped="0", **counts)
    for each in results:
        case = ET.SubElement(suite, "testcase", classname=run, name=each["rule"], time="0")
        if each["outcome"] in kinds:
            ET.SubElement(case, kinds[each["outcome"]], message=each["reason"], type=each["outcome"])
        ET.SubElement(case, "system-out").text = each["reason"]
    return ET.tostring(root, "utf-8", xml_declaration=True)
