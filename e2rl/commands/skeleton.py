"""`e2rl skeleton`: from pairwise risk to an active chain, for one coalition of a real
rollout (Sec. IV-A), as a picture.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from dataclasses import replace

from e2rl.evaluation.plan import begin
from e2rl.report.drawing import save_figure
from e2rl.report.skeleton import LongestChain
from e2rl.run.command import run_command
from e2rl.run.run import Run


def draw(run: Run) -> None:
    """Roll out every scene in this process and draw the longest chain selected."""
    plan = begin(run)
    chain = LongestChain(plan.methods[0])
    plan = replace(plan, work=replace(plan.work, processes=1))
    plan.record(plan.drive(), run.folder)
    picture = run.folder / "skeleton.png"
    save_figure(picture, chain.figure(plan.scenes, plan.setup.ego_name, run.folder))
    print(f"drawn: {picture}")


def main() -> None:
    """The command."""
    run_command("skeleton", draw)
