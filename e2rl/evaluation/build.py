"""From a run's configuration to its objects: prior, synthesizers and methods, ego, simulator settings."""

import copy
from collections.abc import Callable

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.evaluation.processes import cores
from e2rl.evaluation.protocol import Method
from e2rl.metrics.catalogue import TABLES
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior, SamplerSettings
from e2rl.settings import settings_of
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.anchoring import AnchorSettings
from e2rl.synthesizer.control import ControlSettings
from e2rl.synthesizer.feasibility import FeasibilitySettings
from e2rl.synthesizer.interception import InterceptionSettings
from e2rl.synthesizer.potentials import PotentialSettings
from e2rl.synthesizer.reasoner import ReasonerSettings
from e2rl.synthesizer.skeleton import SkeletonSettings
from e2rl.synthesizer.synthesizer import Synthesizer, SynthesizerSettings
from e2rl.synthesizer.topology import TopologySettings
from e2rl.traffic.constant_velocity import ConstantVelocity
from e2rl.traffic.idm import IDM
from e2rl.traffic.replay import Replay
from e2rl.traffic.traffic import Baseline

PARTS = {
    "topology": TopologySettings,
    "feasibility": FeasibilitySettings,
    "reasoner": ReasonerSettings,
    "skeleton": SkeletonSettings,
    "anchor": AnchorSettings,
    "interception": InterceptionSettings,
    "potentials": PotentialSettings,
    "control": ControlSettings,
}
BASELINES: dict[str, Callable[[Prior], Baseline]] = {  # under the bounds of the prior that they stand beside
    "replay": lambda prior: Replay(),
    "constant_velocity": lambda prior: ConstantVelocity(),
    "idm": lambda prior: IDM(prior.bounds),
}

FIGURES = ("intensity", "skeleton")
VARIED = ("prior", "synthesizer")  # groups that the variants of a table may change


def build_prior(config: DictConfig, device: str = "cpu") -> tuple[Prior, dict]:
    """The frozen prior of `config.prior` and the origin in its checkpoint."""
    return load_prior(
        config.prior.checkpoint,
        settings_of(SamplerSettings, config.prior.sampler, "prior.sampler"),
        settings_of(BoundSettings, config.prior.bounds, "prior.bounds"),
        device,
    )


def build_synthesizer(config: DictConfig, prior: Prior) -> Synthesizer | Baseline:
    """The synthesizer of the `synthesizer` group on a prior."""
    if config.synthesizer.name in BASELINES:
        return BASELINES[config.synthesizer.name](prior)
    parts = {
        name: settings_of(part, config.synthesizer[name], f"synthesizer.{name}")
        for name, part in PARTS.items()
        if name in config.synthesizer
    }
    scalars = {
        name: config.synthesizer[name]
        for name in ("support", "reselect", "samples", "selection")
        if name in config.synthesizer
    }
    return Synthesizer(prior, SynthesizerSettings(**parts, **scalars))


def build_methods(config: DictConfig, prior: Prior) -> list[Method]:
    """The rows of `config.methods` and of those `config.variants` that it does not name, each at every `config.eta`."""
    synthesizer = build_synthesizer(config, prior)
    nominal = synthesizer if isinstance(synthesizer, Synthesizer) else Synthesizer(prior)
    methods = []
    for name in dict.fromkeys([*config.methods, *config.variants]):
        if name in config.variants:
            changed = varied(config, name)
            own = prior if changed.prior == config.prior else build_prior(changed, config.device)[0]
            methods += at_intensities(name, build_synthesizer(changed, own), config)
        elif name in BASELINES:
            methods.append(Method(name, BASELINES[name](prior), 0.0))
        elif name == "nominal":
            methods.append(Method(name, nominal, 0.0))
        else:
            methods += at_intensities(name, synthesizer, config)
    return methods


def at_intensities(name: str, synthesizer: Synthesizer | Baseline, config: DictConfig) -> list[Method]:
    """A row of the table at every intensity that is asked for; a baseline knows none but 0."""
    etas = [0.0] if isinstance(synthesizer, Baseline) else intensities(config)
    return [Method(name, synthesizer, eta) for eta in etas]


def intensities(config: DictConfig) -> list[float]:
    """`config.eta`, one or several; InputError for what is no intensity."""
    etas = list(config.eta) if isinstance(config.eta, ListConfig) else [config.eta]
    if not etas or not all(isinstance(eta, int | float) and 0 <= eta < float("inf") for eta in etas):
        raise InputError(
            f"eta={config.eta}: the intensity is a number of at least 0 (0 to 3 are sensible), or a list "
            "of such numbers"
        )
    return [float(eta) for eta in dict.fromkeys(etas)]


def varied(config: DictConfig, name: str) -> DictConfig:
    """The configuration with the changes of `config.variants.NAME`, of dotted or nested keys; InputError for others
    than those of VARIED."""
    changed, changes = copy.deepcopy(config), config.variants[name]
    if not isinstance(changes, DictConfig):
        raise InputError(f"variants.{name}={changes}: expected changes, such as {{synthesizer.support: random}}")
    for key, value in changes.items():
        if key.split(".")[0] not in VARIED:
            raise InputError(f"variants.{name}: {key} is none of {', '.join(VARIED)}, nor in one of them")
        try:
            OmegaConf.update(changed, key, value, merge=True)
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"variants.{name}: {key}={value}: {reason}; compare it with conf/") from error
    return changed


def build_ego(config: DictConfig) -> Ego:
    """The ego that `ego._target_` names, an outside planner's class included."""
    try:
        ego = instantiate(config.ego)
    except InstantiationException as error:
        raise InputError(
            f"ego={config.ego.get('_target_')}: cannot be built: {error.__cause__ or error}; check the "
            "class path and its arguments in conf/ego"
        ) from error
    if not isinstance(ego, Ego):
        raise InputError(f"ego={config.ego.get('_target_')}: is no e2rl.ego.base.Ego; subclass it and define plan()")
    return ego


def build_sim(config: DictConfig) -> SimSettings:
    """Simulator settings; ego=replay follows the recording exactly."""
    try:
        sim = instantiate(config.sim)
    except InstantiationException as error:
        raise InputError(f"sim: cannot be built: {error.__cause__ or error}; compare it with conf/sim") from error
    if config.ego.get("_target_", "").endswith("ReplayEgo"):
        sim.replay_ego = True
    return sim


def set_up(config: DictConfig) -> None:
    """Threads, device and torch's seed; InputError where the device is not there or a size is impossible."""
    for key in ("threads", "batch"):
        if config[key] < 1:
            raise InputError(f"{key}={config[key]}: expected at least 1")
    torch.set_num_threads(config.threads)
    if str(config.device).startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"device={config.device}: no CUDA device is available; use device=cpu")
    try:
        torch.empty(1, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device={config.device}: {str(error).splitlines()[0]}; use device=cpu or cuda") from error
    torch.manual_seed(config.get("seed", 0))  # first weights and exploration; evaluation's noise has seeds of its own


def check_protocol(config: DictConfig) -> None:
    """InputError for methods, seeds, an intensity or processes that evaluate.py cannot run."""
    processes_of(config)
    known = list(dict.fromkeys(["nominal", *BASELINES, config.synthesizer.name]))
    for name in config.methods:
        if name not in (*known, *config.variants):
            raise InputError(
                f"methods={list(config.methods)}: {name} is none of "
                f"{', '.join([*known, *config.variants])}; choose another with synthesizer="
            )
    if not (config.methods or config.variants) or not config.seeds:
        raise InputError(f"methods={list(config.methods)}, seeds={list(config.seeds)}: name at least one of each")
    for name in config.variants:
        if name in known:
            raise InputError(f"variants.{name}: {name} is a row already; choose another name")
        varied(config, name)
    check_figure(config)
    for key in ("open_loop_samples", "meta_rollouts"):
        if not isinstance(config[key], int) or config[key] < 0:
            raise InputError(f"{key}={config[key]}: expected a whole number of at least 0")
    if config.metrics not in TABLES:
        raise InputError(f"metrics={config.metrics}: choose one of {', '.join(TABLES)}")
    if not all(isinstance(seed, int) for seed in config.seeds):
        raise InputError(f"seeds={list(config.seeds)}: sampling seeds are whole numbers")
    if config.num_scenes is not None and not (isinstance(config.num_scenes, int) and config.num_scenes > 0):
        raise InputError(f"num_scenes={config.num_scenes}: a whole number of at least 1, or null for all")


def check_figure(config: DictConfig) -> None:
    """InputError for intensities that are none, or for a figure that could not be drawn of the run."""
    several = len(intensities(config)) > 1
    if config.figure is None:
        return
    if config.figure not in FIGURES:
        raise InputError(f"figure={config.figure}: choose one of {', '.join(FIGURES)}, or null")
    if not config.save_rollouts:
        raise InputError(f"figure={config.figure}: drawn from the rollouts' files; set save_rollouts=true")
    if config.figure == "intensity" and not several:
        raise InputError(f"figure=intensity, eta={config.eta}: name several intensities, such as eta=[0,1,2,3]")


def processes_of(config: DictConfig) -> int:
    """Processes that rollouts are spread over: one a core by default, one on a device that they would share, and one
    for the skeleton figure, which listens to the synthesizer."""
    given, device = config.processes, str(config.device)
    if config.figure == "skeleton":
        return 1
    if given is None:
        return cores() if device == "cpu" and config.threads == 1 else 1
    if not isinstance(given, int) or given < 1:
        raise InputError(f"processes={given}: expected a whole number of at least 1, or null for one a core")
    if given > 1 and (device != "cpu" or config.threads > 1):
        raise InputError(
            f"processes={given}, threads={config.threads}, device={device}: several processes have one "
            "thread each and the CPU; set threads=1 device=cpu, or processes=1"
        )
    return given


def caption(config: DictConfig, origin: dict) -> str:
    """What stands in every table's caption: the settings that all methods share."""
    sampler, bounds = config.prior.sampler, config.prior.bounds
    on = [name for name in ("meeting", "curve") if bounds[name]]
    changes = "".join(f"; {name}: {what}".replace("'", "") for name, what in config.get("variants", {}).items())
    return (
        f"Prior {config.prior.checkpoint} ({origin.get('data', 'unknown data')}); {sampler.sampler}, K = "
        f"{sampler.steps}, temperature {sampler.temperature:g} (routes {sampler.route_temperature:g}), one sample "
        f"a replan, replanned every 0.5 s; acceleration bounds: {', '.join(on) or 'none'}{changes}"
    )


def resolved(config: DictConfig) -> dict:
    """The configuration as plain containers, for the files of a run."""
    return OmegaConf.to_container(config, resolve=True)
