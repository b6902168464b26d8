"""`e2rl gate RUN RULE ...`: whether rates of a run, or their changes against a former
run, are within limits.

The 95% interval decides, not the estimate: a rule holds where the whole interval does,
fails where none of it does. The status is 0 where all hold, 1 where one fails, 3 where
none fails and rollouts are too few, 2 for bad input (docs/guide/compare.md). A rollout
in which the planner raised has failed; where it raised in every scene, and these
rollouts alone break a limit, a rule fails without an interval, too.
"""

import argparse
import re
import sys
from pathlib import Path

from e2rl.evaluation.comparison import Driven, check_shared
from e2rl.evaluation.rollout_files import RATES_FILE, write_json
from e2rl.report.answer import errored_lines, touched_lines
from e2rl.report.gate import FAILED, PASSED, UNDECIDED, judged, junit
from e2rl.report.rate_gate import judged_rate, rates_of_run
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically

STATUS = {FAILED: 1, UNDECIDED: 3, PASSED: 0}  # of the command, the first that applies


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl gate", description=__doc__)
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="folder of a run of evaluate.py or e2rl rate",
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
        if (options.run / RATES_FILE).is_file():
            results = rate_results(options)
            events: list[str] = []
        else:
            results, events = rollout_results(options)
        if options.junit is not None:
            xml = junit(results, run=str(options.run), events=events)
            write_atomically(options.junit, xml)
        if options.json is not None:
            write_json(options.json, results)
        for line in [*(result["reason"] for result in results), *events]:
            print(line)
    outcomes = {result["outcome"] for result in results}
    sys.exit(next(status for name, status in STATUS.items() if name in outcomes))


def rollout_results(options: argparse.Namespace) -> tuple[list[dict], list[str]]:
    """Returns what becomes of rules on a run of evaluate.py, and lines about the run."""
    driven = Driven.read(options.run, options.ego)
    former = None
    if options.against is not None:
        former = Driven.read(options.against, options.ego)
        check_shared(former, driven)
        if not any(re.search("=[+-]", rule) for rule in options.rules):
            raise InputError(
                "--against: no rule is on a change; write one as 'counted<=+0.02'"
            )
    results = [judged(rule, driven, former) for rule in options.rules]
    return results, [*errored_lines(driven.rows, named=0), *touched_lines(driven.rows)]


def rate_results(options: argparse.Namespace) -> list[dict]:
    """Returns what becomes of rules on a run of `e2rl rate`."""
    run = rates_of_run(options.run, options.ego)
    former = None
    if options.against is not None:
        former = rates_of_run(options.against, options.ego)
        if not any("=x" in rule for rule in options.rules):
            raise InputError(
                "--against: no rule is on a ratio; write one as "
                "'preventable_per_1000km<=x1.2'"
            )
    return [judged_rate(rule, run, former) for rule in options.rules]
