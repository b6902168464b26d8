"""Rules on rates of `e2rl rate`, or on their ratio to those of a former run
(docs/guide/rate.md)."""

import math
import re
from pathlib import Path
from typing import Any

from e2rl.evaluation.rates import EgoRates
from e2rl.metrics.statistics import LEAST
from e2rl.report.gate import FAILED, PASSED, UNDECIDED
from e2rl.report.rates import text
from e2rl.run.errors import InputError
from e2rl.tail.summary import EVENTS, UNITS

PATTERN = re.compile(
    rf"(?P<event>{'|'.join(EVENTS)})_per_(?P<unit>{'|'.join(UNITS)})"
    r"\s*<=\s*(?P<ratio>x?)(?P<limit>\d*\.?\d+(?:e-?\d+)?)"
)


def rates_of_run(run: Path, ego: str | None) -> EgoRates:
    """Returns the rates of a run's only ego, or of the one of a name. Raises InputError
    where there is none, or the file is damaged."""
    egos = EgoRates.read(run)
    chosen = [rates for rates in egos if ego in (None, rates.ego)]
    if len(chosen) != 1:
        names = ", ".join(rates.ego for rates in egos)
        raise InputError(f"{run}: has {names}; name one of them by --ego")
    return chosen[0]


def judged_rate(rule: str, run: EgoRates, former: EgoRates | None) -> dict[str, Any]:
    """Returns what becomes of a rule such as 'preventable_per_1000km<=2', or with a
    `former` run 'preventable_per_1000km<=x1.2', a limit on the ratio to it: `outcome`,
    `reason`, value and interval.

    Raises InputError where it is no rule, or on what the run does not know.
    """
    match = PATTERN.fullmatch(rule.strip())
    if match is None or bool(match["ratio"]) > (former is not None):
        events = ", ".join(EVENTS)
        raise InputError(
            f"{rule!r}: no rule on a run of e2rl rate; write EVENT_per_UNIT<=LIMIT, such "
            "as 'preventable_per_1000km<=2', or with --against RUN a limit on the ratio, "
            f"'preventable_per_1000km<=x1.2'; events: {events}; units: {', '.join(UNITS)}"
        )
    event = match["event"]
    limit = float(match["limit"])
    if match["ratio"] and former is not None:
        bounds = run.ratio_to(former, event)
    elif event in run.rates:
        bounds = run.rates[event][match["unit"]]
    else:
        raise InputError(
            f"{rule}: {run.ego} has no rate of {event}; the target was {run.target}"
        )
    outcome = UNDECIDED
    if bounds.high <= limit:
        outcome = PASSED
    elif bounds.low > limit:
        outcome = FAILED
    reason = f"{rule}: found {text(bounds)}, {len(run.scenes)} scenes"
    if run.places < LEAST:
        reason += f"; {run.places} places, an interval needs {LEAST}"
    elif outcome == UNDECIDED and bounds.value != limit and math.isfinite(bounds.value):
        end = bounds.high if bounds.value < limit else bounds.low
        factor = ((end - bounds.value) / (limit - bounds.value)) ** 2
        more = math.ceil(len(run.scenes) * max(factor - 1, 0))
        reason += f"; about {more} more scenes would tell" if more else ""
    return {
        "rule": rule,
        "outcome": outcome,
        "reason": f"{outcome}: {reason}",
        "value": bounds.value,
        "low": bounds.low,
        "high": bounds.high,
        "n": len(run.scenes),
    }
