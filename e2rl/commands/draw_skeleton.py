"""`e2rl skeleton`: the figure of the skeleton, from pairwise risk to an active chain (skeleton.png and .pdf)."""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import run_protocol
from e2rl.report.drawing import save_figure
from e2rl.report.skeleton_figure import LongestChain
from e2rl.run.command import run_command
from e2rl.run.run import Run


def draw(run: Run) -> None:
    """Roll out every scene in this process, listen to the selections, and draw the longest chain."""
    plan = begin(run)
    chain = LongestChain(plan.methods[0])
    run_protocol(plan.setup, plan.methods, plan.asked.seeds, run.folder, only=plan.only)
    save_figure(run.folder / "skeleton.png", chain.figure(plan.scenes, plan.setup.ego_name, run.folder))
    print(f"\ndrawn: {run.folder / 'skeleton.png'}")


def main() -> None:
    """The command."""
    run_command("skeleton", draw)


if __name__ == "__main__":
    main()
