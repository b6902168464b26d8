"""`e2rl prior-tables`: the prior as traffic beside log replay, constant velocity and
IDM, in closed loop, and how far its samples lie apart."""

from typing import Any

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from dataclasses import dataclass

from e2rl.evaluation.plan import begin
from e2rl.evaluation.record import record
from e2rl.evaluation.spread_table import spread_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.report.results import write_results
from e2rl.report.tables import metric_tables, print_tables
from e2rl.run.command import run_command
from e2rl.run.run import Run, origin_of
from e2rl.run.settings import setting, settings_of

MAY_CHANGE = ("processes",)  # when a run is resumed


@dataclass(frozen=True)
class TableSettings:
    """Keys of conf/prior_tables.yaml, checked."""

    spread_samples: int = setting(low=0)


def prior_tables(run: Run) -> None:
    """Make the rows of the tables; write and print them."""
    config = run.config
    settings = settings_of(TableSettings, {"spread_samples": config.spread_samples})
    plan = begin(run)
    spread = []
    if settings.spread_samples:
        spread = spread_rows(
            plan.scenes,
            plan.methods,
            samples=settings.spread_samples,
            device=config.device,
            parts=run.parts(),
        )
    scored = plan.drive().scored

    def summarise(*scores: Any) -> list[dict]:
        return [row | origin_of(run.folder) for row in (*spread, *metric_rows(*scores))]

    rows = record(scored, run.folder, summarise)
    answer = write_results(run, plan, rows=rows)
    print_tables(metric_tables(spread))
    print()
    print("\n".join(answer))


def main() -> None:
    """The command."""
    run_command("prior_tables", prior_tables, may_change=MAY_CHANGE)
