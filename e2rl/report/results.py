"""What an evaluation leaves behind: tables.md, figures, the failure report, and the
lines that answer it."""

from collections.abc import Sequence

from e2rl.evaluation.check import ALL
from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.rollout_files import MODES_FILE, TABLE, read_rows
from e2rl.metrics.evasion import search_effort
from e2rl.report.answer import answer_lines
from e2rl.report.caption import caption, terms_by_method
from e2rl.report.comparison_tables import (
    EGOS,
    method_tables,
    planner_tables,
    save_compared,
)
from e2rl.report.html import write_report
from e2rl.report.tables import (
    Table,
    metric_tables,
    print_tables,
    save_tables,
)
from e2rl.run.run import Run

MAIN = "main"  # table of metrics


def write_results(run: Run, plan: Evaluation, rows: Sequence[dict]) -> list[str]:
    """Writes the tables, figures and failure report of an evaluation; returns the lines
    that answer it.

    Args:
        rows: of metrics.json.
    """
    folder = run.folder
    settings = plan.settings
    modes = read_modes(folder / MODES_FILE)
    notes = [
        f"left out: {count} scenes ({reason})"
        for reason, count in plan.scenes.dropped.items()
    ]
    if plan.searches:
        notes.append(
            "tries go where failures are: rates of tries are no rates of the planner"
        )
    methods = list(plan.methods)
    for search in plan.searches:
        if len(search.traffic) == 1:
            methods += search.traffic.values()
    about = caption(run.config, plan.origin, methods=methods)
    text = "; ".join([about, search_effort(plan.scenes.steps), *notes])
    means, egos = evaluation_tables(run, plan, rows=rows, text=text)
    tables = [*means, *egos]
    save_tables(folder / "tables.md", tables)
    if settings.metrics == ALL:
        print_tables(tables)
    rollouts = read_rows(folder / TABLE)
    failed = modes["failures"] or any(row["errored"] == 1 for row in rollouts)
    page = None
    if settings.report and settings.save_rollouts and failed:
        page = write_report(folder, rows, modes=modes, tables=tables)
    return answer_lines(
        rows, modes, folder=folder, report=page, notes=notes, rollouts=rollouts
    )


def evaluation_tables(
    run: Run, plan: Evaluation, *, rows: Sequence[dict], text: str
) -> tuple[list[Table], list[Table]]:
    """Returns the tables of metrics, and those that compare several egos.

    With `compare` the first have a row a method or an ego, and become files of their
    own; else the second do.

    Args:
        run: whose folder is written to.
        plan: what was evaluated.
        rows: of metrics.json.
        text: settings, for the captions.
    """
    compared = plan.settings.compare
    egos = plan.egos
    table = MAIN if plan.settings.metrics == ALL else plan.settings.metrics
    if compared and not egos.pairs:
        tables = method_tables(
            rows,
            terms_by_method(plan.methods),
            references=compared,
            settings=text,
            table=table,
        )
        save_compared(run.folder, tables)
        return tables, []
    if not egos.pairs:
        return metric_tables(rows, text, table=table), []
    others = compared or dict.fromkeys(second for _, second in egos.pairs)
    tables = planner_tables(
        rows, egos.names, references=others, settings=text, table=table
    )
    if compared:
        save_compared(run.folder, tables, name=EGOS)
        return tables, []
    return metric_tables(rows, text, table=table), tables
