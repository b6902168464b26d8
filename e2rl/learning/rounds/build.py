"""Builds the parts of an evolution from a run's configuration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.build import build_search, build_sim, build_traffic
from e2rl.evaluation.check import as_list, processes_of
from e2rl.learning.logging import RunLogger
from e2rl.learning.rounds.attack import Synthesize, solvable
from e2rl.learning.rounds.before_after import BeforeAfter
from e2rl.learning.rounds.evolution import Evolution, RoundSettings
from e2rl.learning.rounds.improvement import Improvement
from e2rl.learning.rounds.memory import Memory
from e2rl.learning.rounds.prefetch import why_no_prefetch
from e2rl.learning.rounds.progress import Progress
from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.planners.ego import Ego
from e2rl.prior.prior import Prior
from e2rl.run.config import (
    built,
    load_choice,
    resolved,
    setting,
    settings_of,
)
from e2rl.run.errors import InputError
from e2rl.run.machine import check_device
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes, source_of
from e2rl.scenes.versions import RECORDED
from e2rl.search.tries import SEARCH
from e2rl.tail.settings import RateSettings
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import Traffic

TRY = 150.0  # NFE of a try of the search, about
# of an ego for which a planner evades, that take as long to collect as a rollout does
DECISIONS = 190.0


def build_attackers(config: DictConfig, prior: Prior) -> list[Traffic]:
    """Returns the traffic of the synthesizer, and of the harder one that joins in where
    `learner.round.harder` names one for it."""
    harder = config.learner.round.get("harder", {}).get(config.synthesizer.name)
    further = [load_choice("synthesizer", harder)] if harder else []
    return [build_traffic(group, prior) for group in (config.synthesizer, *further)]


def build_evolution(
    config: DictConfig,
    scenes: SceneSet,
    *,
    ego: Ego,
    attackers: Sequence[Traffic] = (),
    attacks: Sequence[Synthesize] = (),
    folder: Path | None = None,
) -> Evolution:
    """Returns an evolution by config.learner and config.curriculum over config.rounds
    rounds.

    Args:
        config: of train.py.
        scenes: to train on.
        ego: that is hardened.
        attackers: of `build_attackers`.
        attacks: make D'; none: closed-loop rollouts with the attackers do.
        folder: of the run, where D' is remembered; None: a temporary one.

    Returns:
        The run before its first round.

    Raises:
        InputError: parts of the configuration that do not fit each other.
    """
    sim = build_sim(config)
    curriculum = built(
        config.curriculum,
        "curriculum",
        kind=CurriculumScheduler,
        num_scenes=len(scenes),
        rounds=config.rounds,
        seed=config.seed,
    )
    settings = _round_settings(config, ego)
    learner = OmegaConf.create(
        {key: value for key, value in config.learner.items() if key != "round"}
    )
    improve = built(
        learner,
        "learner",
        kind=Improvement,
        ego=ego,
        scenes=scenes,
        sim=sim,
        seed=config.seed,
        device=learner.pop("device", config.device),
    )
    attacks = attacks or [
        synthesize_traffic(
            scenes,
            attacker,
            sim=sim,
            batch=config.batch,
            device=config.device,
        )
        for attacker in attackers
    ]
    enters = partial(solvable, scenes=scenes, sim=sim)
    return Evolution(
        curriculum,
        improve,
        attacks=attacks,
        settings=settings,
        memory=Memory(folder, settings.memory),
        seed=config.seed,
        solvable=enters if curriculum.solvable_only else None,
        batch=config.batch,
    )


def _round_settings(config: DictConfig, ego: Ego) -> RoundSettings:
    """`config.learner.round`, with a `prefetch` that is left open decided by what is
    possible."""
    options = {"prefetch": None} | resolved(config.learner.round)
    learns = config.learner.get("device", "cpu")
    device = str(learns if config.device == "cpu" else config.device)
    reason = why_no_prefetch(device, config.threads, ego=ego)
    if options["prefetch"] and reason:
        raise InputError(
            f"learner.round.prefetch=true: {reason}; set it to null or false"
        )
    if options["prefetch"] is None:
        options["prefetch"] = not reason
    return settings_of(RoundSettings, options, where="learner.round")


@dataclass(frozen=True)
class TrainSettings:
    """Counts of conf/train.yaml, checked."""

    rounds: int = setting(low=1)
    keep_last: int = setting(low=1)
    seed: int = setting(low=0)
    num_scenes: int | None = setting(low=1, optional=True)


@dataclass(frozen=True)
class MeasureSettings:
    """Settings `measure` of conf/train.yaml, checked."""

    path: str | None
    scenes: int = setting(low=1)
    seeds: tuple[int, ...] = setting(low=0)
    eta: tuple[float, ...] = setting(low=0)
    budget: float = setting(low=0)
    rollouts: int = setting(low=0)


def measure_settings(config: DictConfig) -> MeasureSettings:
    """Returns `config.measure`, checked."""
    lists = {name: as_list(config.measure[name]) for name in ("seeds", "eta")}
    return settings_of(MeasureSettings, {**config.measure, **lists}, where="measure")


def check_training(config: DictConfig) -> None:
    """InputError for what train.py cannot run, before anything is built."""
    settings_of(
        TrainSettings, {part.name: config[part.name] for part in fields(TrainSettings)}
    )
    measure_settings(config)
    processes_of(config)
    check_device("learner.device", config.learner.get("device", config.device))
    build_sim(config)


def rollouts_of(config: DictConfig) -> float:
    """Returns about how many rollouts a training takes as long as, where nothing is
    compiled: those of its rounds and of its measurements, and what an ego decides for
    which a planner evades."""
    if config.stage.name != "evolution":
        return 0.0
    learner = config.learner
    measure = measure_settings(config)
    attacks = min(learner.round.scenes, config.num_scenes or math.inf)
    episodes = 1 + (learner.round.nominal == "prior")
    rows = (1 + len(measure.eta)) * len(measure.seeds)
    scene = rows + measure.rollouts + measure.budget / TRY
    decisions = 0
    if config.ego.get("evades") and learner.get("device", "cpu") == "cpu":
        sizes = learner.get("collect", {})
        decisions = math.prod(
            sizes.get(name, 0) for name in ("iterations", "batch", "steps")
        )
    rounds = config.rounds * (episodes * attacks + decisions / DECISIONS)
    return rounds + 2 * measure.scenes * scene


def build_logger(config: DictConfig, folder: Path) -> RunLogger:
    """The logger of config.logger, writing under a run's folder."""
    return RunLogger(
        config.logger.kind,
        folder,
        project=config.logger.project,
        name=config.logger.name,
    )


def build_measure(
    config: DictConfig,
    ego: Ego,
    *,
    ego_name: str,
    traffic: Traffic,
    prior: Prior,
    folder: Path,
) -> BeforeAfter:
    """Returns the before/after table: nominal and adversarial traffic, and a search, on
    the scenes of `config.measure`.

    Sources with splits are measured on their tune split; a path's scenes on
    `measure.path`, both as recorded; or without it on the first training scenes (see
    `split` in the rows).

    Args:
        config: of train.py.
        ego: that is measured.
        ego_name: in the rows.
        traffic: that attacks it.
        prior: of the nominal traffic and the search.
        folder: of the run.

    Returns:
        What measures an ego.
    """
    options = measure_settings(config)
    data = config.data.copy()
    with open_dict(data):
        data.versions = [RECORDED]
        if options.path:
            data.path = options.path
            data.split = None
    separate = options.path or source_of(data).has_splits
    nominal = built(
        load_choice("synthesizer", "nominal"),
        "synthesizer",
        kind=Traffic,
        prior=prior,
    )
    attacks = [Method(config.synthesizer.name, traffic, eta=eta) for eta in options.eta]
    rates = None
    if options.rollouts:
        rates = RateSettings(
            method="plain",
            first=options.rollouts,
            particles=options.rollouts,
            rollouts=options.rollouts,
        )
    search = None
    if options.budget:
        search = build_search(SEARCH, config, prior, eta=max(options.eta))
    return BeforeAfter(
        Setup(
            load_scenes(
                data,
                options.scenes,
                split="tune",
                scenes=None if separate else config.scenes,
            ),
            ego,
            ego_name=ego_name,
            sim=build_sim(config),
            batch=config.batch,
            device=config.device,
        ),
        [Method("nominal", nominal), *attacks],
        seeds=options.seeds,
        folder=folder,
        processes=processes_of(config),
        search=search,
        budget=options.budget,
        rates=rates,
        prior_traffic=nominal,
    )


def build_progress(config: DictConfig, done: int = 0) -> Progress:
    """The phases of an evolution of which so many rounds are done."""
    before = [] if done else ["measurement"]
    return Progress([*before, *["round"] * (config.rounds - done), "measurement"])
