"""What an evaluation leaves behind: tables.md, figures, the failure report, and the
lines that answer it."""

from collections.abc import Sequence
from pathlib import Path

from e2rl.evaluation.ego_set import recorded_acceleration
from e2rl.evaluation.methods import ALL, EvaluationSettings, caption, terms_by_method
from e2rl.evaluation.modes import MODES_FILE, read_modes
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.evasion import search_effort
from e2rl.report.answer import answer_lines
from e2rl.report.comparison_tables import (
    EGOS,
    METHODS,
    guard_table,
    method_tables,
    planner_tables,
    save_compared,
)
from e2rl.report.curves import points_of_rows, save_curves
from e2rl.report.drawing import save_figure
from e2rl.report.html import write_report
from e2rl.report.picture import intensity_figure, intensity_sweep
from e2rl.report.policy_figure import NAME as POLICY_FIGURE
from e2rl.report.policy_figure import policy_figure
from e2rl.report.tables import (
    Table,
    metric_tables,
    mode_tables,
    print_tables,
    save_tables,
)
from e2rl.run.run import Run

NOMINAL = "nominal"  # traffic without an attack, which every attack is compared with
MAIN = "main"  # table of metrics


def write_results(run: Run, plan: Evaluation, rows: Sequence[dict]) -> list[str]:
    """Writes the tables, figures and failure report of an evaluation; returns the lines
    that answer it.

    Args:
        rows: of metrics.json.
    """
    folder = run.folder
    asked = plan.asked
    modes = read_modes(run.folder / MODES_FILE)
    notes = [
        f"left out: {count} scenes ({reason})"
        for reason, count in plan.scenes.dropped.items()
    ]
    notes += (
        ["tries go where failures are: rates of tries are no rates of the planner"]
        if plan.searches
        else []
    )
    methods = [
        *plan.methods,
        *(
            next(iter(one.traffic.values()))
            for one in plan.searches
            if len(one.traffic) == 1
        ),
    ]
    text = "; ".join(
        [
            caption(run.config, plan.origin, methods=methods),
            search_effort(plan.scenes.steps),
            *notes,
        ]
    )
    tables = [
        *tables_of(plan, rows, text=text, folder=folder),
        *mode_tables(modes),
        *egos_tables(run, plan, rows=rows, text=text),
    ]
    save_tables(folder / "tables.md", tables)
    if asked.metrics == ALL:
        print_tables(tables)
    if asked.figure == "intensity":
        save_figure(folder / "intensity.png", intensity_figure(intensity_sweep(folder)))
    if asked.figure == "curves":
        save_curves(folder, points_of_rows(rows))
    rollouts = read_rows(folder / TABLE)
    failed = modes["failures"] or any(row["errored"] == 1 for row in rollouts)
    shown = asked.report and asked.save_rollouts and failed
    page = write_report(folder, rows, modes=modes, tables=tables) if shown else None
    return answer_lines(
        rows, modes, folder=folder, report=page, notes=notes, rollouts=rollouts
    )


def references(plan: Evaluation) -> tuple[str, ...] | None:
    """Returns the methods that all are compared with; None: each with every other."""
    return (
        (*plan.asked.compare, NOMINAL)
        if compares(plan.asked) and not plan.egos.pairs
        else None
    )


def compares(asked: EvaluationSettings) -> bool:
    """Whether the tables have a row a method, or where there are several egos a row an
    ego."""
    return bool(asked.compare) or asked.figure == "curves"


def tables_of(
    plan: Evaluation, rows: Sequence[dict], text: str, folder: Path
) -> list[Table]:
    """Returns the tables of metrics; those with a row a method or an ego also become
    files of their own."""
    metrics = MAIN if plan.asked.metrics == ALL else plan.asked.metrics
    if not compares(plan.asked):
        return metric_tables(rows, text, table=metrics)
    others = plan.asked.compare or (NOMINAL,)
    egos = plan.egos
    if egos.pairs:
        tables = planner_tables(
            rows, egos.names, references=others, settings=text, table=metrics
        )
    else:
        tables = method_tables(
            rows,
            terms_by_method(plan.methods),
            references=others,
            settings=text,
            table=metrics,
        )
    save_compared(folder, tables, name=EGOS if egos.pairs else METHODS)
    return tables


def egos_tables(
    run: Run, plan: Evaluation, rows: Sequence[dict], text: str
) -> list[Table]:
    """Returns the tables that compare several egos; with `policy_learning` also its
    guards, and draws what training changed."""
    roles = run.config.policy_learning
    egos = plan.egos
    if not egos.pairs or plan.asked.compare:
        return []
    others = dict.fromkeys(second for _, second in egos.pairs)
    tables = planner_tables(
        rows,
        egos.names,
        references=others,
        settings=text,
        table=MAIN if plan.asked.metrics == ALL else plan.asked.metrics,
    )
    if roles is None:
        return tables
    figure = policy_figure(
        rows, roles.before, after=roles.after, method=run.config.synthesizer.name
    )
    save_figure(run.folder / POLICY_FIGURE, figure)
    recorded = recorded_acceleration(plan.scenes)
    return [
        *tables,
        guard_table(
            rows,
            roles.before,
            after=roles.after,
            planner=roles.planner,
            recorded=recorded,
        ),
    ]
