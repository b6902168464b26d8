"""Builds the objects of a run from its configuration: prior, traffic, egos, and the
rows of a table."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from omegaconf import DictConfig, OmegaConf

from e2rl.driving.setup import Method
from e2rl.evaluation.check import as_list, is_search, row_names
from e2rl.planners.ego import Ego
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import built, load_choice, with_changes
from e2rl.run.errors import InputError
from e2rl.run.settings import settings_of
from e2rl.search.search import Search, SearchSettings
from e2rl.search.spending import SearchMethod
from e2rl.search.tries import TRIES, Family, family_of
from e2rl.sim.env import SimSettings
from e2rl.traffic.traffic import Traffic

VARIED = ("prior", "synthesizer", "search")  # groups that variants may change


def build_ego(config: DictConfig) -> Ego:
    """Returns the ego of the `ego` group, a class from outside of e2rl included."""
    return built(config.ego, "ego", kind=Ego)


def build_sim(config: DictConfig) -> SimSettings:
    """Returns the simulator's settings."""
    return settings_of(SimSettings, config.sim, where="sim")


def build_prior(config: DictConfig, device: str = "cpu") -> tuple[Prior, dict]:
    """Returns the frozen prior of `config.prior` and the origin in its checkpoint."""
    sampler = settings_of(SamplerSettings, config.prior.sampler, where="prior.sampler")
    bounds = settings_of(BoundSettings, config.prior.bounds, where="prior.bounds")
    return load_prior(config.prior.checkpoint, sampler, bounds=bounds, device=device)


def build_traffic(synthesizer: DictConfig, prior: Prior) -> Traffic:
    """Returns the traffic method of a `synthesizer` group on a prior."""
    return built(synthesizer, "synthesizer", kind=Traffic, prior=prior)


def build_methods(config: DictConfig, prior: Prior) -> list[Method]:
    """Returns the rows of `config.methods` and of those `config.variants` that it does
    not name; methods with an intensity have a row for each `config.eta`. Raises
    InputError for a method that is not there, and for changes that cannot be."""
    methods = []
    for row in rows_of(config, prior):
        traffic = build_traffic(row.synthesizer, row.prior)
        etas = as_list(config.eta) if traffic.adversarial else [0.0]
        methods += [Method(row.name, traffic, eta=float(eta)) for eta in etas]
    return methods


def build_searches(config: DictConfig, prior: Prior, eta: float) -> list[SearchMethod]:
    """Returns the rows of `config.methods` and `config.variants`, which are tried with
    a budget; a method other than SEARCH is a family of its own, in a fixed order.
    Raises InputError for a family, a method or a decision that is not there."""
    searches = []
    for row in rows_of(config, prior):
        if is_search(config, row.name):
            searches.append(build_search(row.name, row.config, row.prior, eta=eta))
            continue
        method = method_at(eta, row.name, build_traffic(row.synthesizer, row.prior))
        searches.append(
            SearchMethod(
                row.name,
                families=[Family(row.name, row.name, ranges={})],
                traffic={row.name: method},
                settings=replace(SearchSettings(), cover=TRIES, bandit=False),
            )
        )
    return searches


def build_search(
    name: str, config: DictConfig, prior: Prior, *, eta: float
) -> SearchMethod:
    """Returns the row of the group `search`, a portfolio of families.

    Args:
        name: of the row.
        config: with the groups `search` and `synthesizer`.
        prior: of all families.
        eta: intensity, of which the families take shares.

    Raises:
        InputError: for a family, a method or a decision that is not there.
    """
    settings: Any = OmegaConf.to_container(config.search, resolve=True)
    target = OmegaConf.create({"_target_": settings.pop("_target_")})
    families = [
        family_of(str(key), family, where="search.families")
        for key, family in (settings.pop("families") or {}).items()
        if family is not None
    ]
    if not families:
        raise InputError(
            "search.families: name at least one, such as +search.families.rule={}"
        )
    methods: dict[str, Method] = {}  # families of equal traffic share it
    traffic = {}
    for family in families:
        where = f"search.families.{family.name}"
        synthesizer = with_changes(
            method_config(config, family.method),
            family.changes,
            where=f"{where}.changes",
            group="synthesizer",
        )
        key = f"{family.method} {OmegaConf.to_yaml(synthesizer)}"
        if key not in methods:
            family_traffic = build_traffic(synthesizer, prior)
            methods[key] = method_at(eta, family.method, family_traffic)
        traffic[family.name] = methods[key]
        for decision in family.ranges:
            if not methods[key].traffic.follows_decisions:
                raise InputError(
                    f"{where}.{decision}: {family.method} does not decide this; leave "
                    "it out"
                )
    return SearchMethod(
        name,
        families=families,
        traffic=traffic,
        settings=settings_of(SearchSettings, settings, where="search"),
        search=partial(built, target, "search", Search),
    )


def method_at(eta: float, name: str, traffic: Traffic) -> Method:
    """Returns a method at an intensity, which is 0 for what knows none."""
    return Method(name, traffic, eta=eta if traffic.adversarial else 0.0)


@dataclass(frozen=True)
class Row:
    """The configuration of a row of the table, and its prior, which is the run's where
    the row does not change it."""

    name: str
    config: DictConfig
    prior: Prior

    @property
    def synthesizer(self) -> DictConfig:
        """The group `synthesizer` of a row other than SEARCH."""
        if self.name in self.config.variants:
            return self.config.synthesizer
        return method_config(self.config, self.name)


def rows_of(config: DictConfig, prior: Prior) -> Iterator[Row]:
    """Yields the rows of a table."""
    for name in row_names(config):
        changed = varied(config, name) if name in config.variants else config
        if changed.prior == config.prior:
            yield Row(name, changed, prior)
        else:
            yield Row(name, changed, build_prior(changed, config.device)[0])


def varied(config: DictConfig, name: str) -> DictConfig:
    """Returns the configuration with the changes of `config.variants.NAME`, of dotted
    or nested keys.

    `synthesizer: METHOD` makes it a variant of another method than the run's. Raises
    InputError for changes of others than VARIED.
    """
    changes = config.variants[name]
    if not isinstance(changes, DictConfig):
        raise InputError(
            f"variants.{name}={changes}: expected changes, such as "
            "{synthesizer.support: random}"
        )
    remaining = {str(key): value for key, value in changes.items()}
    changed = copy.deepcopy(config)
    if isinstance(remaining.get("synthesizer"), str):
        changed.synthesizer = method_config(config, remaining.pop("synthesizer"))
    for key, value in remaining.items():
        if key.split(".")[0] not in VARIED:
            raise InputError(
                f"variants.{name}: {key} is none of {', '.join(VARIED)}, nor in one of "
                "them"
            )
        changed = with_changes(
            changed,
            {key: value},
            where=f"variants.{name}: {key}={value}",
            group="",
        )
    return changed


def method_config(config: DictConfig, name: str) -> DictConfig:
    """Returns a method's configuration: the run's `synthesizer` group where it has this
    name, else the file of the group."""
    if name == config.synthesizer.name:
        return config.synthesizer
    return load_choice("synthesizer", name)
