"""What an evaluation does, built from its configuration: every ego under every method
in every scene and seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from e2rl.evaluation.budget import TRIES_FILE, Plan, build_plans, failures_of
from e2rl.evaluation.ego_set import EgoSet, build_egos
from e2rl.evaluation.methods import (
    EvaluationSettings,
    build_methods,
    build_prior,
    build_sim,
    evaluation_settings,
)
from e2rl.evaluation.protocol import Method, Part, Setup, Task
from e2rl.evaluation.reproduce import files_of_run
from e2rl.prior.prior import Prior
from e2rl.run.config import set_up
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.traffic.fusing import prepare_fused

CLASS = "class"  # the file of conf/ego for a class by its name alone


@dataclass(frozen=True)
class Evaluation:
    """The objects of an evaluation.

    Args:
        asked: the checked settings.
        origin: of the prior, from its checkpoint.
        methods, searches: what is driven without and with a budget.
        setup: scenes, simulator and the first of `egos`.
        only: positions of the scenes to drive (None: all).
    """

    asked: EvaluationSettings
    egos: EgoSet
    prior: Prior
    origin: Mapping[str, Any]
    methods: list[Method]
    searches: list[Plan]
    setup: Setup
    only: list[int] | None

    def rollouts(self, folder: Path) -> Path | None:
        """Returns where a run's rollouts are written; None: nowhere."""
        return folder / ROLLOUTS if self.asked.save_rollouts else None

    @property
    def scenes(self) -> SceneSet:
        """The scenes, of which `only` may be a part."""
        return self.setup.scenes

    def part_of(self, row: Mapping[str, Any], run: Path) -> Part:
        """Returns the rollout of a row in the table of a run of this plan, to be driven
        again, in a batch of its own. Raises InputError where the run's folder does not
        say what was tried."""
        setup = next(
            each
            for each in self.egos.setups(self.setup)
            if each.ego_name == row["ego_policy"]
        )
        name = row["method"]
        task = Task(self.scenes.index(row["scene_id"]), row["seed"])
        methods = [
            each for each in self.methods if (each.name, each.eta) == (name, row["eta"])
        ]
        parts: list[Part] = [(setup, method, [task]) for method in methods]
        for search in (each for each in self.searches if each.name == name):
            parts += failures_of(
                run / TRIES_FILE, setup.ego_name, plan=search, setup=setup
            )
        for _, method, tasks in parts:
            if found := [each for each in tasks if each[:2] == task[:2]]:
                return setup, method, found
        raise InputError(
            f"{run}: does not say how {row['scene_id']} was driven; give the whole folder of the run"
        )


def begin(run: Run) -> Evaluation:
    """Returns the plan of a run, which begins or goes on with it. Raises InputError for
    a configuration that cannot be run, and for inputs that changed since the run began.
    """
    config = run.config
    set_up(config)
    asked = evaluation_settings(config)
    egos = build_egos(config, ego_name(config.ego, run.choices["ego"]))
    print(purpose(run, asked, egos=list(egos.egos)), flush=True)
    prepare_fused(config)
    prior, origin = build_prior(
        config, config.device
    )  # before the scenes, which take longer than a wrong path
    methods = [] if asked.budget else build_methods(config, prior)
    searches = build_plans(config, prior) if asked.budget else []
    scenes = load_scenes(
        config.data, asked.num_scenes, scenes=config.scenes, files=files_of_run(config)
    )
    only = None if config.scene is None else [scenes.index(config.scene)]
    name, ego = next(iter(egos.egos.items()))
    setup = Setup(
        scenes,
        ego,
        ego_name=name,
        sim=build_sim(config),
        batch=config.batch,
        device=config.device,
    )
    run.begin({"scenes": listed(scenes)})
    return Evaluation(
        asked,
        egos,
        prior=prior,
        origin=origin,
        methods=methods,
        searches=searches,
        setup=setup,
        only=only,
    )


def ego_name(ego: Mapping[str, Any], choice: str) -> str:
    """Returns the name of an ego in tables and files: its file in conf/ego, or its
    class where it has none."""
    return str(ego["_target_"]).rpartition(".")[2] if choice == CLASS else choice


def purpose(run: Run, asked: EvaluationSettings, egos: Sequence[str]) -> str:
    """Returns what a run does, in a line."""
    config = run.config
    if config.failure is not None:
        return f"Drives the failure {config.failure} again, into {run.folder}."
    scenes = f"{run.choices['data']} scenes"
    if config.scene is not None:
        scenes = f"scene {config.scene}"
    elif asked.num_scenes == 1:
        scenes = f"the first of {scenes}"
    elif asked.num_scenes is not None:
        scenes = f"the first {asked.num_scenes} {scenes}"
    often = f"{', '.join(f'{value:g}' for value in asked.budget)} {asked.budget_unit} a scene and seed"
    often = often if asked.budget else "once a scene and seed"
    return (
        f"Drives {', '.join(egos)} in {scenes} against {', '.join(asked.methods)}, "
        f"seeds {', '.join(map(str, asked.seeds))}, {often}, into {run.folder}."
    )
