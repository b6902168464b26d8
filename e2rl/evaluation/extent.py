"""How long an evaluation takes, and how large its files are, by a few short rollouts."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from e2rl.driving.setup import Method, Setup, Task
from e2rl.evaluation.check import EvaluationSettings
from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.search.spending import SearchMethod

STEPS = 25  # of the rollouts that are timed
WARMING = 5  # of a rollout before these
SCENES = 4  # of a batch
OF_TIME = ("logged", "logged_valid", "light_state")  # keys of scenes: steps first


@dataclass(frozen=True)
class Extent:
    """What an evaluation takes.

    Args:
        rollouts: of all egos, rows, scenes and seeds.
        seconds: of a rollout, of one core.
        size: bytes of its file.
    """

    rollouts: float
    seconds: float
    size: float


def extent_of(
    setup: Setup,
    rows: Sequence[Method | SearchMethod],
    settings: EvaluationSettings,
    *,
    pairs: int,
) -> Extent:
    """Returns the extent of an evaluation, whose rollouts are taken to cost what those
    of its first attack do.

    Args:
        setup: an ego and a few scenes.
        rows: of the table.
        settings: of the budget.
        pairs: of ego, scene and seed; in each of them every row drives.

    Raises:
        InputError: a rollout ends with an error.
    """
    methods = [
        method
        for row in rows
        for method in (row.traffic.values() if isinstance(row, SearchMethod) else [row])
    ]
    attacks = [method for method in methods if method.traffic.adversarial]
    seconds, size = cost_of(setup, (attacks or methods)[0])
    return Extent(pairs * tries_of(rows, settings, seconds), seconds, size)


def tries_of(
    rows: Sequence[Method | SearchMethod],
    settings: EvaluationSettings,
    seconds: float,
) -> float:
    """Returns about how often the rows of a table drive an ego in a scene with a seed.

    Args:
        rows: of the table.
        settings: of the budget.
        seconds: that a rollout takes.
    """
    tries = 0.0
    for row in rows:
        if settings.budget is None or not isinstance(row, SearchMethod):
            tries += 1
        elif settings.budget_unit == "seconds":
            tries += settings.budget / seconds
        elif settings.budget_unit == "tries":
            tries += settings.budget
        else:
            spent = [family.nfe for family in row.families]
            tries += settings.budget * len(spent) / sum(spent)
    return tries


def cost_of(setup: Setup, method: Method) -> tuple[float, float]:
    """Returns the seconds and the bytes of a rollout in a full batch, by a batch of one
    scene and one of SCENES; raises as `extent_of`."""
    count = min(SCENES, len(setup.scenes))
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for scenes, steps in ((1, WARMING), (1, STEPS), (count, STEPS)):
            short = replace(setup, scenes=shortened(setup.scenes.first(count), steps))
            tasks = [Task(scene, seed=0) for scene in range(scenes)]
            begin = perf_counter()
            scored = short.score(method, tasks, Path(folder), begins=True)
            seconds.append(perf_counter() - begin)
            for row in scored.errored:
                raise InputError(f"{method.name}: {row['reason']}: {row['detail']}")
        size = sum(file.stat().st_size for file in Path(folder).iterdir()) / count
    longer = setup.scenes.steps / short.scenes.steps
    further = max(seconds[2] - seconds[1], 0.0) / max(count - 1, 1)
    alone = max(seconds[1] - further, 0.0)
    return longer * (further + alone / setup.batch), longer * size


def shortened(scenes: SceneSet, steps: int) -> SceneSet:
    """Returns the scenes with so many steps at most."""
    short = scenes.scenes.clone()
    for key in OF_TIME:
        short[key] = short[key][:, : steps + 1]
    return replace(scenes, scenes=short)
