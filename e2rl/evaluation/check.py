"""What an evaluation is asked for: keys of conf/evaluate.yaml, checked before anything
is built."""

from dataclasses import dataclass, fields
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from e2rl.driving.batches import WHOLE
from e2rl.metrics.catalogue import table_names
from e2rl.run.config import check_choice, choices, setting, settings_of
from e2rl.run.errors import InputError
from e2rl.run.processes import cores
from e2rl.search.spending import UNITS
from e2rl.search.tries import SEARCH

DEFAULT_BUDGET = 640.0  # NFE a scene: a rollout of CCDiff
ALL = "all"  # metrics


@dataclass(frozen=True)
class EvaluationSettings:
    """Keys of conf/evaluate.yaml.

    Args:
        shard: (k, n), only every n-th batch from the k-th on.
        budget: of a search a scene; None: one rollout for each seed.
        processes: that rollouts are spread over.
    """

    methods: tuple[str, ...]
    eta: tuple[float, ...] = setting(low=0.0, high=3.0)
    # seeds of tries are 10^10 times as large
    seeds: tuple[int, ...] = setting(low=0, high=900_000_000)
    num_scenes: int | None = setting(low=1, optional=True)
    shard: tuple[int, ...] = setting(low=0)
    metrics: str
    compare: tuple[str, ...]
    tries: int | None = setting(low=1, optional=True)
    budget: float | None = setting(low=0.01, optional=True)
    budget_unit: str = setting(choices=UNITS)
    save_rollouts: bool
    report: bool
    processes: int


def evaluation_settings(config: DictConfig) -> EvaluationSettings:
    """Returns what a configuration asks for; InputError for what cannot be run."""
    values = {field.name: config[field.name] for field in fields(EvaluationSettings)}
    for name in ("eta", "seeds", "compare"):
        values[name] = as_list(values[name])
    values |= budget_of(config)
    values["methods"] = row_names(config)
    values["shard"] = config.shard or WHOLE
    values["processes"] = processes_of(config)
    settings = settings_of(EvaluationSettings, values)
    check_choice("metrics", settings.metrics, choices=(*table_names(), ALL))
    for name, example in (("methods", "nominal,e2"), ("eta", "2"), ("seeds", "0")):
        if not getattr(settings, name):
            raise InputError(f"{name}=[]: name at least one, such as [{example}]")
    check_shard(settings)
    check_budget(settings)
    check_rows(config, settings)
    check_compared(config, settings)
    return settings


def as_list(value: Any) -> list:
    """Returns one or several values of a configuration as a list; null is none."""
    if isinstance(value, ListConfig):
        plain: Any = OmegaConf.to_container(value, resolve=True)
        return list(dict.fromkeys(plain))
    return [] if value is None else [value]


def row_names(config: DictConfig) -> list[str]:
    """Returns the names of `config.methods` and of those `config.variants` that it does
    not name. With tries=1 `search` is one try of the run's synthesizer."""
    names = as_list(config.methods)
    if config.tries == 1:
        single = config.synthesizer.name
        names = [single if name == SEARCH else name for name in names]
    return list(dict.fromkeys([*names, *config.variants]))


def is_search(config: DictConfig, name: str) -> bool:
    """Returns whether a row's tries are drawn from families: SEARCH and its variants."""
    changes = config.variants.get(name) or ()
    return name == SEARCH or any(str(key).startswith(SEARCH) for key in changes)


def budget_of(config: DictConfig) -> dict[str, Any]:
    """Returns the budget and its unit: of `tries` or `budget`, or else DEFAULT_BUDGET
    where there is a search."""
    budget = config.budget
    unit = config.budget_unit
    if budget is None and unit != "nfe":
        raise InputError(
            f"budget_unit={unit}: without a budget; name one, such as budget=16"
        )
    if config.tries is not None and budget is not None:
        raise InputError(f"tries={config.tries}, budget={budget}: name one of the two")
    if isinstance(budget, ListConfig):
        raise InputError(f"budget={budget}: name one; a sweep over several is -m")
    if config.tries is not None:
        return {
            "budget": None if config.tries == 1 else config.tries,
            "budget_unit": "tries",
        }
    if budget is None and any(is_search(config, name) for name in row_names(config)):
        budget = DEFAULT_BUDGET
    return {"budget": budget, "budget_unit": unit}


def check_shard(settings: EvaluationSettings) -> None:
    """Raises InputError for a shard that is none."""
    shard = list(settings.shard)
    if len(shard) != 2 or shard[0] >= shard[1]:
        raise InputError(
            f"shard={shard}: expected [k, n] with k from 0 to n - 1, such as "
            "shard=[0,4]"
        )


def check_budget(settings: EvaluationSettings) -> None:
    """Raises InputError for what tries on a budget cannot be."""
    if settings.budget and (settings.compare or settings.shard[1] > 1):
        raise InputError(
            "budget: tries are no pairs and no parts; leave out compare and shard, or "
            "set tries=1"
        )


def check_rows(config: DictConfig, settings: EvaluationSettings) -> None:
    """Raises InputError for rows that are not what they are said to be."""
    synthesizer = config.synthesizer.name
    if SEARCH in settings.methods and synthesizer not in ("e2", *settings.methods):
        raise InputError(
            f"synthesizer={synthesizer}: search does not begin with it; set tries=1, or "
            f"name {synthesizer} in methods"
        )
    if settings.budget and len(settings.eta) > 1:
        raise InputError(
            f"eta={list(settings.eta)}: a search has one intensity, of which its "
            "families take shares; name one, or set tries=1"
        )
    for name in config.variants:
        if not settings.budget and is_search(config, name):
            raise InputError(
                f"variants.{name}: changes the search, and tries=1 is without one; "
                "leave out either"
            )
        if name in (synthesizer, SEARCH, *choices("synthesizer")):
            raise InputError(
                f"variants.{name}: {name} is a row already; choose another name"
            )


def check_compared(config: DictConfig, settings: EvaluationSettings) -> None:
    """Raises InputError where a name of `compare` is no row: of `egos` where there are
    any, else a method."""
    names = settings.compare
    if not names:
        return
    where = f"compare=[{', '.join(names)}]"
    if not config.egos:
        for name in names:
            if name not in settings.methods:
                raise InputError(
                    f"{where}: no row of the name {name}; add it to methods"
                )
        if len(settings.eta) > 1:
            raise InputError(
                f"{where}: a table with a row a method has one eta; name one"
            )
    elif len(names) != 1 or names[0] not in config.egos:
        raise InputError(
            f"{where}: expected one of egos, {', '.join(map(str, config.egos))}"
        )


def processes_of(config: DictConfig) -> int:
    """Returns the processes that rollouts are spread over: one a core by default, one
    on a device that they would share."""
    processes = config.get("processes")  # train.py has none
    threads = config.threads
    device = str(config.device)
    alone = device == "cpu" and threads == 1
    if not alone and (processes or 1) > 1:
        raise InputError(
            f"processes={processes}, threads={threads}, device={device}: several "
            "processes have one thread each and the CPU; set threads=1 device=cpu, or "
            "processes=1"
        )
    return processes or (cores() if alone else 1)
