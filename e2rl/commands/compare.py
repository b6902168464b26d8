"""`e2rl compare RUN_A RUN_B`, or `e2rl compare RUN --egos A B`: which failures of the second are new, gone, or moved.

Writes a page with both replays in step, and all pairs as CSV and JSON (docs/how-to/compare.md).
"""

import argparse
from pathlib import Path

from e2rl.evaluation.comparison import Driven
from e2rl.evaluation.rollout_files import own_folder
from e2rl.report.comparison_page import PAGE, compare
from e2rl.run.endings import ending
from e2rl.run.errors import InputError


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl compare", description=__doc__)
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="the run before and the one after, or one run"
    )
    parser.add_argument("--egos", nargs=2, metavar="NAME", help="the ego before and the one after")
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"the page (default: {PAGE} in the last run's folder)")
    options = parser.parse_args(arguments)
    with ending():
        runs, egos = options.runs, options.egos or (None, None)
        if len(runs) > 2 or (len(runs) == 1 and not options.egos):
            raise InputError("give two runs, or one with several egos and --egos BEFORE AFTER")
        first, second = (Driven.read(run, ego) for run, ego in zip((runs[0], runs[-1]), egos, strict=True))
        path = options.out or own_folder(runs[-1], PAGE)
        print(*compare(first, second, path), sep="\n")
