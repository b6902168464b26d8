"""`e2rl report RUN_DIR`: the failure report of a run, one HTML file that opens offline."""

import argparse
from pathlib import Path

from e2rl.report.html import PAGE, REPLAYS, write_report
from e2rl.run.endings import ending


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl report", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run of evaluate.py")
    parser.add_argument("--replays", type=int, default=REPLAYS, metavar="N", help="at most so many (%(default)s)")
    parser.add_argument("--method", action="append", default=[], metavar="NAME", help="its failures only; repeatable")
    parser.add_argument("--out", type=Path, help=f"file to write (default: RUN_DIR/{PAGE})")
    options = parser.parse_args(arguments)
    with ending():
        print(write_report(options.run, replays=options.replays, methods=options.method, path=options.out))
