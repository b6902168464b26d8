"""The closed-loop protocol: methods x scenes x seeds with one ego, the files of a run (docs/method.md, section 11)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from e2rl.evaluation.modes import MODES_FILE, find_modes, write_modes
from e2rl.evaluation.rollout_files import (
    ENDED_FILE,
    METRICS_FILE,
    ROLLOUTS,
    TABLE,
    Source,
    label_rows,
    require_rows,
    rollout_name,
    write_ended,
    write_metrics,
    write_rollouts,
    write_rows,
)
from e2rl.evaluation.summary import empty_rows, metric_rows
from e2rl.metrics.evasion import add_avoidable
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.parts import NOTHING_KEPT, Kept
from e2rl.run.processes import Processes, in_processes
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.traffic.attempt import attempt, count_reasons
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Traffic

SEEDS_APART = 1_000_003
WHOLE = (0, 1)  # the only share of a run
Task = tuple[int, int]  # position of a scene, sampling seed
# Labelled rows and realism samples, one of each per rollout; and what the rollouts without a score ended by.
Scored = tuple[list[dict], list[dict[str, Tensor]], list[dict]]


@dataclass
class Method:
    """A row of the table: name, traffic and intensity."""

    name: str
    traffic: Traffic
    eta: float = 0.0


@dataclass
class Setup:
    """Shared by all methods of a table: scenes, ego and its name in files, simulator, batch of rollouts, whether the
    collisions are searched for evasions."""

    scenes: SceneSet
    ego: Ego
    ego_name: str
    sim: SimSettings
    batch: int = 64
    device: str = "cpu"
    evasions: bool = True

    def roll_out(self, method: Method, tasks: Sequence[Task]) -> dict:
        """The rollout dict of (scene, seed) pairs under one method."""
        index = torch.tensor([scene for scene, _ in tasks])
        noise = torch.tensor([scene_seed(self.scenes.number[scene], seed) for scene, seed in tasks])
        eta = torch.full((len(tasks),), float(method.eta))
        rollouts = roll_out(self.scenes, index, noise, eta, self.ego, method.traffic, self.sim, self.device)
        return rollouts | {"seed": torch.tensor([seed for _, seed in tasks]), "eta": float(method.eta)}

    def score(self, method: Method, tasks: Sequence[Task], folder: Path | None = None) -> Scored:
        """Rows and realism samples of (scene, seed) pairs under one method, and the pairs that ended without; folder:
        for the rollouts' files."""
        source = Source(self.scenes.dataset, self.scenes.split, method.name, self.ego_name)
        parts, lost = attempt(partial(self.roll_out, method), tasks)
        rows, samples = [], []
        for done, rollouts in parts:
            found, features = score_rollouts(rollouts)
            if self.evasions:
                scene = self.scenes.batch([scene for scene, _ in done])
                rollouts["evasion"] = add_avoidable(found, rollouts, scene, self.sim)
            if folder is not None:
                write_rollouts(folder, rollouts, source)
            rows += label_rows(found, source)
            samples += features
        about = vars(source) | {"eta": float(method.eta)}
        ended = [about | {"scene_id": self.scenes.scene_id[scene], "seed": seed} | why for (scene, seed), why in lost]
        return rows, samples, ended


Job = tuple[int, tuple[Setup, Method, list[Task]]]  # with its number


def scene_seed(number: int, seed: int) -> int:
    """The noise seed of a rollout in a scene of this number, the same for every method (paired)."""
    return seed * SEEDS_APART + number


def run_protocol(
    setup: Setup,
    methods: Sequence[Method],
    seeds: Sequence[int],
    folder: Path | None = None,
    save_rollouts: bool = True,
    processes: Processes = 1,
    only: Sequence[int] | None = None,
    kept: Kept = NOTHING_KEPT,
    **fields: Any,
) -> list[dict]:
    """Roll out every method on every (scene, seed), score, and return the rows of metrics.json.

    folder: where rollouts/ (if save_rollouts), rollouts.csv, modes.json and metrics.json are written (None: nowhere);
    processes: over which the rollouts are spread, with the same rows; only: positions of the scenes to run, with
    unchanged noise (None: all); kept: batches of rollouts that are finished. fields are added to each row.
    """
    into = folder / ROLLOUTS if folder is not None and save_rollouts else None
    found = drive_all([setup], methods, seeds, into, processes, only, kept)
    return record(*found, folder, partial(metric_rows, **fields))


def drive_all(
    setups: Sequence[Setup],
    methods: Sequence[Method],
    seeds: Sequence[int],
    into: Path | None = None,
    processes: Processes = 1,
    only: Sequence[int] | None = None,
    kept: Kept = NOTHING_KEPT,
    share: tuple[int, int] = WHOLE,
) -> Scored:
    """Roll out and score every setup, which differ in their ego, under every method on every (scene, seed).

    into: folder of the rollouts' files (None: none); share (k, n): only every n-th batch from the k-th on; others: as
    for `run_protocol`. The noise is the same for all. Raises InputError where files of a worker do not arrive.

    A batch is the unit that is kept: rounding makes a rollout's last digits depend on the others of its batch.
    """
    first = setups[0]
    tasks = [(scene, seed) for seed in seeds for scene in (range(len(first.scenes)) if only is None else only)]
    count = -(-len(tasks) // first.batch)
    parts = [tasks[k * len(tasks) // count : (k + 1) * len(tasks) // count] for k in range(count)]
    jobs = list(enumerate((setup, method, part) for setup in setups for method in methods for part in parts))
    jobs = jobs[share[0] :: share[1]]

    def work(job: Job) -> Scored:
        number, (setup, method, part) = job
        identity = [setup.ego_name, method.name, float(method.eta), part]
        compute = partial(setup.score, method, part, into)
        return kept.result(f"rollouts-{number:06}", identity, compute, partial(has_files, into))

    rows, features, lost = [], [], []
    total = sum(len(part) for _, (_, _, part) in jobs)
    with tqdm(total=total, desc="rollouts", unit="rollout", disable=None) as bar:

        def ended(job: Job) -> None:
            _, (setup, method, part) = job
            bar.set_postfix(ego=setup.ego_name, method=method.name, eta=method.eta, refresh=False)
            bar.update(len(part))

        for found, samples, without in in_processes(work, jobs, processes, lambda job: job[1][1].eta, ended):
            if not has_files(into, (found, samples, without)):
                reason = "rollouts that a worker wrote are not here"
                raise InputError(f"{into}: {reason}; put the run's folder where all machines have it (hydra.run.dir)")
            rows += found
            features += samples
            lost += without
    return rows, features, lost


def has_files(into: Path | None, scored: Scored) -> bool:
    """Whether the files of scored rollouts are in the folder `into`."""
    return into is None or all((into / rollout_name(row)).is_file() for row in scored[0])


def record(
    rows: list[dict],
    features: list[dict[str, Tensor]],
    ended: list[dict],
    folder: Path | None,
    summarise: Callable[..., list[dict]],
) -> list[dict]:
    """The rows of metrics.json, summarise(rows, features), with the counts of what ended.

    Writes rollouts.csv, modes.json, metrics.json and, where rollouts ended without a score, ended.json. Raises
    InputError where all did. A method of which all rollouts ended has a row too, without metrics.
    """
    if folder is not None:
        write_ended(folder / ENDED_FILE, ended)
    require_rows(rows, ended, folder)
    modes, known = find_modes(rows), summarise(rows, features)
    known += empty_rows(known, ended)
    result = [row | {"ended": count_reasons(filter(_of_row(row), ended))} for row in known]
    if folder is not None:
        write_modes(folder / MODES_FILE, modes)
        write_rows(folder / TABLE, rows)
        write_metrics(folder / METRICS_FILE, result)
    return result


def _of_row(row: dict) -> Callable[[dict], bool]:
    """Whether an entry of ended.json is of the rollouts of a row of metrics.json."""
    names = [("dataset", "dataset"), ("split", "split"), ("method", "method"), ("ego", "ego_policy"), ("eta", "eta")]
    return lambda entry: all(row[name] == entry[other] for name, other in names)
