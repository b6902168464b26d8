"""`python tools/curricula.py FOLDER [--trainings N] [--processes P] [KEY=VALUE ...]`:
what a curriculum is worth beside its controls, at equal numbers of attacks and updates.

Trains every arm N times by `train.py`, with the same seeds for all arms, and measures
all trainings by one `evaluate.py` on `measure.path`. Keys are of `train.py`: the data,
the prior, and the length of a training. Prints a table: hits in % with 95% intervals
over places and trainings, and the ratio to `uniform`, paired by both. What is done is
not done again: run it anew to go on.
"""

import argparse
import csv
import math
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import torch
from tabulate import tabulate
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from e2rl.learning.rounds.schedules import AdaptiveCurriculum  # noqa: E402
from e2rl.metrics.statistics import bootstrap_draws, cluster_index  # noqa: E402

START = "start"  # the actor before training
CONTROL = "uniform"
ROUNDS = 4
SCENES = 24  # attacks of a round
ITERATIONS = 12  # updates of a round
ALONE = "learner.round.hits=0"  # no harder attack joins in
ARMS = {
    CONTROL: [],  # what train.py does
    "learnability": ["curriculum._target_=tools.curricula.LearnabilityCurriculum"],
    "regret": ["curriculum._target_=tools.curricula.RegretCurriculum"],
    "e2_alone": [ALONE],
    "random_vehicles": [ALONE, "synthesizer.support=random"],
    "made_once": [
        "rounds=1",
        f"learner.round.scenes={ROUNDS * SCENES}",
        f"learner.collect.iterations={ROUNDS * ITERATIONS}",
    ],
    "linear": ["curriculum=linear"],
    "cat": ["synthesizer=cat"],
    "nominal": ["curriculum.fraction=0"],
}
LENGTH = [
    f"rounds={ROUNDS}",
    f"learner.round.scenes={SCENES}",
    f"learner.collect.iterations={ITERATIONS}",
    "learner.round.prefetch=false",  # every attack is on the present policy
]
UNMEASURED = ["measure.budget=0", "measure.rollouts=0", "measure.scenes=1"]
ATTACK = "e2_unbound"
WORST = 0.1  # of the scenes
PERCENTILES = torch.tensor([0.025, 0.975], dtype=torch.float64)


class LearnabilityCurriculum(AdaptiveCurriculum):
    """Draws scenes by their rank r in learnability p (1 - p), p the recent failure
    rate, with weights r^-0.5; those never driven in adversarial traffic come first."""

    def worth(self) -> Tensor:
        """What scenes [S] are ranked by."""
        return self.failing * (1 - self.failing)

    def priority(self) -> Tensor:
        """Probability [S] with which scenes are drawn."""
        order = self.worth().nan_to_num(nan=torch.inf).argsort(descending=True)
        weight = (order.argsort() + 1.0) ** -0.5
        return weight / weight.sum()


class RegretCurriculum(LearnabilityCurriculum):
    """By the regret to an oracle that survives all of D', as some driver does: by the
    recent failure rate itself."""

    def worth(self) -> Tensor:
        """What scenes [S] are ranked by."""
        return self.failing


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trainings", type=int, default=10)
    parser.add_argument("--processes", type=int, default=1)
    options, keys = parser.parse_known_args(arguments)
    folder = options.folder.resolve()
    runs = list(product(range(options.trainings), ARMS))
    with ThreadPoolExecutor(options.processes) as pool:
        list(pool.map(lambda run: train(folder, *run, keys=keys), runs))
    measure(folder, options.trainings, processes=options.processes, keys=keys)
    with (folder / "measured/rollouts.csv").open() as file:
        rows = list(csv.DictReader(file))
    print(tabulate(table(rows, options.trainings), "keys", "pipe"))


def train(folder: Path, seed: int, arm: str, *, keys: Sequence[str]) -> None:
    """Train an arm, unless it is trained."""
    run = folder / f"{arm}_{seed}"
    if (run / "tables.md").exists():  # which a training writes last
        return
    settings = [*LENGTH, *keys, *ARMS[arm], f"seed={seed}", *UNMEASURED]
    drive("train.py", run, settings)


def measure(
    folder: Path, trainings: int, *, processes: int, keys: Sequence[str]
) -> None:
    """Drive all trainings of all arms, unless they are driven."""
    run = folder / "measured"
    if (run / "rollouts.csv").exists():
        return
    settings = [
        *(key.replace("measure.", "data.") for key in keys if "measure.path" in key),
        *(key for key in keys if key.startswith(("data=", "prior."))),
        f"+egos.{START}={{ego: actor}}",
        f"methods=[{ATTACK}]",
        f"processes={processes}",
        *("tries=1", "seeds=[0]", "report=false", "save_rollouts=false"),
    ]
    for arm in ARMS:
        runs = ",".join(str(folder / f"{arm}_{seed}") for seed in range(trainings))
        settings.append(f"+egos.{arm}={{ego: actor, checkpoints: [{runs}]}}")
    drive("evaluate.py", run, settings)


def drive(script: str, run: Path, settings: Sequence[str]) -> None:
    """Run a command into a folder, made anew, with its output beside it."""
    if run.exists():
        shutil.rmtree(run)
    run.parent.mkdir(parents=True, exist_ok=True)
    with run.with_suffix(".log").open("w") as log:
        subprocess.run(
            [sys.executable, ROOT / script, *settings, f"hydra.run.dir={run}"],
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            check=True,
        )


def table(rows: Sequence[dict[str, str]], trainings: int) -> list[dict[str, str]]:
    """Returns a row for each arm: hits in % of all scenes and of the worst tenth, and
    their ratios to CONTROL."""
    names = sorted({row["scene_id"] for row in rows})
    number = {name: index for index, name in enumerate(names)}
    places = {row["scene_id"]: row["location"] for row in rows}
    cluster, count = cluster_index([places[name] for name in names], names)
    arms = [START, *ARMS]
    hits = torch.zeros(len(arms), trainings, len(names)).double()
    for row in rows:
        arm, _, seed = row["ego_policy"].rpartition("_")
        training = int(seed) if arm else slice(None)  # the start has no trainings
        ego = arms.index(arm or row["ego_policy"])
        hits[ego, training, number[row["scene_id"]]] = float(row["cfr"])
    drawn_places = bootstrap_draws(count)[:, cluster]  # [D, S]
    drawn_trainings = bootstrap_draws(trainings, seed=1)  # [D, T]
    chosen = {"hit": torch.ones_like(hits[0]), "worst tenth": worst(hits[1:])}
    result = [{"arm": name} for name in arms]
    for name, mask in chosen.items():
        weight = torch.einsum("dt,ds,ts->d", drawn_trainings, drawn_places, mask)
        total = torch.einsum(
            "dt,ds,ats->da", drawn_trainings, drawn_places, hits * mask
        )
        mean = total / weight[:, None]
        control = mean[:, arms.index(CONTROL)]
        for index, row in enumerate(result):
            row[name] = interval(100 * mean[:, index], 1)
            row[f"{name} / {CONTROL}"] = interval(mean[:, index] / control, 2)
    return result


def worst(hits: Tensor) -> Tensor:
    """Returns 1 where [T, S] a scene is in the worst tenth by hits [A, T, S] in the
    trainings of the other parity, of all arms alike, so that choosing is not measuring;
    else 0."""
    chosen = torch.zeros_like(hits[0])
    for parity in (0, 1):
        other = hits[:, 1 - parity :: 2].mean((0, 1))
        scenes = other.topk(math.ceil(WORST * len(other))).indices
        chosen[parity::2, scenes] = 1.0
    return chosen


def interval(draws: Tensor, digits: int) -> str:
    """The first of draws [D], and the interval of all."""
    low, high = draws.nanquantile(PERCENTILES).tolist()
    return f"{draws[0]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


if __name__ == "__main__":
    main(sys.argv[1:])
