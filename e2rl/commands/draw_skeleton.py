"""`e2rl skeleton`: the figure of the skeleton, from pairwise risk to an active chain (skeleton.png and .pdf)."""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
import hydra
from omegaconf import DictConfig

from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import run_protocol
from e2rl.report.drawing import save_figure
from e2rl.report.skeleton_figure import LongestChain, skeleton_figure
from e2rl.run.config import run_command
from e2rl.run.endings import ending
from e2rl.run.files import alone_in
from e2rl.run.run import Run, how_to_go_on
from e2rl.run.settings import conf_folder


def draw(run: Run) -> None:
    """Roll out every scene in this process, listen to the selections, and draw the longest chain."""
    plan = begin(run)
    chain = LongestChain(plan.methods[0])
    run_protocol(plan.setup, plan.methods, plan.asked.seeds, run.folder, only=plan.only)
    rollout = chain.rollout(plan.scenes, plan.setup.ego_name, run.folder)
    save_figure(run.folder / "skeleton.png", skeleton_figure(rollout, chain.selection))
    print(f"\ndrawn: {run.folder / 'skeleton.png'}")


@hydra.main(version_base="1.3", config_path=str(conf_folder().resolve()), config_name="skeleton")
def command(config: DictConfig) -> None:
    """The figure, as configured."""
    with ending(lambda: how_to_go_on(config)):
        run = Run.of(config)
        with alone_in(run.folder):
            draw(run)


def main() -> None:
    """The command."""
    run_command(command, "skeleton")


if __name__ == "__main__":
    main()
