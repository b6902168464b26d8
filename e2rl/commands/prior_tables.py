"""`e2rl prior-tables`: the prior as traffic beside log replay, constant velocity and
IDM, in four tables.

Open-loop accuracy (minADE), the spread of samples, the closed loop, and the realism
meta-metric over many rollouts of each scene.
"""

from typing import Any

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from dataclasses import dataclass, fields

from e2rl.evaluation.meta_table import meta_rows
from e2rl.evaluation.methods import processes_of
from e2rl.evaluation.open_loop import open_loop_rows, spread_rows
from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import Work, drive_all, record
from e2rl.evaluation.summary import metric_rows
from e2rl.report.results import write_results
from e2rl.report.tables import metric_tables, print_tables
from e2rl.run.command import run_command
from e2rl.run.run import Run, origin_of
from e2rl.run.settings import setting, settings_of

MAY_CHANGE = ("processes", "launcher")  # when a run is resumed


@dataclass(frozen=True)
class TableSettings:
    """Keys of conf/prior_tables.yaml, checked."""

    open_loop_samples: int = setting(low=0)
    spread_samples: int = setting(low=0)
    meta_rollouts: int = setting(low=0)


def prior_tables(run: Run) -> None:
    """Make the rows of the tables; write and print them."""
    config = run.config
    folder = run.folder
    asked = settings_of(
        TableSettings, {each.name: config[each.name] for each in fields(TableSettings)}
    )
    plan = begin(run)
    methods = plan.methods
    setup = plan.setup
    parts = run.parts()
    before = []
    after = []
    if asked.open_loop_samples:
        before = open_loop_rows(
            plan.scenes,
            methods,
            samples=asked.open_loop_samples,
            device=config.device,
            parts=parts,
        )
    if asked.spread_samples:
        before += spread_rows(
            plan.scenes,
            methods,
            samples=asked.spread_samples,
            device=config.device,
            parts=parts,
        )
    work = Work(
        plan.rollouts(folder), processes_of(config), only=plan.only, parts=parts
    )
    scored = drive_all([setup], methods, seeds=plan.asked.seeds, work=work)
    if asked.meta_rollouts:
        after = meta_rows(setup, methods, rollouts=asked.meta_rollouts, parts=parts)

    def summarise(*found: Any) -> list[dict]:
        return [
            row | origin_of(run.folder)
            for row in (*before, *metric_rows(*found), *after)
        ]

    rows = record(*scored, folder, summarise)
    answer = write_results(run, plan, rows=rows)
    print_tables(metric_tables([*before, *after]))
    print("", *answer, sep="\n")


def main() -> None:
    """The command."""
    run_command("prior_tables", prior_tables, may_change=MAY_CHANGE)
