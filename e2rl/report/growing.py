"""The failure report of an evaluation that goes on: it appears with the first failure,
and grows."""

import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from e2rl.driving.batches import WHOLE
from e2rl.driving.scored import Scored
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.record import Record
from e2rl.metrics.errored import raised
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.failure_tracks import Encoded
from e2rl.report.html import PAGE, encode, write_report
from e2rl.run.terminal import Bar
from e2rl.search.spending import Spent
from e2rl.sim.rollout_file import rollout_key

EVERY = 15  # s until a page loads itself again
SHARE = 0.01  # of the run's time that pages take at most


class GrowingReport:
    """The page with the failures so far of an evaluation.

    Args:
        plan: what is evaluated.
    """

    def __init__(self, plan: Evaluation) -> None:
        self.plan = plan
        self.rows: list[dict] = []
        self._replays: dict[str, Encoded] = {}
        self._begin = time.monotonic()
        self._cost = 0.0  # CPU seconds
        self._shown = False
        self._warned = False

    def add(self, scored: Scored) -> None:
        """Add what a batch scored; write the page, where there are failures and pages
        have cost less than their SHARE."""
        self.rows += scored.rows
        failed = any(is_failure(row) or raised(row) for row in self.rows)
        if not failed or self._cost > SHARE * (time.monotonic() - self._begin):
            return
        begin = time.process_time()
        text = (
            "So far: {} rollouts; this page is still growing, and loads itself again."
        )
        self.write(text, EVERY)
        self._cost += time.process_time() - begin

    def stop(self) -> None:
        """Let the page, where it is there, say where the run stopped."""
        if self._shown:
            self.write("Stopped at {} rollouts.")

    def write(self, text: str, every: int = 0) -> None:
        """Write the page. What goes wrong is reported once, and does not end the run.

        Args:
            text: about {}, how many rollouts of how many.
            every: s after which the page loads itself again; 0: never.
        """
        plan = self.plan
        run = plan.run
        searched = plan.settings.budget is not None
        try:
            record = Record.so_far(run.folder, self.rows, run.config, searched=searched)
            page = write_report(
                run.folder,
                record,
                tables=[],
                path=run.folder / PAGE,
                progress={"text": text.format(plan.driven(self.rows)), "every": every},
                encode=self.replay,
            )
        except Exception as error:
            if not self._warned:
                reason = f"{type(error).__name__}: {error}"
                Bar.write(f"no failure report yet ({reason})", sys.stderr)
            self._warned = True
            return
        if not self._shown:
            Bar.write(f"first failures: {page}", sys.stderr)
        self._shown = True

    def replay(self, run: Path, row: Mapping[str, Any]) -> Encoded:
        """The replay of a failure, which is encoded once."""
        key = rollout_key(row)
        if key not in self._replays:
            self._replays[key] = encode(run, row)
        return self._replays[key]


def drive_watched(plan: Evaluation) -> Spent:
    """Returns what all rollouts of an evaluation score, whose failure report grows
    meanwhile, where it is to have one."""
    settings = plan.settings
    if not (settings.report and settings.save_rollouts and settings.shard == WHOLE):
        return plan.drive()
    report = GrowingReport(plan)
    try:
        return replace(plan, work=replace(plan.work, watch=report.add)).drive()
    except BaseException:  # Ctrl-C, too
        report.stop()
        raise
