"""Batches of rollouts: driven in several processes, each kept on disk as it ends."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from e2rl.driving.scored import Scored
from e2rl.driving.setup import Method, Setup, Task
from e2rl.metrics.errored import errored_row
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.run.processes import in_processes
from e2rl.run.terminal import Bar
from e2rl.sim.rollout_file import rollout_name

WHOLE = (0, 1)  # the only shard of a run


class Batch(NamedTuple):
    """Rollouts of one method against one ego, which are driven at once."""

    setup: Setup
    method: Method
    tasks: list[Task]


Job = tuple[str, Batch]  # a batch with its name
Result = tuple[list, list, list]  # rows, samples and errors of a batch


@dataclass(frozen=True)
class Work:
    """How rollouts are driven, which changes none of them.

    Args:
        into: folder of the rollouts' files (None: none).
        processes: over which the batches are spread.
        only: positions of the scenes to drive in (None: all), with unchanged noise.
        parts: the batches that are on disk.
        shard: (k, n), only every n-th batch from the k-th on; a search has one shard.
        watch: called with what each batch scored.
    """

    into: Path | None = None
    processes: int = 1
    only: Sequence[int] | None = None
    parts: Parts = NO_PARTS
    shard: tuple[int, ...] = WHOLE
    watch: Callable[[Scored], object] = lambda scored: None

    def scenes(self, setup: Setup) -> Sequence[int]:
        """Returns the positions of the scenes to drive in."""
        return range(len(setup.scenes)) if self.only is None else self.only


HERE = Work()  # in this process, and nothing is written


def drive_all(
    setups: Sequence[Setup],
    methods: Sequence[Method],
    seeds: Sequence[int],
    work: Work = HERE,
) -> Scored:
    """Returns what every setup scores under every method on every (scene, seed).

    Args:
        setups: differ in their ego; the noise is the same for all.
        methods: of the traffic.
        seeds: of the noise.
        work: how, and in which scenes.
    """
    scenes = work.scenes(setups[0])
    tasks = [Task(scene, seed) for seed in seeds for scene in scenes]
    batches = [
        Batch(setup, method, part)
        for setup in setups
        for method in methods
        for part in split_tasks(tasks, setups[0].batch)
    ]
    return drive_batches(batches, work)


def drive_batches(batches: Sequence[Batch], work: Work = HERE) -> Scored:
    """Returns what batches score, in their order; of a shard those of its own."""
    first, step = work.shard
    jobs = [(f"rollouts-{number:06}", batch) for number, batch in enumerate(batches)]
    jobs = jobs[first::step]
    total = sum(len(batch.tasks) for _, batch in jobs)
    result = Scored()
    with Bar(total=total, desc="rollouts", unit="rollout") as bar:
        for scored in score_all(
            jobs,
            work,
            cost=lambda job: job[1].method.eta,
            ended=lambda job: bar.update(len(job[1].tasks)),
            begins=True,
        ):
            result.add(scored)
    return result


def split_tasks(tasks: Sequence[Task], size: int) -> list[list[Task]]:
    """Returns the tasks in as few batches of at most `size` as can be, of about the
    same length."""
    count = -(-len(tasks) // size)
    ends = [len(tasks) * number // count for number in range(count + 1)]
    return [list(tasks[ends[k] : ends[k + 1]]) for k in range(count)]


def score_all(
    jobs: Sequence[Job],
    work: Work,
    *,
    cost: Callable[[Job], float],
    ended: Callable[[Job], object] = lambda job: None,
    begins: bool = False,
) -> Iterator[Scored]:
    """Returns what each of some batches scores, in their order.

    A batch is what is kept on disk: rounding makes a rollout's last digits depend on
    the others of its batch.

    Args:
        jobs: batches with names for their parts.
        work: how; its `only` and `shard` are in the jobs.
        cost: by which a job takes longer than others.
        ended: called with each job that has ended.
        begins: whether each ego begins the run with its first job.

    Raises:
        InputError: where the very first plan of an ego is none.
    """
    first = {batch.setup.ego_name: name for name, batch in reversed(jobs)}
    opening = set(first.values()) if begins else set()
    for result in in_processes(
        lambda job: scored_batch(*job, work, begins=job[0] in opening),
        jobs,
        processes=work.processes,
        cost=cost,
        ended=ended,
    ):
        yield with_errored(result, work)


def scored_batch(name: str, batch: Batch, work: Work, begins: bool) -> Result:
    """Returns what a batch scores, read where it is on disk.

    Args:
        name: of its part.
        batch: that is driven.
        work: how.
        begins: its ego begins the run with it.
    """
    setup, method, tasks = batch
    identity = [
        setup.ego_name,
        method.name,
        float(method.eta),
        [list(task) for task in tasks],
    ]

    def score() -> Result:
        scored = setup.score(method, tasks, folder=work.into, begins=begins)
        return scored.rows, scored.samples, scored.errored

    valid = partial(has_files, work.into)
    return work.parts.result(name, identity, score, valid=valid)


def with_errored(result: Result, work: Work) -> Scored:
    """Returns a `scored_batch` with a row for each rollout that errored, of which
    `work.watch` is told."""
    rows, samples, errored = result
    scored = Scored(rows, samples, errored=errored)
    scored.rows += map(errored_row, scored.errored)
    scored.samples += [NO_SAMPLES] * len(scored.errored)
    work.watch(scored)
    return scored


def has_files(into: Path | None, result: tuple[list, list, list]) -> bool:
    """Returns whether the files of scored rollouts are in the folder `into`."""
    return into is None or all(
        (into / rollout_name(row)).is_file() for row in result[0]
    )
