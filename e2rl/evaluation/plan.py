"""What an evaluation does, built from its configuration: every ego under every method
in every scene and seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from e2rl.driving.batches import Batch, Work, drive_all, score_all
from e2rl.driving.setup import Method, Setup, Task
from e2rl.evaluation.build import (
    EgoSet,
    build_egos,
    build_rows,
    build_sim,
)
from e2rl.evaluation.check import EvaluationSettings, evaluation_settings
from e2rl.evaluation.extent import tries_of
from e2rl.evaluation.record import Record, record
from e2rl.evaluation.reproduce import files_of_run
from e2rl.prior.prior import Prior
from e2rl.run.errors import InputError
from e2rl.run.machine import set_up
from e2rl.run.parts import Parts
from e2rl.run.run import Run
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.search.spending import SearchMethod, Spent, search_all
from e2rl.search.tries import TRIES_FILE
from e2rl.search.tries_file import failures_of, write_tries
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.traffic.fusing import choice_of, prepare_fused

CLASS = "class"  # the file of conf/ego for a class by its name alone
SECONDS = 0.5  # that a rollout takes, about, where nothing is compiled
NOMINAL = "nominal"  # traffic without an attack, which every attack is compared with


@dataclass(frozen=True)
class Evaluation:
    """The objects of an evaluation.

    Args:
        run: with the configuration and the folder.
        origin: `git` and `command` of the run's rows.
        settings: keys of conf/evaluate.yaml.
        egos: that are rated.
        prior: of all methods.
        prior_origin: from the prior's checkpoint.
        methods: that are driven once a seed; none where there is a budget.
        searches: that are driven with a budget.
        scenes: of which `work.only` may be a part.
        setups: scenes and simulator with each of `egos`.
        work: how rollouts are driven.
    """

    run: Run
    origin: Mapping[str, str]
    settings: EvaluationSettings
    egos: EgoSet
    prior: Prior
    prior_origin: Mapping[str, Any]
    methods: list[Method]
    searches: list[SearchMethod]
    scenes: SceneSet
    setups: list[Setup]
    work: Work

    def drive(self) -> Spent:
        """Returns what all rollouts score; of searches also their tries."""
        settings = self.settings
        if settings.budget is None:
            return Spent(
                drive_all(
                    self.setups,
                    self.methods,
                    seeds=settings.seeds,
                    work=self.work,
                )
            )
        return search_all(
            self.setups,
            self.searches,
            budget=settings.budget,
            unit=settings.budget_unit,
            seeds=settings.seeds,
            work=self.work,
        )

    def driven(self, rows: Sequence[Mapping]) -> str:
        """Returns how many of its rollouts these are, such as `24 of 96`; of a search,
        by what it spent, about how many."""
        settings = self.settings
        scenes = len(self.work.scenes(self.setups[0]))
        pairs = len(self.setups) * len(settings.seeds) * scenes
        count = len(rows)
        if settings.budget is None:
            return f"{count} of {pairs * len(self.methods)}"
        spent = float(count)
        if settings.budget_unit != "tries":
            spent = sum(row[settings.budget_unit] for row in rows if not row["errored"])
        budget = settings.budget * pairs * len(self.searches)
        whole = round(count * max(budget / spent, 1.0)) if spent else "?"
        return f"{count} of about {whole}"

    def drive_again(self, row: Mapping[str, Any], run: Path) -> Spent:
        """Returns what the rollout of a row in the table of a run of this plan scores,
        driven again in a batch of its own. Raises InputError where the run's folder
        does not say what was tried."""
        job = ("failure", self.batch_of(row, run))
        (scored,) = score_all([job], self.work, cost=lambda job: 1.0)
        return Spent(scored)

    def batch_of(self, row: Mapping[str, Any], run: Path) -> Batch:
        """Returns the rollout of a row in the table of a run as a batch; raises as
        `drive_again`."""
        (setup,) = (
            setup for setup in self.setups if setup.ego_name == row["ego_policy"]
        )
        scene = self.scenes.index(row["scene_id"])
        seed = row["seed"]
        batches = [
            Batch(setup, method, [Task(scene, seed)])
            for method in self.methods
            if (method.name, method.eta) == (row["method"], row["eta"])
        ]
        for search in self.searches:
            if search.name == row["method"]:
                file = run / TRIES_FILE
                batches += failures_of(file, setup.ego_name, method=search, setup=setup)
        for batch in batches:
            tasks = [task for task in batch.tasks if task[:2] == (scene, seed)]
            if tasks:
                return batch._replace(tasks=tasks)
        raise InputError(
            f"{run}: does not say how {row['scene_id']} was driven; give the whole "
            "folder of the run"
        )

    def record(self, driven: Spent, folder: Path | None = None) -> Record:
        """Returns what the rollouts come to, and writes it into a folder, None: the
        run's."""
        folder = folder or self.run.folder
        compared = self.settings.compare
        if driven.tries:
            write_tries(folder / TRIES_FILE, driven.tries)
        return record(
            driven.scored,
            folder,
            config=self.run.config,
            searched=bool(driven.tries),
            egos=self.egos.pairs,
            trainings=self.egos.trainings,
            references=(
                (*compared, NOMINAL) if compared and not self.egos.pairs else None
            ),
            **self.origin,
        )


def begin(
    run: Run,
    often: str = "once a scene and seed",
    *,
    times: int = 1,
    against: str = "",
) -> Evaluation:
    """Returns the plan of a run, which begins or goes on with it. Raises InputError for
    a configuration that cannot be run, and for inputs that changed since the run began.

    Args:
        run: with the configuration and the folder.
        often: in words, how often a scene is driven that has no budget.
        times: the same at most, of each seed.
        against: in words, what is driven instead of the methods.
    """
    config = run.config
    set_up(config)
    settings = evaluation_settings(config)
    egos = build_egos(config, ego_name(config.ego, run.choices["ego"]))
    against = against or f"{', '.join(settings.methods)}, {effort(settings, often)}"
    print(purpose(run, settings, egos=list(egos.egos), against=against), flush=True)
    choice_of(config)  # a wrong one fails early
    # before the scenes, which take longer than a wrong path
    prior, prior_origin, methods, searches = build_rows(config, settings)
    sim = build_sim(config)
    scenes = load_scenes(
        config.data,
        settings.num_scenes,
        scenes=config.scenes,
        files=files_of_run(Path(config.reproduce)) if config.reproduce else "",
    )
    setups = [
        Setup(
            scenes,
            ego,
            ego_name=name,
            sim=sim,
            batch=config.batch,
            device=config.device,
        )
        for name, ego in egos.egos.items()
    ]
    _, shards = settings.shard
    pairs = len(scenes) * len(egos.egos) * len(settings.seeds) * times / shards
    tries = tries_of([*methods, *searches], settings, SECONDS)
    prepare_fused(config, pairs * tries)
    work = Work(
        into=run.folder / ROLLOUTS if settings.save_rollouts else None,
        processes=settings.processes,
        only=None if config.scene is None else [scenes.index(config.scene)],
        parts=Parts(run.folder),
        shard=settings.shard,
    )
    return Evaluation(
        run,
        run.begin({"scenes": listed(scenes)}),
        settings=settings,
        egos=egos,
        prior=prior,
        prior_origin=prior_origin,
        methods=methods,
        searches=searches,
        scenes=scenes,
        setups=setups,
        work=work,
    )


def ego_name(ego: Mapping[str, Any], choice: str) -> str:
    """Returns the name of an ego in tables and files: its file in conf/ego, or its
    class where it has none."""
    return str(ego["_target_"]).rpartition(".")[2] if choice == CLASS else choice


def purpose(
    run: Run, settings: EvaluationSettings, *, egos: Sequence[str], against: str
) -> str:
    """Returns what a run does, in a line.

    Args:
        run: with the configuration and the folder.
        settings: keys of conf/evaluate.yaml.
        egos: names of the planners.
        against: what, and how often.
    """
    config = run.config
    if config.failure is not None:
        return f"Drives the failure {config.failure} again, into {run.folder}."
    scenes = f"{run.choices['data']} scenes"
    if config.scene is not None:
        scenes = f"scene {config.scene}"
    elif settings.num_scenes == 1:
        scenes = f"the first of {scenes}"
    elif settings.num_scenes is not None:
        scenes = f"the first {settings.num_scenes} {scenes}"
    return f"Drives {', '.join(egos)} in {scenes} against {against}, into {run.folder}."


def effort(settings: EvaluationSettings, often: str) -> str:
    """Returns the seeds, and the budget or how often a scene is driven without one."""
    if settings.budget:
        often = f"{settings.budget:g} {settings.budget_unit} a scene and seed"
    return f"seeds {', '.join(map(str, settings.seeds))}, {often}"
