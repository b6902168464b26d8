"""One failure of a run, driven again: `reproduce=RUN_DIR failure=NAME`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from e2rl.evaluation.budget import TRIES_FILE, failures_of
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.protocol import Part, Task
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import rollout_key


def failure_row(run: Path, name: str) -> dict[str, Any]:
    """Returns the row of a run's failure of this name; InputError where the run has none."""
    found = [row for row in read_rows(run / TABLE) if is_failure(row)]
    for row in found:
        if rollout_key(row) == name:
            return row
    such = f", such as {rollout_key(found[0])}" if found else ""
    raise InputError(f"{name}: no failure of {run}; name one of its {len(found)} in failures.csv{such}")


def part_of(plan: Evaluation, row: Mapping[str, Any], run: Path) -> Part:
    """Returns the rollout of a row of a run's table, to be driven again; plan: of the run's configuration. Raises
    InputError where the run no longer says what was tried."""
    setup = next(each for each in plan.egos.setups(plan.setup) if each.ego_name == row["ego_policy"])
    scene, seed = setup.scenes.index(row["scene_id"]), row["seed"]
    for method in plan.methods:
        if (method.name, float(method.eta)) == (row["method"], row["eta"]):
            return setup, method, [Task(scene, seed)]
    search = next(each for each in plan.searches if each.name == row["method"])
    for _, method, tasks in failures_of(run / TRIES_FILE, setup.ego_name, search, setup):
        for task in tasks:
            if (task.scene, task.seed) == (scene, seed):
                return setup, method, [task]
    raise InputError(f"{run / TRIES_FILE}: no try {seed} of {row['scene_id']}; give the folder of the whole search")


def outcome(then: Mapping[str, Any], rows: list[dict]) -> str:
    """Returns a line that says whether a failure happened again: the same contact, or what else."""
    same = all(row["partner"] == then["partner"] and row["contact_step"] == then["contact_step"] for row in rows)
    before, now = contact_text(then), "".join(map(contact_text, rows))
    return f"the same contact: {now}" if rows and same else f"another outcome: {now or 'no score'}; then {before}"


def contact_text(row: Mapping[str, Any]) -> str:
    """Such as "agent 5 after 3.9 s"."""
    return f"agent {row['partner']} after {row['contact_time']:.1f} s" if row["cfr"] == 1 else "no contact"
