"""Builds the objects of a run from its configuration: prior, traffic, the rows of a
table, and the egos that are rated.

All egos drive in the same traffic: the same scenes, noise, methods and intensities. The
noise of a rollout depends on its scene and seed alone, so egos are compared rollout by
rollout. Each is attacked by adversaries of its own. Trainings of one policy with
different seeds are separate egos in the files, and are also pooled under one name, as
`metrics.statistics` says.
"""

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.driving.setup import Method
from e2rl.evaluation.check import EvaluationSettings, as_list, is_search, row_names
from e2rl.planners.ego import Ego
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import built, load_choice, settings_of, with_changes
from e2rl.run.errors import InputError
from e2rl.search.search import Search, SearchSettings
from e2rl.search.spending import SearchMethod
from e2rl.search.tries import TRIES, Family, family_of
from e2rl.sim.settings import SimSettings
from e2rl.traffic.traffic import Traffic

NAME = re.compile(r"[A-Za-z0-9._+-]+")  # what a file name may hold
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


def build_rows(
    config: DictConfig, settings: EvaluationSettings
) -> tuple[Prior, dict, list[Method], list[SearchMethod]]:
    """Returns the prior with its origin, and the rows of the table: methods, or with a
    budget searches."""
    prior, origin = build_prior(config, config.device)
    if settings.budget:
        return prior, origin, [], build_searches(config, prior, settings.eta[0])
    return prior, origin, build_methods(config, prior), []


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
    name: str,
    config: DictConfig,
    prior: Prior,
    *,
    eta: float,
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
    configured = cache(partial(method_config, config))  # several families have one
    methods: dict[str, Method] = {}  # families of equal traffic share it
    traffic = {}
    for family in families:
        where = f"search.families.{family.name}"
        synthesizer = with_changes(
            configured(family.method),
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


# --- egos


@dataclass(frozen=True)
class EgoSet:
    """The egos of a run.

    Args:
        egos: by their name in files.
        names: of the tables' columns.
        pairs: names of which the first is compared with the second.
        trainings: of those names that stand for several egos, these.
    """

    egos: Mapping[str, Ego]
    names: Sequence[str]
    pairs: Sequence[tuple[str, str]] = ()
    trainings: Mapping[str, Sequence[str]] = field(default_factory=dict)


def build_egos(config: DictConfig, name: str) -> EgoSet:
    """Returns the egos of `config.egos`, or where it names none the one of the group
    `ego`, a file called `name`.

    An entry with `checkpoints` is an ego for each of them. Raises InputError for an
    ego, a field or a checkpoint that is not there, and for names that collide.
    """
    if not config.egos:
        return EgoSet({name: build_ego(config)}, [name])
    egos: dict[str, Ego] = {}
    trainings: dict[str, list[str]] = {}
    for entry in map(str, config.egos):
        members = trainings_of(config, entry)
        if len(members) > 1:
            trainings[entry] = list(members)
        taken = [
            own
            for own in members
            if own in egos or (own != entry and own in config.egos)
        ]
        if taken:
            raise InputError(
                f"egos.{entry}: {', '.join(taken)} is the name of another ego, too; "
                "choose another name"
            )
        egos |= {
            own: one_ego(config, entry, changes=changes)
            for own, changes in members.items()
        }
    counts = {len(members) for members in trainings.values()}
    if len(counts) > 1:
        raise InputError(
            f"egos: {' and '.join(trainings)} have different numbers of checkpoints; "
            "give as many of each"
        )
    return EgoSet(
        egos,
        list(map(str, config.egos)),
        pairs=compared(config),
        trainings=trainings,
    )


def trainings_of(config: DictConfig, name: str) -> dict[str, dict[str, Any]]:
    """Returns {name in files: {ego: FILE, changes of its fields}} of an entry, one for
    each of its `checkpoints`."""
    entry = config.egos[name]
    where = f"egos.{name}"
    if not NAME.fullmatch(name):
        raise InputError(
            f"{where}: the name goes into file names; use letters, digits and . _ + -"
        )
    if not isinstance(entry, DictConfig) or "ego" not in entry:
        raise InputError(
            f"{where}={entry!r}: expected a file of conf/ego and changes, such as "
            f"{{ego: idm, headway: 2}}"
        )
    several = entry.get("checkpoints") or []
    if not isinstance(several, list | ListConfig):
        raise InputError(
            f"{where}.checkpoints={several}: expected a list of training runs, [RUN, RUN]"
        )
    missing = [
        key
        for key in entry
        if OmegaConf.is_missing(entry, key) and not (key == "checkpoint" and several)
    ]
    if missing:
        key = f"{where}.{str(missing[0])}"
        raise InputError(
            f"{key}: needed; give the folder that train.py wrote, {key}=RUN"
        )
    changes = {
        str(key): entry[key]
        for key in entry
        if not OmegaConf.is_missing(entry, key) and key != "checkpoints"
    }
    if several and changes.get("checkpoint") is not None:
        raise InputError(
            f"{where}: has a checkpoint and checkpoints; give one of the two"
        )
    if len(several) < 2:
        return {name: changes | ({"checkpoint": several[0]} if several else {})}
    return {
        f"{name}_{number}": changes | {"checkpoint": each}
        for number, each in enumerate(several)
    }


def one_ego(config: DictConfig, name: str, changes: Mapping[str, Any]) -> Ego:
    """Returns the ego of an entry; its first weights depend on the run's seed alone,
    not on the other egos."""
    where = f"egos.{name}"
    try:
        changed = copy.deepcopy(config)
        OmegaConf.set_struct(changed, False)
        changed.ego = load_choice("ego", str(changes["ego"]))
        OmegaConf.set_struct(changed, True)
        for key, value in changes.items():
            if key != "ego":
                OmegaConf.update(changed, f"ego.{key}", value, merge=True)
        torch.manual_seed(config.get("seed", 0))
        return build_ego(changed)
    except OmegaConfBaseException as error:
        raise InputError(
            f"{where}: {str(error).splitlines()[0]}; compare it with conf/ego/{changes['ego']}"
        ) from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def compared(config: DictConfig) -> list[tuple[str, str]]:
    """Returns pairs of names whose difference is of interest: each ego with `compare`,
    or with the first."""
    names = [str(name) for name in config.egos]
    reference = (as_list(config.compare) or names)[0]
    return [(name, reference) for name in names if name != reference]
