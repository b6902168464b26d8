"""From the configuration of an evaluation to its objects."""

import copy
from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.evaluation.protocol import Method
from e2rl.metrics.catalogue import TABLES
from e2rl.planners.ego import Ego
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior, SamplerSettings
from e2rl.run.config import built, check_counts, choices, load_choice
from e2rl.run.errors import InputError
from e2rl.run.processes import Processes, RayWorkers, cores
from e2rl.run.settings import check_choice, settings_of
from e2rl.sim.env import SimSettings
from e2rl.traffic.traffic import Traffic

FIGURES = ("intensity", "skeleton", "curves")
LAUNCHERS = ("processes", "ray")
VARIED = ("prior", "synthesizer")  # groups that the variants of a table may change


# --- objects


def build_prior(config: DictConfig, device: str = "cpu") -> tuple[Prior, dict]:
    """The frozen prior of `config.prior` and the origin in its checkpoint."""
    sampler = settings_of(SamplerSettings, config.prior.sampler, "prior.sampler")
    bounds = settings_of(BoundSettings, config.prior.bounds, "prior.bounds")
    return load_prior(config.prior.checkpoint, sampler, bounds, device)


def build_traffic(synthesizer: DictConfig, prior: Prior) -> Traffic:
    """The traffic method of a `synthesizer` group on a prior."""
    return built(synthesizer, "synthesizer", Traffic, prior=prior)


def build_methods(config: DictConfig, prior: Prior) -> list[Method]:
    """The rows of `config.methods` and of those `config.variants` that it does not name; methods with an intensity have
    a row for each `config.eta`."""
    methods = []
    for name in dict.fromkeys([*config.methods, *config.variants]):
        if name in config.variants:
            changed = varied(config, name)
            own = prior if changed.prior == config.prior else build_prior(changed, config.device)[0]
            traffic = build_traffic(changed.synthesizer, own)
        else:
            traffic = build_traffic(method_config(config, name), prior)
        etas = intensities(config) if traffic.adversarial else [0.0]
        methods += [Method(name, traffic, eta) for eta in etas]
    return methods


def method_config(config: DictConfig, name: str) -> DictConfig:
    """A method's configuration: the run's `synthesizer` group where it has this name, else the file of the group."""
    return config.synthesizer if name == config.synthesizer.name else load_choice("synthesizer", name)


def build_ego(config: DictConfig) -> Ego:
    """The ego of the `ego` group, an outside planner's class included."""
    return built(config.ego, "ego", Ego)


def build_sim(config: DictConfig) -> SimSettings:
    """The simulator's settings."""
    return settings_of(SimSettings, config.sim, "sim")


# --- what evaluate.py is asked for


def intensities(config: DictConfig) -> list[float]:
    """`config.eta`, one or several; InputError for what is no intensity."""
    etas = list(config.eta) if isinstance(config.eta, ListConfig) else [config.eta]
    if not etas or not all(isinstance(eta, int | float) and 0 <= eta < float("inf") for eta in etas):
        raise InputError(
            f"eta={config.eta}: the intensity is a number of at least 0 (0 to 3 are sensible), or a list of them"
        )
    return [float(eta) for eta in dict.fromkeys(etas)]


def varied(config: DictConfig, name: str) -> DictConfig:
    """The configuration with the changes of `config.variants.NAME`, of dotted or nested keys; InputError for others
    than those of VARIED. `synthesizer: METHOD` makes it a variant of another method than the run's."""
    changed, changes = copy.deepcopy(config), config.variants[name]
    if not isinstance(changes, DictConfig):
        raise InputError(f"variants.{name}={changes}: expected changes, such as {{synthesizer.support: random}}")
    if isinstance(method := changes.get("synthesizer"), str):
        changed.synthesizer = method_config(config, method)
        changes = {key: value for key, value in changes.items() if key != "synthesizer"}
    for key, value in ((str(key), value) for key, value in changes.items()):
        if key.split(".")[0] not in VARIED:
            raise InputError(f"variants.{name}: {key} is none of {', '.join(VARIED)}, nor in one of them")
        try:
            OmegaConf.update(changed, key, value, merge=True)
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"variants.{name}: {key}={value}: {reason}; compare it with conf/") from error
    return changed


def check_seeds(where: str, seeds: Any) -> None:
    """InputError where sampling seeds are no list of whole numbers."""
    if not isinstance(seeds, ListConfig) or not seeds or not all(type(seed) is int and seed >= 0 for seed in seeds):
        raise InputError(f"{where}={seeds}: expected a list of whole numbers of at least 0, such as [0,1]")


def check_evaluation(config: DictConfig) -> None:
    """InputError for methods, seeds, an intensity, a figure or processes that evaluate.py cannot run."""
    processes_of(config)
    share_of(config)
    check_counts(config, open_loop_samples=0, meta_rollouts=0)
    check_choice("metrics", config.metrics, TABLES)
    check_seeds("seeds", config.seeds)
    if not isinstance(config.methods, ListConfig) or not (config.methods or config.variants):
        raise InputError(f"methods={config.methods}: expected a list of at least one, such as [nominal,e2]")
    if config.num_scenes is not None:
        check_counts(config, num_scenes=1)
    for name in config.methods:
        if name not in config.variants:
            method_config(config, name)
    for name in config.variants:
        if name in (config.synthesizer.name, *choices("synthesizer")):
            raise InputError(f"variants.{name}: {name} is a row already; choose another name")
        varied(config, name)
    check_compared(config)
    several = len(intensities(config)) > 1
    if config.figure is None:
        return
    check_choice("figure", config.figure, FIGURES)
    if config.figure != "curves" and not config.save_rollouts:
        raise InputError(f"figure={config.figure}: drawn from the rollouts' files; set save_rollouts=true")
    if config.figure == "curves" and config.egos:
        raise InputError("figure=curves: of one ego; choose it with ego=NAME, and leave egos out")
    if config.figure != "skeleton" and not several:
        raise InputError(f"figure={config.figure}, eta={config.eta}: name several intensities, such as eta=[0,1,2,3]")


def compare_names(config: DictConfig) -> list[str]:
    """The names of `config.compare`: none, one or several."""
    if config.compare is None:
        return []
    return [config.compare] if isinstance(config.compare, str) else list(map(str, config.compare))


def check_compared(config: DictConfig) -> None:
    """InputError where a name of `config.compare` is no row: of `egos` where there are any, else a method of one
    intensity."""
    if config.compare is None:
        return
    where, names = f"compare={config.compare}", compare_names(config)
    if config.egos:
        if config.policy_learning is not None:
            raise InputError(f"{where}: policy_learning has tables of its own; leave one of the two")
        if len(names) != 1 or names[0] not in config.egos:
            raise InputError(f"{where}: expected one of egos, {', '.join(map(str, config.egos))}")
        return
    if unknown := [name for name in names if name not in (*config.methods, *config.variants)]:
        raise InputError(f"{where}: no row of the name {unknown[0]}; add it to methods")
    if not names:
        raise InputError(f"{where}: name the methods that all are compared with, or null")
    if len(intensities(config)) > 1:
        raise InputError(f"{where}: a table with a row a method has one eta; name one")


def processes_of(config: DictConfig) -> Processes:
    """Processes that share the rollouts: one a core by default, one on a device that they would share, and one for the
    skeleton figure, which listens to the traffic method; with launcher=ray, Ray workers."""
    given, device = config.get("processes"), str(config.device)
    check_choice("launcher", config.launcher, LAUNCHERS)
    if given is not None:
        check_counts(config, processes=1)
    if config.get("figure") == "skeleton":
        return 1
    alone, several = device == "cpu" and config.threads == 1, config.launcher == "ray" or (given or 1) > 1
    if several and not alone:
        raise InputError(
            f"processes={given}, threads={config.threads}, device={device}, launcher={config.launcher}: several "
            "processes have one thread each and the CPU; set threads=1 device=cpu, or processes=1 launcher=processes"
        )
    if config.launcher == "ray":
        return RayWorkers(given, tuple(map(str, config.plugins)))
    return given or (cores() if alone else 1)


def share_of(config: DictConfig) -> tuple[int, int] | None:
    """`config.share`, (k, n); None: all. InputError for what is no share, and for what has none."""
    given = config.share
    if given is None:
        return None
    plain = list(given) if isinstance(given, ListConfig) else []
    if len(plain) != 2 or any(type(part) is not int for part in plain) or not 0 <= plain[0] < plain[1]:
        raise InputError(f"share={given}: expected [k, n] with k from 0 to n - 1, such as share=[0,4]")
    if config.tuning is not None or config.figure == "skeleton":
        raise InputError(f"share={given}: tuning and figure=skeleton run as a whole; leave share out")
    return plain[0], plain[1]


def caption(config: DictConfig, origin: dict, methods: Sequence[Method] = ()) -> str:
    """What stands in every table's caption: the settings that all methods share, and what each knows of the ego and
    owes it."""
    sampler, bounds = config.prior.sampler, config.prior.bounds
    on = [name for name in ("meeting", "curve") if bounds[name]]
    changes = "".join(f"; {name}: {what}".replace("'", "") for name, what in config.get("variants", {}).items())
    return (
        f"Prior {config.prior.checkpoint} ({origin.get('data', 'unknown data')}); {sampler.sampler}, K = "
        f"{sampler.steps}, temperature {sampler.temperature:g} (routes {sampler.route_temperature:g}), one sample "
        f"a replan, replanned every 0.5 s; acceleration bounds: {', '.join(on) or 'none'}{changes}{terms(methods)}"
    )


def terms_by_method(methods: Sequence[Method]) -> dict[str, tuple[str, str]]:
    """What each method knows of the ego and owes it, for the table of methods."""
    return {method.name: (method.traffic.knowledge, method.traffic.responsibility) for method in methods}


def terms(methods: Sequence[Method]) -> str:
    """What methods know of the ego and owe it, for a caption; "" for those that have no such settings."""
    by_terms: dict[str, list[str]] = {}
    for method in methods:
        known, owed = method.traffic.knowledge, method.traffic.responsibility
        text = f"the ego {'predicted' if known == 'predicted' else 'announces its plan'}" if known else ""
        text += f", responsibility {owed}" if owed else ""
        if text and method.name not in by_terms.setdefault(text, []):
            by_terms[text].append(method.name)
    return "".join(f"; {', '.join(names)}: {text}" for text, names in by_terms.items())
