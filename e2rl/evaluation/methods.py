"""From the configuration of an evaluation to its objects."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from e2rl.evaluation.protocol import WHOLE, Method
from e2rl.metrics.catalogue import table_names
from e2rl.planners.ego import Ego
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import (
    built,
    check_list,
    choices,
    load_choice,
    machine_of,
    with_changes,
)
from e2rl.run.errors import InputError
from e2rl.run.processes import Processes, RayWorkers, cores
from e2rl.run.settings import check_choice, check_settings, setting, settings_of
from e2rl.sim.env import SimSettings
from e2rl.traffic.traffic import Traffic

FIGURES = ("intensity",)
UNITS = ("nfe", "tries", "seconds")  # of a budget, a scene
SEARCH = "search"  # the method whose tries are drawn from families
FEW = 640.0  # NFE a scene: a rollout of CCDiff
VARIED = (
    "prior",
    "synthesizer",
    "search",
)  # groups that the variants of a table may change
ALL = "all"  # metrics
LISTS = ("methods", "eta", "seeds", "compare", "budget", "shard")


# --- objects


def build_prior(config: DictConfig, device: str = "cpu") -> tuple[Prior, dict]:
    """The frozen prior of `config.prior` and the origin in its checkpoint."""
    sampler = settings_of(SamplerSettings, config.prior.sampler, where="prior.sampler")
    bounds = settings_of(BoundSettings, config.prior.bounds, where="prior.bounds")
    return load_prior(config.prior.checkpoint, sampler, bounds=bounds, device=device)


def build_traffic(synthesizer: DictConfig, prior: Prior) -> Traffic:
    """The traffic method of a `synthesizer` group on a prior."""
    return built(synthesizer, "synthesizer", kind=Traffic, prior=prior)


def rows_of(config: DictConfig) -> list[str]:
    """The names of `config.methods` and of those `config.variants` that it does not
    name. With tries=1 `search` is one try of the run's synthesizer."""
    plain = {SEARCH: config.synthesizer.name} if config.tries == 1 else {}
    return list(
        dict.fromkeys(
            [
                *(plain.get(name, name) for name in as_list(config.methods)),
                *config.variants,
            ]
        )
    )


def build_methods(config: DictConfig, prior: Prior) -> list[Method]:
    """The rows of `config.methods` and of those `config.variants` that it does not
    name; methods with an intensity have a row for each `config.eta`. Raises InputError
    for a method that is not there, and for changes of a variant that cannot be."""
    methods = []
    for name in rows_of(config):
        changed, own = config_and_prior(config, name, prior=prior)
        traffic = build_traffic(
            changed.synthesizer
            if name in config.variants
            else method_config(config, name),
            own,
        )
        etas = as_list(config.eta) if traffic.adversarial else [0.0]
        methods += [Method(name, traffic, eta=float(eta)) for eta in etas]
    return methods


def config_and_prior(
    config: DictConfig, name: str, prior: Prior
) -> tuple[DictConfig, Prior]:
    """The configuration of a row, and its prior, which is the run's where the row does
    not change it."""
    changed = varied(config, name) if name in config.variants else config
    return changed, prior if changed.prior == config.prior else build_prior(
        changed, config.device
    )[0]


def method_config(config: DictConfig, name: str) -> DictConfig:
    """A method's configuration: the run's `synthesizer` group where it has this name,
    else the file of the group."""
    return (
        config.synthesizer
        if name == config.synthesizer.name
        else load_choice("synthesizer", name)
    )


def build_ego(config: DictConfig) -> Ego:
    """The ego of the `ego` group, a class from outside of e2rl included."""
    return built(config.ego, "ego", kind=Ego)


def build_sim(config: DictConfig) -> SimSettings:
    """The simulator's settings."""
    return settings_of(SimSettings, config.sim, where="sim")


# --- what evaluate.py is asked for


@dataclass(frozen=True)
class EvaluationSettings:
    """Keys of conf/evaluate.yaml, checked. shard: (k, n), only every n-th batch from
    the k-th on."""

    methods: tuple[str, ...]
    eta: tuple[float, ...] = setting(low=0.0, high=3.0)
    seeds: tuple[int, ...] = setting(
        low=0, high=900_000_000
    )  # seeds of tries are 10^10 times as large
    num_scenes: int | None = setting(low=1, optional=True)
    shard: tuple[int, ...] = setting(low=0)
    metrics: str
    compare: tuple[str, ...]
    figure: str | None = setting(choices=FIGURES, optional=True)
    tries: int | None = setting(low=1, optional=True)
    budget: tuple[float, ...] = setting(low=0.01)
    budget_unit: str = setting(choices=UNITS)
    save_rollouts: bool
    report: bool

    def __post_init__(self) -> None:
        check_settings(self, "")
        check_choice("metrics", self.metrics, choices=(*table_names(), ALL))
        for name in ("eta", "seeds"):
            if not getattr(self, name):
                raise InputError(f"{name}=[]: name at least one")
        if len(self.shard) != 2 or self.shard[0] >= self.shard[1]:
            raise InputError(
                f"shard={list(self.shard)}: expected [k, n] with k from 0 to n - 1, such as shard=[0,4]"
            )
        if self.budget and (self.figure or self.compare or self.shard[1] > 1):
            raise InputError(
                "budget: has a table and a picture of its own; leave out figure, compare and shard, or set tries=1"
            )
        if self.figure and len(self.eta) < 2:
            raise InputError(
                f"figure={self.figure}: name several intensities, such as eta=[0,1,2,3]"
            )
        if self.figure == "intensity" and not self.save_rollouts:
            raise InputError(
                "figure=intensity: drawn from the rollouts' files; set save_rollouts=true"
            )


def evaluation_settings(config: DictConfig) -> EvaluationSettings:
    """Returns what a configuration asks for; InputError for what cannot be run."""
    given = {field.name: config[field.name] for field in fields(EvaluationSettings)}
    for name in LISTS:
        check_list(name, given[name])
    given |= {
        name: as_list(given[name]) for name in ("eta", "seeds", "compare", "budget")
    }
    given |= {"methods": rows_of(config)} | _budget(config)
    settings = settings_of(EvaluationSettings, given | {"shard": config.shard or WHOLE})
    if not settings.methods:
        raise InputError("methods=[]: name at least one, such as [nominal,e2]")
    own = config.synthesizer.name
    if SEARCH in settings.methods and own not in ("e2", *settings.methods):
        raise InputError(
            f"synthesizer={own}: search does not begin with it; set tries=1, or name {own} in methods"
        )
    for name in config.variants:
        if not settings.budget and is_search(config, name):
            raise InputError(
                f"variants.{name}: changes the search, and tries=1 is without one; leave out either"
            )
        if name in (config.synthesizer.name, SEARCH, *choices("synthesizer")):
            raise InputError(
                f"variants.{name}: {name} is a row already; choose another name"
            )
    _check_compared(config, settings)
    processes_of(config)
    return settings


def is_search(config: DictConfig, name: str) -> bool:
    """Whether a row's tries are drawn from families: SEARCH and its variants."""
    return name == SEARCH or any(
        str(key).startswith(SEARCH) for key in config.variants.get(name) or ()
    )


def _budget(config: DictConfig) -> dict[str, Any]:
    """The budgets and their unit: of `tries` or `budget`, or else FEW where there is a
    search."""
    if config.budget is None and config.budget_unit != "nfe":
        raise InputError(
            f"budget_unit={config.budget_unit}: without a budget; name one, such as budget=16"
        )
    if config.tries is not None:
        if config.budget is not None:
            raise InputError(
                f"tries={config.tries}, budget={config.budget}: name one of the two"
            )
        return {
            "budget": [] if config.tries == 1 else [config.tries],
            "budget_unit": "tries",
        }
    if config.budget is None and any(
        is_search(config, name) for name in rows_of(config)
    ):
        return {"budget": [FEW], "budget_unit": "nfe"}
    return {"budget": as_list(config.budget)}


def as_list(value: Any) -> list:
    """Returns one or several values of a configuration as a list; null is none."""
    if isinstance(value, ListConfig):
        plain = OmegaConf.to_container(value, resolve=True)
        assert isinstance(plain, list)
        return list(dict.fromkeys(plain))
    return [] if value is None else [value]


def varied(config: DictConfig, name: str) -> DictConfig:
    """Returns the configuration with the changes of `config.variants.NAME`, of dotted
    or nested keys.

    `synthesizer: METHOD` makes it a variant of another method than the run's. Raises
    InputError for changes of others than VARIED.
    """
    changed = copy.deepcopy(config)
    changes = config.variants[name]
    if not isinstance(changes, DictConfig):
        raise InputError(
            f"variants.{name}={changes}: expected changes, such as {{synthesizer.support: random}}"
        )
    if isinstance(method := changes.get("synthesizer"), str):
        changed.synthesizer = method_config(config, method)
        changes = {key: value for key, value in changes.items() if key != "synthesizer"}
    for key, value in ((str(key), value) for key, value in changes.items()):
        if key.split(".")[0] not in VARIED:
            raise InputError(
                f"variants.{name}: {key} is none of {', '.join(VARIED)}, nor in one of them"
            )
        changed = with_changes(
            changed, {key: value}, where=f"variants.{name}: {key}={value}", group=""
        )
    return changed


def _check_compared(config: DictConfig, settings: EvaluationSettings) -> None:
    """Raises InputError where a name of `compare` is no row: of `egos` where there are
    any, else a method."""
    names = settings.compare
    if not names:
        return
    where = f"compare=[{', '.join(names)}]"
    if config.egos and config.policy_learning is not None:
        raise InputError(
            f"{where}: policy_learning has tables of its own; leave one of the two"
        )
    if config.egos and (len(names) != 1 or names[0] not in config.egos):
        raise InputError(
            f"{where}: expected one of egos, {', '.join(map(str, config.egos))}"
        )
    if not config.egos and (
        unknown := [name for name in names if name not in settings.methods]
    ):
        raise InputError(f"{where}: no row of the name {unknown[0]}; add it to methods")
    if not config.egos and len(settings.eta) > 1:
        raise InputError(f"{where}: a table with a row a method has one eta; name one")


def processes_of(config: DictConfig) -> Processes:
    """Returns the processes that rollouts are spread over: one a core by default, one
    on a device that they would share; with launcher=ray, Ray workers."""
    machine = machine_of(config)
    device = str(config.device)
    alone = device == "cpu" and machine.threads == 1
    if not alone and (machine.launcher == "ray" or (machine.processes or 1) > 1):
        raise InputError(
            f"processes={machine.processes}, threads={machine.threads}, device={device}, launcher={machine.launcher}: "
            "several processes have one thread each and the CPU; set threads=1 device=cpu, or processes=1 "
            "launcher=processes"
        )
    if machine.launcher == "ray":
        return RayWorkers(machine.processes, tuple(map(str, config.plugins)))
    return machine.processes or (cores() if alone else 1)


def caption(config: DictConfig, origin: Mapping, methods: Sequence[Method] = ()) -> str:
    """What stands in every table's caption: the settings that all methods share, and
    what each knows of the ego and owes it."""
    sampler = config.prior.sampler
    bounds = config.prior.bounds
    on = [name for name in ("meeting", "curve") if bounds[name]]
    changes = "".join(
        f"; {name}: {what}".replace("'", "")
        for name, what in config.get("variants", {}).items()
    )
    return (
        f"Prior {config.prior.checkpoint} ({origin.get('data', 'unknown data')}); {sampler.sampler}, K = "
        f"{sampler.steps}, temperature {sampler.temperature:g} (routes {sampler.route_temperature:g}), one sample "
        f"a replan, replanned every 0.5 s; acceleration bounds: {', '.join(on) or 'none'}{changes}{terms(methods)}"
    )


def terms_by_method(methods: Sequence[Method]) -> dict[str, tuple[str, str]]:
    """What each method knows of the ego and owes it, for the table of methods."""
    return {
        method.name: (method.traffic.knowledge, method.traffic.responsibility)
        for method in methods
    }


def terms(methods: Sequence[Method]) -> str:
    """What methods know of the ego and owe it, for a caption; "" for those that have no
    such settings."""
    by_terms: dict[str, list[str]] = {}
    for name, (known, owed) in terms_by_method(methods).items():
        told = (
            [f"the ego {'predicted' if known == 'predicted' else 'announces its plan'}"]
            if known
            else []
        )
        told += [f"responsibility {owed}"] if owed else []
        by_terms.setdefault(", ".join(told), []).append(name)
    return "".join(
        f"; {', '.join(names)}: {text}" for text, names in by_terms.items() if text
    )
