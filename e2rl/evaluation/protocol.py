"""The closed-loop protocol: methods x scenes x seeds with one ego, the files of a run (docs/method.md, section 11)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from e2rl.ego.base import Ego
from e2rl.evaluation.avoidable import add_avoidable
from e2rl.evaluation.files import (
    METRICS_FILE,
    ROLLOUTS,
    TABLE,
    Source,
    label_rows,
    write_metrics,
    write_rollouts,
    write_rows,
)
from e2rl.evaluation.modes import MODES_FILE, find_modes, write_modes
from e2rl.evaluation.processes import in_processes
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Traffic

SEEDS_APART = 1_000_003
Task = tuple[int, int]  # position of a scene, sampling seed
Scored = tuple[list[dict], list[dict[str, Tensor]]]  # labelled rows and realism samples, one of each per rollout


@dataclass
class Method:
    """A row of the table: name, traffic and intensity."""

    name: str
    traffic: Traffic
    eta: float = 0.0


@dataclass
class Setup:
    """Shared by all methods of a table: scenes, ego and its name in files, simulator, batch of rollouts."""

    scenes: SceneSet
    ego: Ego
    ego_name: str
    sim: SimSettings
    batch: int = 64
    device: str = "cpu"

    def roll_out(self, method: Method, tasks: Sequence[Task]) -> dict:
        """The rollout dict of (scene, seed) pairs under one method."""
        index = torch.tensor([scene for scene, _ in tasks])
        noise = torch.tensor([scene_seed(*task) for task in tasks])
        eta = torch.full((len(tasks),), float(method.eta))
        rollouts = roll_out(self.scenes, index, noise, eta, self.ego, method.traffic, self.sim, self.device)
        return rollouts | {"seed": torch.tensor([seed for _, seed in tasks]), "eta": float(method.eta)}

    def score(self, method: Method, tasks: Sequence[Task], folder: Path | None = None) -> Scored:
        """Rows and realism samples of (scene, seed) pairs under one method; folder: for the rollouts' files."""
        rollouts = self.roll_out(method, tasks)
        source = Source(self.scenes.dataset, self.scenes.split, method.name, self.ego_name)
        rows, samples = score_rollouts(rollouts)
        scene = self.scenes.batch([scene for scene, _ in tasks])
        rollouts["evasion"] = add_avoidable(rows, rollouts, scene, self.sim)
        if folder is not None:
            write_rollouts(folder, rollouts, source)
        return label_rows(rows, source), samples


def scene_seed(scene: int, seed: int) -> int:
    """The noise seed of a rollout, the same for every method (paired)."""
    return seed * SEEDS_APART + scene


def run_protocol(
    setup: Setup,
    methods: Sequence[Method],
    seeds: Sequence[int],
    folder: Path | None = None,
    save_rollouts: bool = True,
    processes: int = 1,
    only: Sequence[int] | None = None,
    **fields: Any,
) -> list[dict]:
    """Roll out every method on every (scene, seed), score, and return the rows of metrics.json.

    folder: where rollouts/ (if save_rollouts), rollouts.csv, modes.json and metrics.json are written (None: nowhere);
    processes: over which the rollouts are spread, with the same rows; only: positions of the scenes to run, with
    unchanged noise (None: all). fields are added to each row.
    """
    into = folder / ROLLOUTS if folder is not None and save_rollouts else None
    found = drive_all([setup], methods, seeds, into, processes, only)
    return record(*found, folder, partial(metric_rows, **fields))


def drive_all(
    setups: Sequence[Setup],
    methods: Sequence[Method],
    seeds: Sequence[int],
    into: Path | None = None,
    processes: int = 1,
    only: Sequence[int] | None = None,
) -> Scored:
    """Roll out and score every setup, which differ in their ego, under every method on every (scene, seed).

    into: folder of the rollouts' files (None: none); others: as for `run_protocol`. The noise is the same for all.
    """
    first = setups[0]
    tasks = [(scene, seed) for seed in seeds for scene in (range(len(first.scenes)) if only is None else only)]
    count = -(-len(tasks) // first.batch)
    parts = [tasks[k * len(tasks) // count : (k + 1) * len(tasks) // count] for k in range(count)]
    jobs = [(setup, method, part) for setup in setups for method in methods for part in parts]

    def work(job: tuple[Setup, Method, list[Task]]) -> Scored:
        setup, method, part = job
        return setup.score(method, part, into)

    rows, features = [], []
    with tqdm(total=len(tasks) * len(methods) * len(setups), desc="rollouts", unit="rollout") as bar:

        def ended(job: tuple[Setup, Method, list[Task]]) -> None:
            setup, method, part = job
            bar.set_postfix(ego=setup.ego_name, method=method.name, eta=method.eta, refresh=False)
            bar.update(len(part))

        for found, samples in in_processes(work, jobs, processes, lambda job: job[1].eta, ended):
            rows += found
            features += samples
    return rows, features


def record(
    rows: list[dict], features: list[dict[str, Tensor]], folder: Path | None, summarise: Callable[..., list[dict]]
) -> list[dict]:
    """The rows of metrics.json, summarise(rows, features); writes rollouts.csv, modes.json and metrics.json."""
    modes = find_modes(rows)
    result = summarise(rows, features)
    if folder is not None:
        write_modes(folder / MODES_FILE, modes)
        write_rows(folder / TABLE, rows)
        write_metrics(folder / METRICS_FILE, result)
    return result
