"""Closed-loop evaluation: `python evaluate.py [data=...] [ego=...] [eta=...]` says how
often, and how, an ego fails."""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from functools import partial
from pathlib import Path

from e2rl.evaluation.budget import search_all
from e2rl.evaluation.methods import processes_of
from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import WHOLE, Work, drive_all, record, score_all
from e2rl.evaluation.reproduce import compared_with_run, failure_row, outcome, run_of
from e2rl.report.budget import save_budget
from e2rl.report.results import references, write_results
from e2rl.run.command import run_command
from e2rl.run.run import Run, origin_of

MAY_CHANGE = ("processes", "launcher", "shard")  # when a run is resumed


def evaluate(run: Run) -> None:
    """Roll out and score what is not done yet; then summarise, draw and print."""
    config = run.config
    folder = run.folder
    plan = begin(run)
    asked = plan.asked
    egos = plan.egos
    work = Work(
        plan.rollouts(folder), processes_of(config), plan.only, run.parts(), asked.shard
    )
    setups = egos.setups(plan.setup)
    most = max(asked.budget, default=0.0)
    then = (
        failure_row(Path(config.reproduce), config.failure) if config.failure else None
    )
    if then is not None:
        (scored,) = score_all(
            [("failure", plan.part_of(then, Path(config.reproduce)))],
            work,
            lambda job: 1,
        )
    elif asked.budget:
        scored, tries = search_all(
            setups, plan.searches, most, asked.budget_unit, asked.seeds, work
        )
    else:
        scored = drive_all(
            setups, plan.methods, asked.seeds, work
        )  # every ego, method, eta, scene and seed
    if asked.shard != WHOLE:
        print(
            f"\nshard {asked.shard[0]} of {asked.shard[1]} written to {folder}; e2rl merge joins all of them"
        )
        return
    searched = bool(asked.budget) and then is None
    about = {"references": references(plan), "searched": searched} | origin_of(
        run.folder
    )
    rows = record(*scored, folder, partial(egos.metric_rows, **about))
    if searched:
        save_budget(folder, plan, tries=tries, rows=scored[0], samples=scored[1])
    print("", *write_results(run, plan, rows), sep="\n")
    if then is not None:
        print(f"{config.failure}: {outcome(then, scored[0][0])}")
    elif config.reproduce:
        print(f"{config.reproduce}: {compared_with_run(config, folder).text()}")


def main() -> None:
    """The command."""
    run_command("evaluate", evaluate, MAY_CHANGE, run_of)


if __name__ == "__main__":
    main()
