"""Closed-loop evaluation: `python evaluate.py [data=...] [ego=...] [eta=...]` says how
often, and how, an ego fails."""

from e2rl.run.early import loading  # first: from here on Ctrl-C ends in one line

# isort: split
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from e2rl.run.command import run_command
from e2rl.run.run import Run

MAY_CHANGE = ("processes", "shard")  # when a run is resumed


def evaluate(run: Run) -> None:
    """Roll out and score what is not on disk yet; then summarise, draw and print."""
    with loading():
        from e2rl.driving.batches import WHOLE
        from e2rl.evaluation.plan import begin
        from e2rl.evaluation.reproduce import compared_with_run, failure_row, outcome
        from e2rl.report.growing import drive_watched
        from e2rl.report.results import write_results

    config = run.config
    plan = begin(run)
    failure = None
    if config.failure:
        original = Path(config.reproduce)
        failure = failure_row(original, config.failure)
        driven = plan.drive_again(failure, original)
    else:
        driven = drive_watched(plan)
    if plan.settings.shard != WHOLE:
        print(
            f"\nshard {plan.settings.shard[0]} of {plan.settings.shard[1]} written to "
            f"{run.folder}; e2rl merge joins all of them"
        )
        return
    record = plan.record(driven)
    print("", *write_results(plan, record), sep="\n")
    if failure is not None:
        print(f"{config.failure}: {outcome(failure, driven.scored.rows[0])}")
    elif config.reproduce:
        comparison = compared_with_run(config, run.folder)
        print(f"{config.reproduce}: {comparison.text()}")


def begun(config: DictConfig, free: Sequence[str]) -> Run:
    """Returns the run that the command line asks for."""
    with loading():
        from e2rl.evaluation.reproduce import run_of
    return run_of(config, free)


def main() -> None:
    """The command. Its libraries load once the options are read: `--help` and a wrong
    option do without."""
    run_command("evaluate", evaluate, MAY_CHANGE, begun)


if __name__ == "__main__":
    main()
