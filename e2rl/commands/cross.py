"""`e2rl cross ['+egos.NAME={ego: FILE}' ...] [data=...]`: how far failures of one planner
are failures of others (docs/guide/compare.md).

Writes the failures that are found (found/), a file of each planner's (attacks/),
cross.json, cross.md and cross.png, and of all planners in all attacks what an evaluation
writes: rollouts.csv, rollouts/, metrics.json, modes.json, failures.html.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from dataclasses import replace
from pathlib import Path

from omegaconf import OmegaConf

from e2rl.driving.batches import drive_batches
from e2rl.evaluation.attack_set import ENDING, KEPT, AttackSet, kept, named
from e2rl.evaluation.crossing import made_again, replays
from e2rl.evaluation.plan import Evaluation, begin
from e2rl.evaluation.record import record
from e2rl.evaluation.transfer import Matrix
from e2rl.report.cross import cross_tables, headline
from e2rl.report.cross_picture import draw_matrix
from e2rl.report.html import write_report
from e2rl.report.tables import save_tables
from e2rl.run.command import run_command
from e2rl.run.config import check_choice
from e2rl.run.errors import InputError
from e2rl.run.options import check_unused
from e2rl.run.parts import Parts
from e2rl.run.run import Run
from e2rl.sim.rollout_file import ROLLOUTS, file_stem

FOUND = "found"  # folder of the search, and stage of its parts
CROSSED = "crossed"  # stage of the parts of the matrix
MAY_CHANGE = ("processes",)  # when a run is resumed


def cross(run: Run) -> None:
    """Find failures of each planner, drive every planner in all of them, and print how
    many are its own, too."""
    config = run.config
    check_unused(config, "e2rl cross", ("reproduce", "failure", "shard", "compare"))
    if not config.egos:
        OmegaConf.update(config, "egos", config.planners, force_add=True)
    check_choice("keep", config.keep, choices=tuple(KEPT))
    if config.again and (config.attacks or config.keep == "all"):
        raise InputError(
            "again=true: makes failures anew that this run has found; leave out attacks, "
            "and keep hit or preventable ones"
        )
    files = ", ".join(config.attacks)
    plan = begin(run, against=f"the attacks in {files}" if files else "")
    sets = named(read_sets(plan) if config.attacks else found_sets(plan))
    batches = replays(plan, sets)
    if config.again:
        batches += made_again(plan, sets, run.folder / FOUND)
    about = " ".join(attacks.digest for attacks in sets.values())
    work = replace(
        plan.work,
        into=run.folder / ROLLOUTS,
        parts=Parts(run.folder, CROSSED, about=about),
    )
    scored = drive_batches(batches, work)
    driven = record(
        scored, run.folder, config=config, searched=False, references=(), **plan.origin
    )
    egos = [setup.ego_name for setup in plan.setups]
    matrix = Matrix.of(egos, sets, driven.rollouts)
    matrix.write(run.folder)
    tables = cross_tables(matrix)
    save_tables(run.folder / "cross.md", tables)
    draw_matrix(run.folder / "cross.png", matrix)
    lines = [table.text() for table in cross_tables(matrix, narrow=True)]
    if config.report:
        lines.append(f"Its failures: {write_report(run.folder, driven)}")
    print("", headline(matrix), "", "\n\n".join(lines), sep="\n")
    print(f"Written to {run.folder}")


def found_sets(plan: Evaluation) -> list[AttackSet]:
    """Returns what is found against each planner, and writes it; InputError where
    nothing is."""
    run = plan.run
    folder = run.folder / FOUND
    keep = run.config.keep
    work = replace(plan.work, into=folder / ROLLOUTS, parts=Parts(run.folder, FOUND))
    found = plan.record(replace(plan, work=work).drive(), folder)
    attacks = kept(found.rollouts, keep)
    if not attacks:
        raise InputError(
            f"keep={keep}: no such rollout of {', '.join(plan.egos.egos)} was found; "
            "raise budget or eta, drive more scenes, or set keep=hit"
        )
    sets = AttackSet.of_run(folder, attacks, begun=run.folder)
    for each in sets:
        each.write(run.folder / "attacks" / f"{file_stem(each.ego)}{ENDING}")
    return sets


def read_sets(plan: Evaluation) -> list[AttackSet]:
    """Returns the sets in the files of `attacks`."""
    return [AttackSet.read(Path(path)) for path in plan.run.config.attacks]


def main() -> None:
    """The command."""
    run_command("cross", cross, may_change=MAY_CHANGE)
