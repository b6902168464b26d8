"""`e2rl gate RUN RULE ...`: whether a run keeps within limits, for continuous integration (docs/how-to/compare.md).

The status is 0 where every rule holds, 1 where one fails, 3 where rollouts are too few to tell, 2 for bad input.
"""

import argparse
import sys
from pathlib import Path

from e2rl.evaluation.comparison import Driven, check_pairs
from e2rl.evaluation.rollout_files import write_json
from e2rl.report.gate import FAILED, STATUS, UNDECIDED, Rule, judged, junit
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl gate", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run of evaluate.py")
    parser.add_argument("rules", nargs="+", metavar="RULE", help="such as 'preventable<=0.05', 'nominal:contacts<=0.1'")
    parser.add_argument(
        "--against", type=Path, metavar="RUN", help="a former run; rules limit changes: 'counted<=+0.02'"
    )
    parser.add_argument("--ego", metavar="NAME", help="where a run has several")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write JUnit's XML")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the values")
    options = parser.parse_intermixed_args(arguments)
    with ending():
        rules = [Rule.of(text) for text in options.rules]
        driven, former = Driven.read(options.run, options.ego), None
        if options.against is not None:
            former = Driven.read(options.against, options.ego)
            check_pairs(former, driven)
            if not any(rule.change for rule in rules):
                raise InputError(f"--against {options.against}: no rule is on a change; write one as 'counted<=+0.02'")
        results = [judged(rule, driven, former) for rule in rules]
        if options.junit is not None:
            write_atomically(options.junit, junit(results, str(options.run)))
        if options.json is not None:
            write_json(options.json, results)
        print(*(each["reason"] for each in results), sep="\n")
    outcomes = {each["outcome"] for each in results}
    sys.exit(next((STATUS[each] for each in (FAILED, UNDECIDED) if each in outcomes), 0))
