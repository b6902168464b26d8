"""The closed-loop protocol: methods x scenes x seeds with one ego, the files of a run
(docs/method.md, section 11)."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from e2rl.evaluation import rollout_files as files
from e2rl.evaluation.modes import ATLAS_FILE, MODES_FILE, find_atlas, find_modes
from e2rl.evaluation.summary import empty_rows, group_of, metric_rows
from e2rl.metrics.catalogue import SOURCE
from e2rl.metrics.errored import errored_row, lost
from e2rl.metrics.evasion import add_avoidable
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.run.processes import Processes, in_processes
from e2rl.run.terminal import Bar
from e2rl.scenes.scene import SceneSet
from e2rl.search.tries import Try
from e2rl.sim.env import SimSettings
from e2rl.sim.rollout_file import ROLLOUTS, UNPRINTABLE, rollout_name
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.attempt import attempt, count_reasons
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Traffic

SEEDS_APART = 1_000_003
WHOLE = (0, 1)  # the only shard of a run
# Rows and realism samples, one of each per rollout; and the entries of errored.json,
# whose rows know nothing else.
Scored = tuple[list[dict], list[dict[str, Tensor]], list[dict]]


class Task(NamedTuple):
    """A rollout to make: the position of its scene, its seed (of a search: its number),
    and its try (None: none)."""

    scene: int
    seed: int
    one: Try | None = None


@dataclass
class Method:
    """A row of the table: name, traffic and intensity."""

    name: str
    traffic: Traffic
    eta: float = 0.0

    def __post_init__(self) -> None:
        check_names(self.name)


@dataclass
class Setup:
    """What all methods of a table share."""

    scenes: SceneSet
    ego: Ego
    ego_name: str  # in files
    sim: SimSettings
    batch: int = 64  # rollouts at once
    device: str = "cpu"
    evasions: bool = True  # collisions are searched for evasions

    def __post_init__(self) -> None:
        """InputError where two scenes share an id, and so the files of their rollouts,
        or a name is not printable."""
        scenes = self.scenes
        if twice := [
            name for name, count in Counter(scenes.scene_id).items() if count > 1
        ]:
            mend = "give each an id of its own in the data, or list the scenes to take with scenes=FILE"
            raise InputError(
                f"scene id {twice[0]!r}: stands for several scenes; {mend}"
            )
        check_names(
            scenes.dataset,
            scenes.split,
            self.ego_name,
            *scenes.scene_id,
            *scenes.location,
        )

    def roll_out(self, method: Method, tasks: Sequence[Task]) -> Rollouts:
        """The rollouts of (scene, seed) pairs under one method."""
        index = torch.tensor([task.scene for task in tasks])
        tries = [task.one for task in tasks if task.one]
        noise = torch.tensor(
            [scene_seed(self.scenes.number[task.scene], task.seed) for task in tasks]
        )
        noise = torch.tensor([one.seed for one in tries]) if tries else noise
        decisions = torch.tensor([one.decisions for one in tries]) if tries else None
        eta = torch.full((len(tasks),), float(method.eta), dtype=torch.float64)
        given = (self.ego, method.traffic, self.sim, self.device)
        rollouts = roll_out(self.scenes, index, noise, eta, *given, decisions=decisions)
        rollouts.seed = torch.tensor([task.seed for task in tasks])
        for name, text in zip(SOURCE, self.source(method), strict=True):
            rollouts.set(name, [text] * len(tasks))
        return rollouts

    def source(self, method: Method) -> tuple[str, str, str, str]:
        """Values of the columns SOURCE of a method's rollouts."""
        return self.scenes.dataset, self.scenes.split, method.name, self.ego_name

    def score(
        self,
        method: Method,
        tasks: Sequence[Task],
        folder: Path | None = None,
        begins: bool = False,
    ) -> Scored:
        """What (scene, seed) pairs score under one method.

        Args:
            method: of the traffic.
            tasks: the pairs.
            folder: for the rollouts' files.
            begins: the ego begins the run with them; then InputError where its first
                plan is none.
        """
        parts, errored = attempt(partial(self.roll_out, method), tasks, begins=begins)
        rows = []
        samples = []
        for done, rollouts in parts:
            found, features = score_rollouts(rollouts)
            if self.evasions:
                add_avoidable(
                    found,
                    rollouts,
                    scene=self.scenes.batch([task.scene for task in done]),
                    sim=self.sim,
                )
            if folder is not None:
                rollouts.to_npz(folder)
            rows += found
            samples += features
        about = dict(zip(SOURCE, self.source(method), strict=True)) | {
            "eta": float(method.eta)
        }
        names = self.scenes.scene_id
        places = self.scenes.location
        scene = [
            {"scene_id": names[task.scene], "location": places[task.scene]}
            for task, _ in errored
        ]
        lost = [
            about | each | {"seed": task.seed} | why
            for each, (task, why) in zip(scene, errored, strict=True)
        ]
        return rows, samples, lost


def check_names(*names: str) -> None:
    """InputError for a name that a terminal or a table could not show as it is."""
    if odd := next(filter(UNPRINTABLE.search, names), None):
        raise InputError(
            f"the name {odd!r}: holds control characters; rename it in the data or the configuration"
        )


Part = tuple[Setup, Method, list[Task]]
Job = tuple[str, Part]  # with its name


def scene_seed(number: int, seed: int) -> int:
    """The noise seed of a rollout in a scene of this number, the same for every method
    (paired)."""
    return seed * SEEDS_APART + number


@dataclass(frozen=True)
class Work:
    """How rollouts are driven, which changes none of them.

    Args:
        into: folder of the rollouts' files (None: none).
        processes: over which the batches are spread.
        only: positions of the scenes to drive in (None: all), with unchanged noise.
        parts: the batches that are done.
        shard: (k, n), only every n-th batch from the k-th on; a search has one shard.
    """

    into: Path | None = None
    processes: Processes = 1
    only: Sequence[int] | None = None
    parts: Parts = NO_PARTS
    shard: tuple[int, ...] = WHOLE

    def scenes(self, setup: Setup) -> Sequence[int]:
        """Positions of the scenes to drive in."""
        return range(len(setup.scenes)) if self.only is None else self.only


HERE = Work()  # in this process, and nothing is written


def run_protocol(
    setup: Setup,
    methods: Sequence[Method],
    seeds: Sequence[int],
    folder: Path | None = None,
    processes: Processes = 1,
    only: Sequence[int] | None = None,
    parts: Parts = NO_PARTS,
    **fields: Any,
) -> list[dict]:
    """The rows of metrics.json of every method on every (scene, seed): `drive_all`,
    then `record` into a folder (None: nothing is written). fields: added to each row,
    or further arguments of `metric_rows`."""
    scored = drive_all(
        [setup],
        methods,
        seeds=seeds,
        work=Work(folder and folder / ROLLOUTS, processes, only=only, parts=parts),
    )
    return record(*scored, folder, partial(metric_rows, **fields))


def drive_all(
    setups: Sequence[Setup],
    methods: Sequence[Method],
    seeds: Sequence[int],
    work: Work = HERE,
) -> Scored:
    """What every setup scores under every method on every (scene, seed); the noise is
    the same for all.

    setups: they differ in their ego.
    """
    first = setups[0]
    batches = in_batches(
        [Task(scene, seed) for seed in seeds for scene in work.scenes(first)],
        first.batch,
    )
    parts = enumerate(
        (setup, method, batch)
        for setup in setups
        for method in methods
        for batch in batches
    )
    jobs = [(f"rollouts-{number:06}", part) for number, part in parts][
        work.shard[0] :: work.shard[1]
    ]
    found: Scored = ([], [], [])
    total = sum(len(batch) for _, (_, _, batch) in jobs)
    with Bar(total=total, desc="rollouts", unit="rollout") as bar:

        def done(job: Job) -> None:
            _, (setup, method, batch) = job
            bar.set_postfix(
                ego=setup.ego_name, method=method.name, eta=method.eta, refresh=False
            )
            bar.update(len(batch))

        for scored in score_all(
            jobs,
            work,
            cost=lambda job: job[1][1].eta,
            done=done,
            first=first_names(jobs),
        ):
            extend(found, scored)
    return found


def first_names(jobs: Sequence[Job]) -> set[str]:
    """Returns the names of the first job of each ego."""
    return set({part[0].ego_name: name for name, part in reversed(jobs)}.values())


def in_batches(tasks: Sequence[Task], size: int) -> list[list[Task]]:
    """The tasks in as few batches of at most `size` as can be, of about the same
    length."""
    count = -(-len(tasks) // size)
    return [
        list(tasks[k * len(tasks) // count : (k + 1) * len(tasks) // count])
        for k in range(count)
    ]


def score_all(
    jobs: Sequence[Job],
    how: Work,
    cost: Callable[[Job], float],
    done: Callable[[Job], None] = lambda job: None,
    first: Collection[str] = (),
) -> Iterator[Scored]:
    """What each of some batches of rollouts scores, in their order.

    A batch is the unit that is checkpointed: rounding makes a rollout's last digits
    depend on the others of its batch. Raises InputError where files of a worker do not
    arrive, and where an ego's very first plan is none.

    Args:
        jobs: with names for their parts.
        how: of the work, `only` and `shard` are in the jobs.
        cost: by which a job takes longer than others.
        done: called with each job that is done.
        first: names of the jobs with which an ego begins the run.
    """

    into, parts = how.into, how.parts  # what goes to the workers

    def work(job: Job) -> Scored:
        name, (setup, method, batch) = job
        told = [
            (task.scene, task.seed) if task.one is None else list(task.one)
            for task in batch
        ]
        identity = [setup.ego_name, method.name, float(method.eta), told]
        score = partial(setup.score, method, batch, into, begins=name in first)
        return parts.result(name, identity, score, partial(has_files, into))

    for scored in in_processes(
        work, jobs, processes=how.processes, cost=cost, ended=done
    ):
        if not has_files(into, scored):
            reason = "rollouts that a worker wrote are not here"
            raise InputError(
                f"{into}: {reason}; put the run's folder where all machines have it (hydra.run.dir)"
            )
        rows, samples, errored = scored
        yield (
            rows + list(map(errored_row, errored)),
            samples + [NO_SAMPLES] * len(errored),
            errored,
        )


def extend(found: Scored, more: Scored) -> None:
    """Add what was scored."""
    for whole, part in zip(found, more, strict=True):
        whole += part


def has_files(into: Path | None, scored: Scored) -> bool:
    """Whether the files of scored rollouts are in the folder `into`."""
    return into is None or all(
        (into / rollout_name(row)).is_file() for row in scored[0]
    )


def record(
    rows: list[dict],
    samples: list[dict[str, Tensor]],
    errored: list[dict],
    folder: Path | None,
    summarise: Callable[..., list[dict]],
) -> list[dict]:
    """The rows of metrics.json: summarise(rows, samples), with the counts of what
    errored where they have none.

    Writes rollouts.csv, modes.json, atlas.json, metrics.json and, where rollouts
    errored, errored.json into a folder. A method of which the traffic lost all rollouts
    has a row too, without metrics. Raises InputError where it lost those of all.
    """
    modes = find_modes(rows)
    if folder is not None:
        files.write_errored(folder / files.ERRORED_FILE, errored)
        files.write_rows(folder / files.TABLE, rows)
    files.require_rows([row for row in rows if not lost(row)], errored, folder=folder)
    known = summarise(rows, samples)
    known += empty_rows(known, errored)
    result = [
        {
            "errored": count_reasons(
                why for why in errored if group_of(why) == group_of(row)
            )
        }
        | row
        for row in known
    ]
    if folder is not None:
        files.write_json(folder / MODES_FILE, modes)
        files.write_json(folder / ATLAS_FILE, find_atlas(rows))
        files.write_json(folder / files.METRICS_FILE, result)
    return result
