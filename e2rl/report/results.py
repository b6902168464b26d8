"""What an evaluation leaves behind: tables.md, figures, the failure report, and the
lines that answer it."""

from collections.abc import Sequence

from e2rl.evaluation.check import ALL
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.record import Record
from e2rl.metrics.evasion import search_effort
from e2rl.report.answer import answer_lines
from e2rl.report.caption import caption, terms_by_method
from e2rl.report.comparison_tables import (
    EGOS,
    method_tables,
    planner_tables,
    save_compared,
)
from e2rl.report.html import PAGE, write_report
from e2rl.report.tables import (
    Table,
    metric_tables,
    print_tables,
    save_tables,
)

MAIN = "main"  # table of metrics


def write_results(plan: Evaluation, record: Record) -> list[str]:
    """Writes the tables, figures and failure report of an evaluation; returns the lines
    that answer it."""
    folder = plan.run.folder
    settings = plan.settings
    notes = [
        f"left out: {count} scenes ({reason})"
        for reason, count in plan.scenes.dropped.items()
    ]
    if plan.searches:
        notes.append(
            "tries go where failures are: rates of tries are no rates of the planner"
        )
    tables = tables_of(plan, record, notes)
    save_tables(folder / "tables.md", tables)
    if settings.metrics == ALL:
        print_tables(tables)
    page = None
    if settings.report and settings.save_rollouts:
        page = write_report(folder, record, tables=tables, path=folder / PAGE)
    return answer_lines(
        record.metrics,
        record.modes,
        folder=folder,
        report=page,
        notes=notes,
        rollouts=record.rollouts,
    )


def tables_of(plan: Evaluation, record: Record, notes: Sequence[str]) -> list[Table]:
    """Returns the tables of metrics, and those that compare several egos.

    With `compare` the first have a row a method or an ego, and become files of their
    own; else the last do.

    Args:
        plan: what was evaluated, and where it is written.
        record: what it came to.
        notes: for the captions.
    """
    folder = plan.run.folder
    rows = record.metrics
    compared = plan.settings.compare
    egos = plan.egos
    table = MAIN if plan.settings.metrics == ALL else plan.settings.metrics
    methods = list(plan.methods)
    for search in plan.searches:
        if len(search.traffic) == 1:
            methods += search.traffic.values()
    about = caption(plan.run.config, plan.prior_origin, methods=methods)
    text = "; ".join([about, search_effort(plan.scenes.steps), *notes])
    if compared and not egos.pairs:
        tables = method_tables(
            rows,
            terms_by_method(plan.methods),
            references=compared,
            settings=text,
            table=table,
        )
        save_compared(folder, tables)
        return tables
    if not egos.pairs:
        return metric_tables(rows, text, table=table)
    tables = planner_tables(
        rows,
        egos.names,
        references=compared or dict.fromkeys(second for _, second in egos.pairs),
        settings=text,
        table=table,
    )
    if compared:
        save_compared(folder, tables, name=EGOS)
        return tables
    return [*metric_tables(rows, text, table=table), *tables]
