"""From a run's configuration to its objects: prior, synthesizer, ego, simulator settings."""

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior, SamplerSettings
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.anchoring import AnchorSettings
from e2rl.synthesizer.control import ControlSettings
from e2rl.synthesizer.feasibility import FeasibilitySettings
from e2rl.synthesizer.potentials import PotentialSettings
from e2rl.synthesizer.skeleton import SkeletonSettings
from e2rl.synthesizer.synthesizer import Synthesizer, SynthesizerSettings
from e2rl.synthesizer.topology import TopologySettings

PARTS = {"topology": TopologySettings, "feasibility": FeasibilitySettings, "skeleton": SkeletonSettings,
         "anchor": AnchorSettings, "potentials": PotentialSettings, "control": ControlSettings}


def build_prior(config: DictConfig, device: str = "cpu") -> tuple[Prior, dict]:
    """The frozen prior of `config.prior` and the origin in its checkpoint."""
    return load_prior(config.prior.checkpoint, SamplerSettings(**config.prior.sampler),
                      BoundSettings(**config.prior.bounds), device)


def build_synthesizer(config: DictConfig, prior: Prior) -> Synthesizer:
    """The synthesizer of the `synthesizer` group on a prior."""
    parts = {name: part(**config.synthesizer[name]) for name, part in PARTS.items() if name in config.synthesizer}
    scalars = {name: config.synthesizer[name] for name in ("reselect", "samples", "selection")
               if name in config.synthesizer}
    return Synthesizer(prior, SynthesizerSettings(**parts, **scalars))


def build_ego(config: DictConfig) -> Ego:
    """The ego that `ego._target_` names, an outside planner's class included."""
    try:
        ego = instantiate(config.ego)
    except InstantiationException as error:
        raise InputError(f"ego={config.ego.get('_target_')}: cannot be built: {error.__cause__ or error}; check the "
                         "class path and its arguments in conf/ego") from error
    if not isinstance(ego, Ego):
        raise InputError(f"ego={config.ego.get('_target_')}: is no e2rl.ego.base.Ego; subclass it and define plan()")
    return ego


def build_sim(config: DictConfig) -> SimSettings:
    """Simulator settings; ego=replay follows the recording exactly."""
    sim = instantiate(config.sim)
    if config.ego.get("_target_", "").endswith("ReplayEgo"):
        sim.replay_ego = True
    return sim


def set_up(config: DictConfig) -> None:
    """Threads and device of this process; InputError where the device is not there."""
    torch.set_num_threads(config.threads)
    if str(config.device).startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"device={config.device}: no CUDA device is available; use device=cpu")


def caption(config: DictConfig, origin: dict) -> str:
    """What stands in every table's caption: the settings that all methods share."""
    sampler, bounds = config.prior.sampler, config.prior.bounds
    on = [name for name in ("leader", "curve", "crossing") if bounds[name]]
    return (f"Prior {config.prior.checkpoint} ({origin.get('data', 'unknown data')}); {sampler.sampler}, K = "
            f"{sampler.steps}, temperature {sampler.temperature:g} (routes {sampler.route_temperature:g}), one sample "
            f"a replan, replanned every 0.5 s; acceleration bounds: {', '.join(on) or 'none'}")


def resolved(config: DictConfig) -> dict:
    """The configuration as plain containers, for the files of a run."""
    return OmegaConf.to_container(config, resolve=True)
