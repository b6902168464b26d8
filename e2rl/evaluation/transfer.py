"""Every planner in the attacks of every set: as they drove, or made anew; and the matrix
of what comes of it (docs/guide/compare.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product, starmap
from pathlib import Path
from statistics import median
from typing import Any

from e2rl.driving.batches import Batch, split_tasks
from e2rl.driving.setup import Method, Setup, Task, scene_seed
from e2rl.evaluation.attack_set import AttackSet
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.rollout_files import NUMBER, nans, read_json, write_json
from e2rl.evaluation.summary import UNKNOWN
from e2rl.metrics.errored import lost
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import summarise
from e2rl.run.errors import InputError
from e2rl.run.files import misfit
from e2rl.scenes.scene_list import read_list
from e2rl.search.tries_file import TRIES_FILE, failures_of
from e2rl.traffic.attack_replay import AttackReplay

CROSS_FILE = "cross.json"
REPLAY = "replay"
AGAIN = "again"
MODES = {REPLAY: "against", AGAIN: "again"}  # how methods' names begin
RATES = {"hit": "cfr", "preventable": "cfr_preventable"}
RATE = dict.fromkeys(("mean", "low", "high", "n"), NUMBER)
MATRIX = {
    "egos": [str],
    "sets": [{"name": str, "ego": str, "attacks": int, "scenes": int, "nats": NUMBER}],
    "cells": [{"mode": str, "set": str, "ego": str, **dict.fromkeys(RATES, RATE)}],
}


def replays(plan: Evaluation, sets: Mapping[str, AttackSet]) -> list[Batch]:
    """Returns every planner in the traffic of every set, which drives as it did. Raises
    InputError for other scenes than those of the set, or of other sizes."""
    batches: list[Batch] = []
    hashes = {line.scene_id: line.sha256 for line in read_list(plan.run.folder)}
    for name, attacks in sets.items():
        tasks = attacks.tasks(plan.scenes, hashes)
        frames, agents = attacks.tracks.valid.shape[1:]
        scenes = plan.scenes.scenes["logged_valid"]
        if (frames, agents) != tuple(scenes.shape[1:]):
            raise InputError(
                f"attacks on {attacks.ego}: have {frames} frames of {agents} agents, the "
                f"scenes {list(scenes.shape[1:])}; set data.build as in their run"
            )
        method = Method(f"{MODES[REPLAY]}-{name}", AttackReplay(attacks.tracks))
        batches += batches_of(plan.setups, method, tasks)
    return batches


def batches_of(
    setups: Sequence[Setup], method: Method, tasks: Sequence[Task]
) -> Iterator[Batch]:
    """Yields tasks of one method against every planner."""
    for setup in setups:
        for part in split_tasks(tasks, setup.batch):
            yield Batch(setup, method, part)


def made_again(
    plan: Evaluation, sets: Mapping[str, AttackSet], found: Path
) -> list[Batch]:
    """Returns the attacks of every set made anew against every planner, in the same
    scenes, with the same noise and decisions.

    Args:
        plan: that the attacks were found by.
        sets: by name.
        found: folder of their tries, where they were searched for.
    """
    batches: list[Batch] = []
    for (name, attacks), setup in product(sets.items(), plan.setups):
        numbers = {
            (row["method"], row["eta"], row["scene_id"], row["seed"]): number
            for number, row in enumerate(attacks.rows)
        }
        searched = {row["method"] for row in attacks.rows}
        first = once_each(plan, setup)
        for search in plan.searches:
            if search.name in searched:
                first += failures_of(
                    found / TRIES_FILE, attacks.ego, method=search, setup=setup
                )
        for batch in first:
            method = batch.method
            tasks = []
            for task in batch.tasks:
                scene_id = plan.scenes.scene_id[task.scene]
                key = (method.name, method.eta, scene_id, task.seed)
                if key in numbers:
                    tasks.append(task._replace(seed=numbers[key]))
            again = replace(method, name=f"{MODES[AGAIN]}-{name}")
            if tasks:
                batches += batches_of([setup], again, tasks)
    return batches


def once_each(plan: Evaluation, setup: Setup) -> list[Batch]:
    """Returns the rollouts of a planner that a plan without a budget drives."""
    numbers = plan.scenes.number
    tasks = [
        Task(scene, seed, noise=scene_seed(numbers[scene], seed))
        for seed in plan.settings.seeds
        for scene in plan.work.scenes(setup)
    ]
    return [Batch(setup, method, tasks) for method in plan.methods]


# --- the matrix


@dataclass(frozen=True)
class Matrix:
    """How often every planner fails under the attacks of every set, content of
    CROSS_FILE.

    Args:
        egos: the planners that drive.
        sets: `name`, planner, number of attacks and of their scenes, median of nats.
        cells: RATES of each of `egos` under each set, by mode. Where the set or the ego
            is "": of all together, but for planners under their own attacks.
    """

    egos: list[str]
    sets: list[dict[str, Any]]
    cells: list[dict[str, Any]]

    @classmethod
    def of(
        cls,
        egos: Sequence[str],
        sets: Mapping[str, AttackSet],
        rows: Sequence[Mapping],
    ) -> "Matrix":
        """Returns the matrix of rollouts.

        Args:
            egos: the planners that drive.
            sets: by name.
            rows: of rollouts.csv, their methods named after modes and sets.
        """
        cells = []
        for mode, beginning in MODES.items():
            names = {f"{beginning}-{name}": name for name in sets}
            driven = [
                (names[row["method"]], row["ego_policy"], row)
                for row in rows
                if row["method"] in names and not lost(row)
            ]
            for name, ego in product((*sets, ""), (*egos, "")) if driven else ():
                chosen = [
                    row
                    for source, driver, row in driven
                    if name in ("", source)
                    and ego in ("", driver)
                    and ((name and ego) or sets[source].ego != driver)
                ]
                identity = {"mode": mode, "set": name, "ego": ego}
                cells.append(identity | rates_of(chosen))
        return cls(list(egos), list(starmap(facts_of, sets.items())), cells)

    @classmethod
    def read(cls, run: Path) -> "Matrix":
        """Returns the matrix in a run's folder; InputError where its file is
        damaged."""
        content = read_json(run / CROSS_FILE, lambda value: misfit(value, MATRIX))
        sets, cells = (list(map(nans, content[name])) for name in ("sets", "cells"))
        return cls(content["egos"], sets, cells)

    def write(self, run: Path) -> None:
        """Write CROSS_FILE into a run's folder."""
        write_json(run / CROSS_FILE, vars(self))

    def rate(self, mode: str, name: str, ego: str, event: str) -> dict[str, float]:
        """Returns one of RATES of a cell."""
        for cell in self.cells:
            if (cell["mode"], cell["set"], cell["ego"]) == (mode, name, ego):
                return cell[event]
        return UNKNOWN


def facts_of(name: str, attacks: AttackSet) -> dict[str, Any]:
    """Returns what the matrix says of a set."""
    return {
        "name": name,
        "ego": attacks.ego,
        "attacks": len(attacks.rows),
        "scenes": len(attacks.scenes),
        "nats": median(attacks.tracks.nats.sum(1).tolist()),
        "origin": attacks.origin,
    }


def rates_of(rows: Sequence[Mapping]) -> dict[str, dict[str, float]]:
    """Returns RATES of rollouts with intervals over their places."""
    if not rows:
        return dict.fromkeys(RATES, UNKNOWN)
    metrics = summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0)
    return {event: metrics[column] for event, column in RATES.items()}
