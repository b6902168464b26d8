"""Every planner in the attacks of every set: as they drove, or made anew
(docs/guide/compare.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from e2rl.driving.batches import Batch, split_tasks
from e2rl.driving.setup import Method, Setup, Task, scene_seed
from e2rl.evaluation.attack_set import AttackSet
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.transfer import AGAIN, MODES, REPLAY
from e2rl.scenes.scene_list import read_list
from e2rl.search.tries import TRIES_FILE
from e2rl.search.tries_file import failures_of
from e2rl.traffic.attack_replay import AttackReplay


def replays(plan: Evaluation, sets: Mapping[str, AttackSet]) -> list[Batch]:
    """Returns every planner in the traffic of every set, which drives as it did; the
    seed of a rollout is the number of its attack. Raises InputError for other scenes
    than those of a set."""
    batches: list[Batch] = []
    hashes = {line.scene_id: line.sha256 for line in read_list(plan.run.folder)}
    sizes = plan.scenes.scenes["logged_valid"].shape[1:]
    for name, attacks in sets.items():
        attacks.check_scenes(hashes, sizes)
        tasks = [
            Task(plan.scenes.index(row["scene_id"]), seed=number, noise=number)
            for number, row in enumerate(attacks.rows)
        ]
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
