"""`e2rl gate RUN RULE ...`: whether rates of a run, or their changes against a former
run, are within limits.

The 95% interval decides, not the estimate: a rule holds where the whole interval does,
fails where none of it does. The status is 0 where all hold, 1 where one fails, 3 where
none fails and rollouts are too few, 2 for bad input (docs/how-to/compare.md). A rollout
in which the planner raised has failed; where it raised in every scene, and these
rollouts alone break a limit, a rule fails without an interval, too.
"""

import argparse
import math
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.optimize import brentq

from e2rl.evaluation.comparison import RATES, Driven, check_shared, difference
from e2rl.evaluation.headline import headline
from e2rl.evaluation.rollout_files import write_json
from e2rl.metrics.catalogue import METRICS, Metric
from e2rl.metrics.errored import raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import LEAST, Row, cluster_index, exact_interval, summarise
from e2rl.report.headline import (
    errored_lines,
    headline_text,
    plural,
    touched_lines,
    traffic_name,
)
from e2rl.report.tables import estimate
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically

PASSED = "passed"
FAILED = "failed"
UNDECIDED = "not enough rollouts"
STATUS = {FAILED: 1, UNDECIDED: 3, PASSED: 0}  # of the command, the first that applies
KINDS = {FAILED: "failure", UNDECIDED: "error"}  # of JUnit
RULE = re.compile(  # names of methods may hold spaces
    rf"(?:(?P<method>[^:<>=]+?)\s*:)?\s*(?P<rate>{'|'.join(RATES)})\s*(?P<sign><=|>=)\s*(?P<limit>[+-]?\d*\.?\d+)"
)
MOST, NEAR = (
    1e9,
    1e-4,
)  # places; distance to a limit within which no number of them decides


def judged(text: str, driven: Driven, former: Driven | None) -> dict[str, Any]:
    """What becomes of a rule: `outcome`, `reason`, value and interval, `more` rollouts
    (None: no number decides).

    Args:
        text: [METHOD:]RATE<=LIMIT or >=, such as "preventable<=0.05",
            "nominal:contacts<=0.1", "e2@2:clean<=0.1"; the
            method may be left out where one attack was driven. A limit with a sign, "counted<=+0.02", is one on the
            change against `former`.

    Raises:
        InputError: it is no rule, its limit is none of its rate, it names no or several
            traffic, or what the run does
            not know.
    """
    rule = RULE.fullmatch(text.strip())
    if rule is None or (rule["limit"][0] in "+-" and former is None):
        raise InputError(
            f"{text!r}: no rule; write [METHOD:]RATE<=LIMIT or >=, such as 'preventable<=0.05', or with --against RUN "
            f"a change, 'preventable<=+0.02'; rates: {', '.join(RATES)}"
        )
    limit = float(rule["limit"])
    metric = METRICS[RATES[rule["rate"]]]
    change = rule["limit"][0] in "+-"
    check_limit(text, rule["rate"], limit, metric, change)
    key, rows = traffic_of(rule, driven)
    if not rows:
        raise InputError(
            f"{text}: the traffic raised in all of its rollouts in {driven.run}; mend the traffic"
        )
    if change and former is not None:
        found = difference(rows, traffic_of(rule, former)[1])[metric.name]
    else:
        found = summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0)[metric.name]
    ended = [row for row in rows if not raised(row)]
    if not (count := int(found["n"])) or (
        ended and all(math.isnan(row[metric.source]) for row in ended)
    ):
        mend = "searches know no progress, runs of earlier versions no contacts_object"
        raise InputError(f"{text}: {driven.run} knows no {rule['rate']}; {mend}")
    places = cluster_index(
        *([row[name] for row in rows] for name in ("location", "scene_id"))
    )[1]
    value, low, high = ends = (
        found["difference" if change else "mean"],
        found["low"],
        found["high"],
    )
    holds, broken = (
        (high <= limit, low > limit)
        if rule["sign"] == "<="
        else (low >= limit, high < limit)
    )
    outcome = PASSED if holds else FAILED if broken else UNDECIDED
    more = None
    every = driven.traffic()[key]
    crashed = sum(map(raised, rows))
    known = headline(every, driven.searched)
    alone = (
        math.isnan(low)
        and not change
        and breaks_alone(metric, rule["sign"], limit, (value, crashed / count))
    )
    if alone and known.raised == known.scenes:
        outcome = FAILED
    told = estimate(
        metric,
        dict(zip(("mean", "low", "high"), ends, strict=True)),
        "mean",
        "+" if change else "",
    )
    reason = f"{text}: found {told} {metric.unit or ('points' if change else '%')}, {count} {driven.unit}"
    reason += f", in {crashed} of them the planner raised" if crashed else ""
    reason += (
        f": these alone break the limit, in {known.raised} of {plural(known.scenes, 'scene')}"
        if alone
        else ""
    )
    if outcome == UNDECIDED:
        factor = growth(ends, limit, places, metric.fraction and not change)
        more = factor and max(1, math.ceil(count * (factor - 1)))
        advice = (
            f"about {more} more, at further places"
            if more
            else "no number decides, the estimate is at the limit"
        )
        if math.isnan(low) and places >= LEAST:
            advice = f"fewer than {LEAST} places know it, there is no interval"
        advice += (
            f" ({places} places, an interval needs {LEAST})" if places < LEAST else ""
        )
        reason = f"{advice}; {reason}"
    reason += f"; {headline_text(known, driven.ego, traffic_name(every[0]))}"
    about = {
        "rule": text,
        "outcome": outcome,
        "reason": f"{outcome}: {reason}",
        "more": more,
        "unit": driven.unit,
    }
    values = {"value": value, "low": low, "high": high, "n": count}
    return about | values | traffic_facts(every, driven.searched)


def breaks_alone(
    metric: Metric, sign: str, limit: float, found: tuple[float, float]
) -> bool:
    """Returns whether rollouts in which the planner raised break a limit, whatever
    becomes of all others.

    Args:
        metric: that is limited.
        sign: `<=` or `>=`.
        limit: of its value.
        found: the value, and the fraction of the rollouts in which the planner raised.
    """
    value, crashed = found
    if metric.fraction:
        return sign == "<=" and metric.raised * crashed > limit
    return sign == ">=" and crashed == 1 and value < limit


def traffic_facts(rows: Sequence[Row], searched: bool) -> dict[str, Any]:
    """The headline of rows of rollouts in one traffic, and each of them that errored,
    for files."""
    names = ("scene_id", "seed", "method", "eta", "raised_by", "error")
    errored = [
        {name: row[name] for name in names} for row in rows if row["errored"] == 1
    ]
    return {"headline": headline(rows, searched)._asdict(), "errored": errored}


def check_limit(
    text: str, name: str, limit: float, metric: Metric, change: bool
) -> None:
    """Raises InputError for a limit that no value of a rate of this name and metric, or
    change of it, can reach."""
    low = -1.0 if change else 0.0
    high = 1.0 if metric.fraction else math.inf
    if not low <= limit <= high and (metric.fraction or not change):
        span = f"from {low:g} to {high:g}" if metric.fraction else "of 0 or more"
        mend = ", such as 0.05 for 5%" if metric.fraction else ""
        raise InputError(
            f"{text}: {name} cannot be {limit:g}; write a number {span}{mend}"
        )


def traffic_of(rule: re.Match, driven: Driven) -> tuple[tuple[str, float], list[dict]]:
    """The traffic that a rule names, or the only attack, and its units; InputError for
    none or several."""
    units = {
        f"{method}@{eta:g}": ((method, eta), rows)
        for (method, eta), rows in driven.units().items()
    }
    found = [
        name for name in units if rule["method"] in (name, name.rpartition("@")[0])
    ]
    if rule["method"] is None:
        found = [name for name in units if not name.endswith("@0")] or list(units)
    if len(found) != 1:
        names = ", ".join(f"{name}:{rule['rate']}" for name in units)
        raise InputError(
            f"{rule[0]}: of which traffic in {driven.run}? write one of {names}"
        )
    return units[found[0]]


def growth(
    found: tuple[float, float, float], limit: float, places: int, fraction: bool
) -> float | None:
    """By which factor places, and so rollouts, must grow until the interval (value,
    low, high) ends at the limit if the value stays; without an interval, to LEAST
    places; None: none decides.

    Of a fraction, and of a change of 0 at each place, it is m/k, the places of which
    the exact interval (Clopper and Pearson) ends at the limit, and where the one found
    does; else the square of half-width over distance to the limit.
    """
    value, low, high = found
    if (
        not fraction
        and value == 0
        and math.isclose(high, -low)
        and math.isclose(high, exact_interval(0.0, places)[1])
    ):
        low, limit, fraction = (
            0.0,
            abs(limit),
            True,
        )  # none is otherwise: as of a fraction without an event
    upper = value < limit
    end = high if value < limit else low
    if math.isnan(end) or abs(value - limit) < NEAR:
        return LEAST / places if places < LEAST else None
    if not fraction:
        return ((end - value) / (limit - value)) ** 2

    def sample(end: float) -> float:
        """The places of which the exact interval of the value ends there."""
        return math.exp(
            brentq(
                lambda log: exact_interval(value, math.exp(log))[upper] - end,
                0,
                math.log(MOST),
            )
        )

    return sample(limit) / sample(end)


def junit(results: Sequence[Mapping[str, Any]], run: str) -> bytes:
    """JUnit's XML: a test case for each rule, a failure or, where rollouts are too few,
    an error."""
    counts = {
        f"{kind}s": str(sum(each["outcome"] == name for each in results))
        for name, kind in KINDS.items()
    }
    suite = ET.Element(
        "testsuite", {"name": "e2rl gate", "tests": str(len(results)), **counts}
    )
    for each in results:
        case = ET.SubElement(suite, "testcase", classname=run, name=each["rule"])
        if each["outcome"] in KINDS:
            ET.SubElement(
                case,
                KINDS[each["outcome"]],
                message=each["reason"],
                type=each["outcome"],
            )
        ET.SubElement(case, "system-out").text = "\n".join(
            [each["reason"], *each["told"]]
        )
    root = ET.Element("testsuites")
    root.append(suite)
    return ET.tostring(root, "utf-8", xml_declaration=True)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl gate", description=__doc__)
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="folder of a run of evaluate.py"
    )
    parser.add_argument(
        "rules",
        nargs="+",
        metavar="RULE",
        help="such as 'preventable<=0.05', 'nominal:contacts<=0.1'",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="RUN",
        help="a former run, for rules as 'counted<=+0.02'",
    )
    parser.add_argument("--ego", metavar="NAME", help="where a run has several")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write JUnit's XML")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the values")
    options = parser.parse_intermixed_args(arguments)
    with ending():
        driven = Driven.read(options.run, options.ego)
        former = None
        if options.against is not None:
            former = Driven.read(options.against, options.ego)
            check_shared(former, driven)
            if not any(re.search("=[+-]", text) for text in options.rules):
                raise InputError(
                    "--against: no rule is on a change; write one as 'counted<=+0.02'"
                )
        results = [judged(text, driven, former) for text in options.rules]
        told = [*errored_lines(driven.rows, named=0), *touched_lines(driven.rows)]
        if options.junit is not None:
            write_atomically(
                options.junit,
                junit([each | {"told": told} for each in results], str(options.run)),
            )
        if options.json is not None:
            write_json(options.json, results)
        print(*(each["reason"] for each in results), *told, sep="\n")
    sys.exit(
        next(
            status
            for outcome, status in STATUS.items()
            if outcome in {each["outcome"] for each in results}
        )
    )
