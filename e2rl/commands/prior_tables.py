"""`e2rl prior-tables`: the prior as traffic beside log replay, constant velocity and IDM, in three tables.

Open-loop accuracy (minADE), the closed loop, and the realism meta-metric over many rollouts of each scene.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
import hydra
from omegaconf import DictConfig

from e2rl.evaluation.displacement_table import open_loop_rows
from e2rl.evaluation.meta_table import meta_rows
from e2rl.evaluation.methods import processes_of
from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import drive_all, record
from e2rl.evaluation.summary import metric_rows
from e2rl.report.results import write_results
from e2rl.run.config import check_counts, run_command
from e2rl.run.endings import ending
from e2rl.run.files import alone_in
from e2rl.run.run import Run, how_to_go_on
from e2rl.run.settings import conf_folder
from e2rl.sim.rollout_file import ROLLOUTS

MAY_CHANGE = ("processes", "launcher")  # when a run is resumed


def prior_tables(run: Run) -> None:
    """Make the rows of the three tables; write and print them."""
    config, folder = run.config, run.folder
    check_counts(config, open_loop_samples=0, meta_rollouts=0)
    plan = begin(run)
    methods, setup, parts = plan.methods, plan.setup, run.parts()
    before, after = [], []
    if config.open_loop_samples:
        before = open_loop_rows(plan.scenes, methods, config.open_loop_samples, config.device, parts)
    into = folder / ROLLOUTS if plan.asked.save_rollouts else None
    scored = drive_all([setup], methods, plan.asked.seeds, into, processes_of(config), plan.only, parts)
    if config.meta_rollouts:
        after = meta_rows(setup, methods, config.meta_rollouts, parts)

    def summarise(*found: list) -> list[dict]:
        return [row | run.origin() for row in (*before, *metric_rows(*found), *after)]

    rows = record(*scored, folder, summarise)
    print("", *write_results(run, plan, rows), sep="\n")


@hydra.main(version_base="1.3", config_path=str(conf_folder().resolve()), config_name="prior_tables")
def command(config: DictConfig) -> None:
    """The tables, as configured."""
    with ending(lambda: how_to_go_on(config)):
        run = Run.of(config, MAY_CHANGE)
        with alone_in(run.folder):
            prior_tables(run)


def main() -> None:
    """The command."""
    run_command(command, "prior_tables")


if __name__ == "__main__":
    main()
