"""From a run's configuration to the parts of its evolution."""

from pathlib import Path

from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase

from e2rl.ego.actor import ActorEgo
from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.learning.curriculum import CurriculumScheduler
from e2rl.learning.evolution import Evolution, Measure, Synthesize
from e2rl.learning.imitation import imitate, recorded_pairs
from e2rl.learning.improvement import PlannerImprovement, PolicyImprovement
from e2rl.learning.logging import RunLogger
from e2rl.learning.solvability import solvability
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings


def build_evolution(
    config: DictConfig,
    scenes: SceneSet,
    sim: SimSettings,
    ego: Ego,
    synthesize: Synthesize,
    measure: Measure | None = None,
) -> Evolution:
    """An Evolution of `ego` by config.learner and config.curriculum over config.rounds rounds.

    learner.kind=policy needs ego=actor, which is improved in place; kind=planner tunes the class config.ego names.
    """
    curriculum = CurriculumScheduler(len(scenes), config.rounds, instantiate(config.curriculum), config.seed)
    if config.learner.kind == "policy":
        improve = _policy(config, scenes, sim, ego)
    elif config.learner.kind == "planner":
        improve = _planner(config, scenes, sim)
    else:
        raise InputError(f"learner.kind={config.learner.kind}: choose policy or planner")
    solvable = solvability(scenes, sim) if curriculum.settings.solvable_only else None
    return Evolution(curriculum, improve, synthesize, instantiate(config.learner.round), config.seed, measure, solvable)


def build_logger(config: DictConfig, folder: Path) -> RunLogger:
    """The logger of config.logger, writing under a run's folder."""
    return RunLogger(config.logger.kind, folder, config.logger.project, config.logger.name)


def run_imitation(
    config: DictConfig, scenes: SceneSet, sim: SimSettings, ego: Ego, folder: Path, logger: RunLogger | None = None
) -> dict[str, float]:
    """stage=imitation: clone the recorded egos of `scenes` into ego=actor, in place; writes folder/actor.safetensors
    and returns the losses of the epoch kept."""
    settings = instantiate(config.learner.imitation) if "imitation" in config.learner else None
    if settings is None or not isinstance(ego, ActorEgo):
        raise InputError("stage=imitation: it trains ego=actor with learner=ppo_bc; set both")
    pairs = recorded_pairs(scenes, sim, settings)
    return imitate(ego.network, pairs, settings, folder, None if logger is None else logger.log)


def _policy(config: DictConfig, scenes: SceneSet, sim: SimSettings, ego: Ego) -> PolicyImprovement:
    learner, expert = config.learner, None
    if learner.expert.recorded and learner.ppo.cloning > 0:
        expert = _pairs(recorded_pairs(scenes, sim, instantiate(learner.imitation)), config.device)
    teacher = instantiate(learner.expert.teacher) if learner.ppo.cloning > 0 else None
    return PolicyImprovement(
        ego,
        scenes,
        sim,
        instantiate(learner.ppo),
        instantiate(learner.collect),
        expert,
        teacher,
        config.seed,
        config.device,
    )


def _pairs(pairs: TensorDictBase, device: str) -> TensorDictBase:
    return pairs.select("observation", "action").to(device)


def _planner(config: DictConfig, scenes: SceneSet, sim: SimSettings) -> PlannerImprovement:
    present = OmegaConf.to_container(config.ego, resolve=True)
    make_ego = get_class(present.pop("_target_"))
    learner = config.learner
    return PlannerImprovement(
        make_ego,
        present,
        OmegaConf.to_container(learner.grid),
        scenes,
        sim,
        instantiate(learner.tuning),
        learner.batch,
        config.device,
    )
