"""`e2rl compare RUN RUN`, or `e2rl compare RUN --egos A B`: which failures of the
second are new, gone, or moved.

Writes a page with both replays in step, and the pairs as CSV and JSON
(docs/guide/compare.md).
"""

import argparse
from pathlib import Path

from e2rl.evaluation.comparison import Driven
from e2rl.evaluation.rollout_files import own_folder
from e2rl.report.compare import PAGE, compare
from e2rl.run.endings import ending
from e2rl.run.errors import InputError


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl compare", description=__doc__)
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN",
        help="the one before, the one after; or one run",
    )
    parser.add_argument(
        "--egos",
        nargs=2,
        metavar="NAME",
        help="the ego before and the one after",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=f"the page (default: {PAGE} in the last run's folder)",
    )
    options = parser.parse_args(arguments)
    with ending():
        runs = options.runs
        if len(runs) > 2 or (len(runs) == 1 and not options.egos):
            raise InputError(
                "give two runs, or one with several egos and --egos BEFORE AFTER"
            )
        page = options.out or own_folder(runs[-1], PAGE)
        if page.suffix != ".html":
            raise InputError(
                f"--out {page}: name a file that ends in .html; .csv and .json come "
                "beside it"
            )
        before, after = options.egos or (None, None)
        first = Driven.read(runs[0], before)
        second = Driven.read(runs[-1], after)
        print(*compare(first, second, path=page), sep="\n")
