"""What training gained: the paper's four panels of policy improvement, as gains over
the policy before it.

`e2rl policy-figure RUN_DIR...` draws runs of experiment=policy_learning on several
splits, as tune and test, as one.
"""

import argparse
from pathlib import Path

from e2rl.evaluation.rollout_files import METRICS_FILE, read_metrics
from e2rl.report.drawing import save_figure
from e2rl.report.policy_figure import NAME, policy_figure
from e2rl.run.endings import ending
from e2rl.run.errors import InputError


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="e2rl policy-figure", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="of experiment=policy_learning",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        help="folder to write to (default: the current one)",
    )
    for name, default in (("before", "before"), ("after", "after"), ("method", "e2")):
        parser.add_argument(
            f"--{name}", default=default, help=f"in the runs (default: {default})"
        )
    options = parser.parse_args(arguments)
    with ending():
        rows = [row for run in options.runs for row in read_metrics(run / METRICS_FILE)]
        figure = policy_figure(
            rows, options.before, after=options.after, method=options.method
        )
        if not figure.axes[0].patches:
            raise InputError(
                f"policy-figure: no rows of {options.after} after {options.before} "
                f"under {options.method}"
            )
        save_figure(options.out / NAME, figure)
        print(options.out / NAME)
