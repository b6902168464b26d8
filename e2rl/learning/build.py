"""Builds the parts of an evolution from a run's configuration."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from e2rl.evaluation.methods import build_prior, build_sim, build_traffic, check_seeds, intensities, processes_of
from e2rl.evaluation.protocol import Method, Setup
from e2rl.learning.attack import Synthesize, mixture, solvable
from e2rl.learning.before_after import BeforeAfter
from e2rl.learning.bits_training import BitsSettings, train_bits
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.imitation import ImitationSettings, imitate, recorded_pairs
from e2rl.learning.improvement import Improvement
from e2rl.learning.logging import RunLogger
from e2rl.learning.memory import Memory
from e2rl.learning.prefetch import why_not_ahead
from e2rl.learning.scheduler import CurriculumScheduler
from e2rl.planners.actor import ActorEgo
from e2rl.planners.bits_network import BitsNetwork
from e2rl.planners.ego import Ego
from e2rl.prior.prior import Prior
from e2rl.run.config import built, check_counts, load_choice, resolved
from e2rl.run.endings import command_line
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from e2rl.run.processes import RayWorkers
from e2rl.run.run import git_commit
from e2rl.run.settings import settings_of
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes, source_of
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import Traffic


def build_evolution(
    config: DictConfig,
    scenes: SceneSet,
    ego: Ego,
    traffic: Traffic,
    synthesize: Synthesize | None = None,
    folder: Path | None = None,
) -> Evolution:
    """An Evolution of `ego` against `traffic` by config.learner and config.curriculum over config.rounds rounds.

    synthesize: makes D'; default: closed-loop rollouts with `traffic`. folder: of the run, where D' is remembered;
    default: a temporary one.
    """
    sim, seed = build_sim(config), config.seed
    made_by = partial(synthesize_traffic, scenes, sim=sim, batch=config.batch, device=config.device)
    synthesize = synthesize or made_by(traffic)
    given = {"num_scenes": len(scenes), "rounds": config.rounds, "seed": seed}
    curriculum = built(config.curriculum, "curriculum", CurriculumScheduler, **given)
    check_templates(curriculum, config.synthesizer.name, traffic)
    settings = settings_of(RoundSettings, _beside(config, ego), "learner.round")
    if settings.second:
        second = build_traffic(load_choice("synthesizer", settings.second), build_prior(config, config.device)[0])
        check_templates(curriculum, settings.second, second)
        synthesize = mixture(synthesize, made_by(second), settings.second_share)
    learner = OmegaConf.create({key: value for key, value in config.learner.items() if key != "round"})
    parameters = {key: value for key, value in resolved(config.ego).items() if key != "_target_"}
    live = traffic if settings.traffic == "live" else None
    given = {"ego": ego, "parameters": parameters, "scenes": scenes, "sim": sim, "traffic": live, "seed": seed}
    improve = built(learner, "learner", Improvement, device=config.device, **given)
    keep = partial(solvable, scenes=scenes, sim=sim) if curriculum.solvable_only else None
    workers = processes_of(config)
    how = (keep, Memory(folder, settings.memory), config.batch, workers if isinstance(workers, RayWorkers) else None)
    return Evolution(curriculum, improve, synthesize, settings, seed, *how)


def check_templates(curriculum: CurriculumScheduler, name: str, traffic: Traffic) -> None:
    """InputError for a curriculum that chooses causal templates for a traffic method that has none."""
    if curriculum.templates != ("full",) and not traffic.follows_template:
        raise InputError(
            f"curriculum: it chooses causal templates ({', '.join(curriculum.templates)}), but "
            f"synthesizer={name} has none; set synthesizer=e2 or curriculum.templates=[full]"
        )


def _beside(config: DictConfig, ego: Ego) -> dict:
    """`config.learner.round`, with an `ahead` that is left open decided by what is possible."""
    options = resolved(config.learner.round)
    reason = why_not_ahead(str(config.device), config.threads, ego, options.get("traffic"))
    if options.get("ahead") and reason:
        raise InputError(f"learner.round.ahead=true: {reason}; set it to null or false")
    return options | {"ahead": not reason} if options.get("ahead", False) is None else options


def check_training(config: DictConfig) -> None:
    """InputError for counts, seeds and intensities that train.py cannot run, before anything is built."""
    check_counts(config, rounds=1, keep_last=1, seed=0)
    if config.num_scenes is not None:
        check_counts(config, num_scenes=1)
    if type(config.measure.scenes) is not int or config.measure.scenes < 1:
        raise InputError(f"measure.scenes={config.measure.scenes}: expected a whole number of at least 1")
    processes_of(config)
    check_seeds("measure.seeds", config.measure.seeds)
    intensities(config.measure)
    build_sim(config)


def build_logger(config: DictConfig, folder: Path) -> RunLogger:
    """The logger of config.logger, writing under a run's folder."""
    return RunLogger(config.logger.kind, folder, config.logger.project, config.logger.name)


def build_measure(
    config: DictConfig, ego: Ego, ego_name: str, traffic: Traffic, prior: Prior, folder: Path
) -> BeforeAfter:
    """The before/after table: nominal and adversarial traffic on the scenes of `config.measure`.

    Sources with splits are measured on their tune split; a path's scenes on `measure.path`, or without it on the first
    training scenes (see `split` in the rows).
    """
    options, data = config.measure, config.data.copy()
    if options.path:
        with open_dict(data):
            data.path, data.split = options.path, None
    apart = options.path or source_of(data).has_splits
    scenes = load_scenes(data, options.scenes, split="tune", scenes=None if apart else config.scenes)
    nominal = built(load_choice("synthesizer", "nominal"), "synthesizer", Traffic, prior=prior)
    methods = [
        Method("nominal", nominal),
        *(Method(config.synthesizer.name, traffic, eta) for eta in intensities(options)),
    ]
    setup = Setup(scenes, ego, ego_name, build_sim(config), config.batch, config.device)
    return BeforeAfter(setup, methods, list(options.seeds), folder, processes_of(config))


def run_imitation(
    config: DictConfig,
    scenes: SceneSet,
    ego: Ego,
    folder: Path,
    logger: RunLogger | None = None,
    begin: Callable[[], None] | None = None,
) -> dict[str, float]:
    """stage=imitation: clone the recorded egos of `scenes` into ego=actor, in place; writes folder/actor.safetensors
    and returns the losses of the epoch kept. Goes on after the epochs that the run in the folder has done. begin: is
    called when the settings are known to be possible."""
    if "imitation" not in config.learner or not isinstance(ego, ActorEgo):
        raise InputError("stage=imitation trains ego=actor with learner=ppo_bc; set both")
    settings = settings_of(ImitationSettings, {**config.learner.imitation, "seed": config.seed}, "learner.imitation")
    if settings.held_out > 0 and len(scenes) < 2:
        reason = "of one scene none can be held out"
        raise InputError(f"learner.imitation.held_out={settings.held_out:g}: {reason}; pass more, or set it to 0")
    if begin is not None:
        begin()
    pairs = recorded_pairs(scenes, build_sim(config), settings)
    return imitate(ego.network, pairs, settings, folder, logger, Parts(folder, "imitation"))


def run_bits(config: DictConfig, scenes: SceneSet, folder: Path, logger: RunLogger | None = None) -> dict[str, float]:
    """stage=bits: train a new network of the ego bits on `scenes`; writes folder/bits.safetensors and returns the
    losses of the epoch kept."""
    settings = settings_of(BitsSettings, {**config.bits, "seed": config.seed}, "bits")
    origin = {"data": f"{scenes.dataset}/{scenes.split}", "scenes": len(scenes)}
    origin |= {"git": git_commit(), "command": command_line()}
    network = BitsNetwork(settings.hidden, settings.dropout).to(config.device)
    return train_bits(network, scenes, settings, folder, origin, None if logger is None else logger.log)
