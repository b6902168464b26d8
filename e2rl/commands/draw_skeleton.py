"""`e2rl skeleton`: figures of the skeleton, from pairwise risk to an active chain, and of the effect of anchoring."""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import run_protocol
from e2rl.report.drawing import save_figure
from e2rl.report.skeleton_figure import LongestChain
from e2rl.run.command import run_command
from e2rl.run.run import Run


def draw(run: Run) -> None:
    """Roll out every scene in this process and draw the longest chain selected; with a second method
    also the longest one of the start under both."""
    plan = begin(run)
    chain = LongestChain(plan.methods[0])
    run_protocol(plan.setup, plan.methods, plan.asked.seeds, run.folder, only=plan.only)
    where = plan.scenes, plan.setup.ego_name, run.folder
    figures = {"skeleton": chain.figure(*where)}
    for other in plan.methods[1:2]:
        if figure := chain.beside(other, *where):
            figures["anchoring"] = figure
    for name, figure in figures.items():
        save_figure(run.folder / f"{name}.png", figure)
        print(f"drawn: {run.folder / f'{name}.png'}")


def main() -> None:
    """The command."""
    run_command("skeleton", draw)
