"""`e2rl check [KEY=VALUE]`: what would go wrong in the run of `e2rl evaluate` with the
same options, of its planner, its data and this machine, in seconds.

`--planner MODULE:CLASS` names a class as `e2rl try` does. The status is 0 where nothing
is wrong, else 1 (docs/guide/planner.md).
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
import sys
from collections.abc import Iterable

from e2rl.evaluation.finding import Finding
from e2rl.run.command import run_command
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.options import check_unused
from e2rl.run.run import Run

SIGNS = {True: "ok", False: "FAIL", None: "note"}


class Screen:
    """Prints findings by part, and counts those that are wrong."""

    def __init__(self) -> None:
        self.wrong = 0

    def show(self, part: str, findings: Iterable[Finding]) -> None:
        """Prints the findings of a part as they come."""
        print(part, flush=True)
        for finding in findings:
            self.wrong += finding.fine is False
            text = "; ".join(filter(None, (finding.text, finding.mend)))
            print(f"  {SIGNS[finding.fine]:<4} {finding.about:<9} {text}", flush=True)


def check(run: Run) -> None:
    """Print what is right and what is wrong; the status is 1 where anything is wrong."""
    check_unused(run.config, "e2rl check", ("resume", "reproduce", "failure"))
    from e2rl.evaluation.plan import ego_name
    from e2rl.evaluation.preflight import Preparation, run_findings

    screen = Screen()
    ready = Preparation(run.config, ego_name(run.config.ego, run.choices["ego"]))
    if ready.refused:
        screen.show("configuration", ready.refused)
    for name, findings in ready.planners():
        screen.show(f"planner {name}", findings)
    if ready.sample:
        screen.show(f"data {run.choices['data']}", ready.data())
    screen.show("machine", ready.machine())
    if not screen.wrong:
        try:
            extent = ready.extent()
            assert extent is not None and ready.settings is not None
            screen.show("run", run_findings(extent, ready.settings, run.folder))
        except InputError as error:
            screen.show("run", [Finding("rollouts", False, str(error))])
    if screen.wrong:
        print(f"{screen.wrong} wrong; with none it also says how long the run takes")
        sys.exit(1)
    print("nothing is wrong")


def main() -> None:
    """The command."""
    arguments = sys.argv[1:]
    if any(argument.partition("=")[0] == "--planner" for argument in arguments):
        from e2rl.commands.try_planner import overrides_of, parser_of

        options = parser_of("e2rl check").parse_intermixed_args(arguments)
        with ending():
            sys.argv[1:] = overrides_of(options)
    run_command("check", check)
