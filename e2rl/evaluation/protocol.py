"""The closed-loop protocol: methods x scenes x seeds with one ego, and the files of design.md section 6."""

from dataclasses import dataclass
from pathlib import Path

import torch
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
from e2rl.evaluation.processes import spread
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Baseline


@dataclass
class Method:
    """A row of the table: its name, who makes the traffic and at which intensity."""

    name: str
    synthesizer: Synthesizer | Baseline
    eta: float


SEEDS_APART = 1_000_003


def scene_seed(scene: int, seed: int) -> int:
    """The noise seed of a rollout: the same for every method (paired)."""
    return seed * SEEDS_APART + scene


def run_protocol(
    scenes: SceneSet,
    methods: list[Method],
    ego: Ego,
    ego_name: str,
    seeds: list[int],
    sim: SimSettings,
    folder: Path | None = None,
    batch: int = 64,
    device: str = "cpu",
    save_rollouts: bool = True,
    processes: int = 1,
    only: list[int] | None = None,
    **fields,
) -> list[dict]:
    """Roll out every method on every (scene, seed), score, and return the rows of metrics.json.

    folder: where rollouts/ (if save_rollouts), rollouts.csv and metrics.json are written (None: nowhere); batch: at
    once, in each of so many processes: the rows do not depend on their number. only: positions of the scenes to run,
    with the noise that they have among all (None: all). fields join each row.
    """
    tasks = [(scene, seed) for seed in seeds for scene in (range(len(scenes)) if only is None else only)]
    count = -(-len(tasks) // batch)
    parts = [tasks[k * len(tasks) // count : (k + 1) * len(tasks) // count] for k in range(count)]
    jobs = [(method, part) for method in methods for part in parts]
    into = Path(folder) / ROLLOUTS if folder is not None and save_rollouts else None

    def work(job: tuple[Method, list[tuple[int, int]]]) -> tuple[list[dict], list[dict]]:
        return score_part(scenes, *job, ego, ego_name, sim, into, device)

    rows, features = [], []
    with tqdm(total=len(tasks) * len(methods), desc="rollouts", unit="rollout") as bar:
        results = spread(work, jobs, processes, cost=lambda job: job[0].eta)
        for (method, part), (found, samples) in zip(jobs, results, strict=True):
            rows += found
            features += samples
            bar.set_postfix(method=method.name, eta=method.eta)
            bar.update(len(part))
    result = metric_rows(rows, features, **fields)
    if folder is not None:
        write_rows(Path(folder) / TABLE, rows)
        write_metrics(Path(folder) / METRICS_FILE, result)
    return result


def score_part(
    scenes: SceneSet,
    method: Method,
    part: list[tuple[int, int]],
    ego: Ego,
    ego_name: str,
    sim: SimSettings,
    folder: Path | None,
    device: str,
) -> tuple[list[dict], list[dict]]:
    """Rows and realism samples (arrays) of (scene, seed) pairs under one method; folder: for their files, or None."""
    rollouts = roll_out_part(scenes, part, method, ego, sim, device)
    source = Source(scenes.dataset, scenes.split, method.name, ego_name)
    scored, samples = score_rollouts(rollouts)
    add_avoidable(scored, rollouts, scenes.batch([scene for scene, _ in part]), sim)
    if folder is not None:
        write_rollouts(folder, rollouts, source)
    return label_rows(scored, source), samples


def roll_out_part(
    scenes: SceneSet, part: list[tuple[int, int]], method: Method, ego: Ego, sim: SimSettings, device: str = "cpu"
) -> dict:
    """The rollout dict of (scene, seed) pairs under one method."""
    index = torch.tensor([scene for scene, _ in part])
    noise = torch.tensor([scene_seed(*task) for task in part])
    eta = torch.full((len(part),), float(method.eta))
    rollouts = roll_out(scenes, index, noise, eta, ego, method.synthesizer, sim, device=device)
    return rollouts | {"seed": torch.tensor([seed for _, seed in part]), "eta": float(method.eta)}
