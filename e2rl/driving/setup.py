"""What is driven: scenes and an ego, a method of traffic, and one task a rollout."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

from e2rl.driving.scored import Scored
from e2rl.metrics.catalogue import SOURCE
from e2rl.metrics.evasion import add_avoidable
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollout_file import UNPRINTABLE
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from e2rl.traffic.attempt import attempt
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Traffic

SEED_STRIDE = 1_000_003  # between the noise seeds of two sampling seeds


class Task(NamedTuple):
    """A rollout to make.

    Args:
        scene: its position among the scenes.
        seed: in tables and files.
        noise: seed of the noise; None: `scene_seed`.
        decisions: of the traffic, `e2rl.traffic.decisions.Decisions`; None: its rule's.
    """

    scene: int
    seed: int
    noise: int | None = None
    decisions: tuple[float, ...] | None = None


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
    """What all methods of a table share.

    Args:
        scenes: to drive in.
        ego: that is driven.
        ego_name: in files.
        sim: settings of the simulator.
        batch: rollouts that are simulated at once.
        device: of the simulation.
        evasions: whether collisions are searched for evasions.

    Raises:
        InputError: where two scenes share an id, and so the files of their rollouts, or
            a name is not printable.
    """

    scenes: SceneSet
    ego: Ego
    ego_name: str
    sim: SimSettings
    batch: int = 64
    device: str = "cpu"
    evasions: bool = True

    def __post_init__(self) -> None:
        scenes = self.scenes
        for name, count in Counter(scenes.scene_id).items():
            if count > 1:
                raise InputError(
                    f"scene id {name!r}: stands for several scenes; give each an id of "
                    "its own in the data, or list the scenes to take with scenes=FILE"
                )
        check_names(scenes.dataset, scenes.split, self.ego_name)
        check_names(*scenes.scene_id, *scenes.location)

    def roll_out(self, method: Method, tasks: Sequence[Task]) -> Rollouts:
        """Returns the rollouts of tasks under one method."""
        noise = [
            scene_seed(self.scenes.number[task.scene], task.seed)
            if task.noise is None
            else task.noise
            for task in tasks
        ]
        decisions = [task.decisions for task in tasks if task.decisions is not None]
        eta = torch.full((len(tasks),), float(method.eta), dtype=torch.float64)
        rollouts = roll_out(
            self.scenes,
            torch.tensor([task.scene for task in tasks]),
            torch.tensor(noise),
            eta,
            ego=self.ego,
            traffic=method.traffic,
            sim=self.sim,
            device=self.device,
            decisions=torch.tensor(decisions) if decisions else None,
        )
        rollouts.seed = torch.tensor([task.seed for task in tasks])
        for name, text in self.source(method).items():
            rollouts.set(name, [text] * len(tasks))
        return rollouts

    def source(self, method: Method) -> dict[str, str]:
        """Returns the columns SOURCE of a method's rollouts."""
        texts = (
            self.scenes.dataset,
            self.scenes.split,
            method.name,
            self.ego_name,
        )
        return dict(zip(SOURCE, texts, strict=True))

    def score(
        self,
        method: Method,
        tasks: Sequence[Task],
        folder: Path | None = None,
        begins: bool = False,
    ) -> Scored:
        """Returns what tasks score under one method.

        Args:
            method: of the traffic.
            tasks: rollouts to make.
            folder: for the rollouts' files; None: nothing is written.
            begins: whether the ego begins the run with them.

        Raises:
            InputError: where the ego begins with them, and its first plan is none.
        """
        scored = Scored()
        parts, failed = attempt(partial(self.roll_out, method), tasks, begins=begins)
        for driven, rollouts in parts:
            rows, samples = score_rollouts(rollouts)
            if self.evasions:
                scene = self.scenes.batch([task.scene for task in driven])
                add_avoidable(rows, rollouts, scene=scene, sim=self.sim)
            if folder is not None:
                rollouts.to_npz(folder)
            scored.rows += rows
            scored.samples += samples
        source = self.source(method) | {"eta": float(method.eta)}
        for task, reason in failed:
            place = {
                "scene_id": self.scenes.scene_id[task.scene],
                "location": self.scenes.location[task.scene],
                "seed": task.seed,
            }
            scored.errored.append(source | place | reason)
        return scored


def scene_seed(number: int, seed: int) -> int:
    """Returns the noise seed of a rollout in a scene of this number, the same for every
    method (paired)."""
    return seed * SEED_STRIDE + number


def check_names(*names: str) -> None:
    """Raises InputError for a name that a terminal or a table could not show as it is."""
    for name in filter(UNPRINTABLE.search, names):
        raise InputError(
            f"the name {name!r}: holds control characters; rename it in the data or the "
            "configuration"
        )
