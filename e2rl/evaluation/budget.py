"""Searches for failures with a budget, round by round, and what each of their tries was
(docs/search.md).

Every method is tried again and again, with other noise; the method `search` spends its
tries on a portfolio of families. What they find is told at several budgets by
`report.budget`.
"""

import csv
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from e2rl.evaluation.methods import (
    as_list,
    build_traffic,
    config_and_prior,
    is_search,
    method_config,
    rows_of,
)
from e2rl.evaluation.protocol import (
    HERE,
    Method,
    Part,
    Scored,
    Setup,
    Task,
    Work,
    extend,
    first_names,
    in_batches,
    score_all,
)
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.margin import FARTHEST
from e2rl.prior.prior import Prior
from e2rl.run.config import built, with_changes
from e2rl.run.errors import InputError
from e2rl.run.files import CsvReader, csv_text, write_atomically
from e2rl.run.settings import settings_of
from e2rl.run.terminal import Bar
from e2rl.search.search import Outcome, Search, SearchSettings
from e2rl.search.tries import TRIES, Family, Try, family_of

TRIES_FILE = "tries.csv"
TOLD = (
    "scene_id",
    "location",
    "seed",
    "method",
    "ego_policy",
    "family",
    "margin",
    "cell",
    "clean",
    "raised",
)
SPENT = ("tries", "nfe", "seconds")  # a scene that is still tried, of the search so far
CLOSE = 1e-9  # of a budget: rounding


@dataclass(frozen=True)
class Plan:
    """A row of the budget's table: a name, families with their traffic, and how tries
    are spent, by a `search`."""

    name: str
    families: list[Family]
    traffic: dict[str, Method]
    settings: SearchSettings
    search: Callable[..., Search] = Search

    def begin(self, setup: Setup, seed: int, only: Sequence[int]) -> Search:
        """The search in scenes `only`, before its first try."""
        numbers = [setup.scenes.number[scene] for scene in only]
        return self.search(
            families=self.families, numbers=numbers, seed=seed, settings=self.settings
        )


def build_plans(config: DictConfig, prior: Prior) -> list[Plan]:
    """The rows of `config.methods` and `config.variants`. Raises InputError for a
    family, a method or a decision that is not there."""
    eta = [float(value) for value in as_list(config.eta)]
    if len(eta) != 1:
        raise InputError(
            f"eta={eta}: a search has one intensity, of which its families take shares; name one, or set tries=1"
        )
    method = methods_at(eta[0])
    plans = []
    for name in rows_of(config):
        changed, own = config_and_prior(config, name, prior=prior)
        if is_search(config, name):
            plans.append(portfolio_plan(name, changed, method=partial(method, own)))
        else:
            synthesizer = (
                changed.synthesizer
                if name in config.variants
                else method_config(config, name)
            )
            again = replace(SearchSettings(), cover=TRIES, bandit=False)
            plans.append(
                Plan(
                    name,
                    [Family(name, name, ranges={})],
                    traffic={name: method(own, name, synthesizer)},
                    settings=again,
                )
            )
    return plans


def methods_at(eta: float) -> Callable[[Prior, str, DictConfig], Method]:
    """A function that builds the methods of a name and a configuration on a prior,
    equal ones once, at an intensity."""
    known: dict[str, Method] = {}

    def method(prior: Prior, name: str, synthesizer: DictConfig) -> Method:
        key = f"{id(prior)} {name} {OmegaConf.to_yaml(synthesizer)}"
        if key not in known:
            built = build_traffic(synthesizer, prior)
            known[key] = Method(name, built, eta=eta if built.adversarial else 0.0)
        return known[key]

    return method


def portfolio_plan(
    name: str, config: DictConfig, method: Callable[[str, DictConfig], Method]
) -> Plan:
    """The plan of the group `search`."""
    given: Any = OmegaConf.to_container(config.search, resolve=True)
    named = {
        key: value
        for key, value in (given.pop("families") or {}).items()
        if value is not None
    }
    target = OmegaConf.create({"_target_": given.pop("_target_")})
    if not named:
        raise InputError(
            "search.families: name at least one, such as +search.families.rule={}"
        )
    families = [
        family_of(str(key), value, where="search.families")
        for key, value in named.items()
    ]
    traffic = {}
    methods = {
        name: method_config(config, name) for name in {each.method for each in families}
    }
    for each in families:
        where = f"search.families.{each.name}.changes"
        own = methods[each.method]
        traffic[each.name] = method(
            each.method,
            with_changes(own, each.changes, where=where, group="synthesizer"),
        )
        if each.ranges and not traffic[each.name].traffic.follows_decisions:
            decision = next(iter(each.ranges))
            raise InputError(
                f"search.families.{each.name}.{decision}: {each.method} does not decide this; leave it out"
            )
    return Plan(
        name,
        families,
        traffic=traffic,
        settings=settings_of(SearchSettings, given, where="search"),
        search=partial(built, target, "search", Search),
    )


def search_all(
    setups: Sequence[Setup],
    plans: Sequence[Plan],
    budget: float,
    unit: str,
    seeds: Sequence[int],
    work: Work = HERE,
) -> tuple[Scored, list[dict]]:
    """What every plan finds against every ego by each seed with `budget` of a `unit`
    (SPENT) a scene; and the tries. Raises InputError where the tries of a method
    evaluate no network, and the budget is in evaluations."""
    found: Scored = ([], [], [])
    told: list[dict] = []
    for plan in plans:
        free = {
            one.name
            for one in plan.traffic.values()
            if not isinstance(getattr(one.traffic, "prior", None), Prior)
        }
        if unit == "nfe" and free:
            raise InputError(
                f"{plan.name}: tries of {', '.join(sorted(free))} evaluate no network; give the budget in tries, "
                "budget_unit=tries"
            )
    asked = [
        (setup, plan, seed, work.scenes(setup), budget, unit)
        for setup in setups
        for plan in plans
        for seed in seeds
    ]
    for scored, tries in spend(asked, work):
        extend(found, scored)
        told += tries
    return found, told


def spend(
    searches: Sequence[tuple], work: Work = HERE
) -> list[tuple[Scored, list[dict]]]:
    """What each of some searches finds, and its tries; each: the arguments of
    `spending`. Their rounds are driven together, so that none waits for another."""
    all_spent: list[tuple[Scored, list[dict]]] = [(([], [], []), []) for _ in searches]
    begun = {number: spending(*given) for number, given in enumerate(searches)}
    rounds = {number: next(each) for number, each in begun.items()}
    first: Collection[str] | None = None
    while rounds:
        jobs = [
            (f"search-{number:03}/tries-{job:06}", part)
            for number, jobs in rounds.items()
            for job, part in jobs
        ]
        first = first_names(jobs) if first is None else ()  # of the first round
        scored = score_all(jobs, work, cost=lambda job: len(job[1][2]), first=first)
        after = {}
        for number, asked in rounds.items():
            found: Scored = ([], [], [])
            for _ in asked:
                extend(found, next(scored))
            try:
                after[number] = begun[number].send(found)
            except StopIteration as end:
                all_spent[number] = end.value
        rounds = after
    return all_spent


@dataclass
class Account:
    """What a search has spent a scene, and what its tries cost.

    Args:
        budget: that may be spent a scene.
        unit: of the budget, of SPENT.
        cost: NFE and seconds of the last try of each family, or what they are said to
            be.
        spent: so far, by SPENT.
    """

    budget: float
    unit: str
    cost: dict[str, tuple[float, float]]
    spent: dict[str, float] = field(default_factory=lambda: dict.fromkeys(SPENT, 0.0))

    def after(self, family: str, scenes: int) -> dict[str, float]:
        """Returns what will be spent after one more try of a family, of so many scenes
        that are tried."""
        each = dict(zip(SPENT, (1.0, *self.cost[family]), strict=True))
        return {name: self.spent[name] + value / scenes for name, value in each.items()}

    def affordable(self, tries: Sequence[Try], scenes: int) -> Sequence[Try]:
        """Returns the first of some tries that fit into the rest of the budget by what
        they will cost; one at first."""
        costs = [
            self.after(one.family, scenes)[self.unit] - self.spent[self.unit]
            for one in tries
        ]
        rest = (self.budget - self.spent[self.unit]) + CLOSE * self.budget
        fitting = sum(total <= rest for total in accumulate(costs))
        return tries[: fitting or int(self.spent["tries"] == 0)]

    def charge(self, family: str, row: Mapping, scenes: int) -> bool:
        """Returns whether a try was within the budget, or the first; then it is
        charged. One that errored costs what the last did."""
        if row["errored"] != 1:
            self.cost[family] = row["nfe"], row["seconds"]
        after = self.after(family, scenes)
        if self.spent["tries"] and after[self.unit] > self.budget * (1 + CLOSE):
            return False
        self.spent = after
        return True


def spending(
    setup: Setup, plan: Plan, seed: int, scenes: Sequence[int], budget: float, unit: str
) -> Generator[list[tuple[int, Part]], Scored, tuple[Scored, list[dict]]]:
    """One search: yields the numbered parts of each round, is sent what they scored,
    and returns what it found within the budget, and these tries in their order: round
    by round, the scenes of a round in an order of its own, so that a budget that ends
    within a round is spent on scenes at random. A try that errors counts as one that
    comes nowhere near."""
    search = plan.begin(setup, seed, scenes)
    told = list[dict]()
    found: Scored = ([], [], [])
    account = Account(
        budget, unit, cost={family.name: (family.nfe, 0.0) for family in plan.families}
    )
    generator = torch.Generator().manual_seed(seed)
    driven = 0
    with Bar(total=budget, desc=f"{plan.name}: {unit} a scene") as bar:
        while active := len(search.active()):
            order = torch.randperm(len(scenes), generator=generator).tolist()
            asked = sorted(search.ask(), key=lambda one: order[one.scene])
            outcomes = list[Outcome]()
            while len(outcomes) < len(asked):
                tries = account.affordable(asked[len(outcomes) :], active)
                if not tries:
                    return found, told
                scored = yield list(
                    enumerate(
                        batches(setup, plan, seed=seed, scenes=scenes, tries=tries),
                        driven,
                    )
                )
                driven += len(tries)
                known = {(row["scene_id"], row["seed"]): row for row in scored[0]}
                rows = [
                    known[setup.scenes.scene_id[scenes[one.scene]], row_seed(seed, one)]
                    for one in tries
                ]
                charged = list[Mapping]()
                for one, row in zip(tries, rows, strict=True):
                    if not account.charge(one.family, row, active):
                        break
                    charged.append(row)
                    outcomes.append(outcome_of(row, account.cost[one.family][0]))
                    told += (
                        []
                        if lost(row)
                        else [
                            told_of(row, one.family, outcome=outcomes[-1])
                            | account.spent
                        ]
                    )
                extend(found, within(scored, charged))
                timeless = unit == "seconds" and all(
                    row["errored"] == 1 for row in found[0]
                )
                if (
                    len(charged) < len(tries) or timeless
                ):  # nothing tells how long those would take that all errored
                    return found, told
                bar.update(min(account.spent[unit], budget) - bar.n)
            search.tell(asked, outcomes)
            if not asked:
                break
    return found, told


def outcome_of(row: Mapping, nfe: float) -> Outcome:
    """Returns what became of the try of a row; one that errored came nowhere near."""
    if row["errored"] == 1:
        return Outcome(-FARTHEST, "", nfe=nfe, raised=raised(row))
    return Outcome(row["margin"], ", ".join(cell_of(row) or ()), nfe=nfe)


def told_of(row: Mapping, family: str, outcome: Outcome) -> dict:
    """Returns the line of tries.csv of a try, but for what was SPENT."""
    clean = 0.0 if outcome.raised else row["cfr_clean"]
    about = {
        "family": family,
        "margin": outcome.margin,
        "cell": outcome.cell,
        "clean": clean,
    }
    line = {**row, **about, "raised": int(outcome.raised)}
    return {name: line[name] for name in TOLD}


def within(scored: Scored, charged: Sequence[Mapping]) -> Scored:
    """Returns what the rollouts of the rows `charged` scored."""
    rows, samples, errored = scored
    kept = {(row["scene_id"], row["seed"]) for row in charged}
    chosen = [k for k, row in enumerate(rows) if (row["scene_id"], row["seed"]) in kept]
    entries = [entry for entry in errored if (entry["scene_id"], entry["seed"]) in kept]
    return [rows[k] for k in chosen], [samples[k] for k in chosen], entries


def batches(
    setup: Setup, plan: Plan, seed: int, scenes: Sequence[int], tries: Sequence[Try]
) -> list[Part]:
    """Parts of tries: of one traffic method each, those of a scene together."""
    by_method: dict[int, list] = {}
    for one in sorted(tries, key=lambda one: (one.scene, one.number)):
        tasks = by_method.setdefault(
            id(plan.traffic[one.family]), []
        )  # of one traffic method
        tasks.append(Task(scenes[one.scene], row_seed(seed, one), one=one))
    parts = []
    for tasks in by_method.values():
        method = replace(plan.traffic[tasks[0].one.family], name=plan.name)
        parts += [(setup, method, batch) for batch in in_batches(tasks, setup.batch)]
    return parts


def row_seed(seed: int, one: Try) -> int:
    """The `seed` of a try's rollout in the tables; InputError where the scene has more
    than TRIES."""
    if one.number >= TRIES:
        raise InputError(
            f"budget: more than {TRIES} tries of a scene have no seeds of their own; spend less"
        )
    return seed * TRIES + one.number


def failures_of(file: Path, ego_name: str, plan: Plan, setup: Setup) -> list[Part]:
    """The tries of a `write_tries` file that hit an ego, as parts to be driven again;
    plan: the portfolio that they are of. Raises InputError for a file that is none, and
    for tries of other scenes, egos or families."""
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            rows = [
                (row["scene_id"], int(row["seed"]), row["family"])
                for row in CsvReader(lines)
                if (row["method"], row["ego_policy"]) == (plan.name, ego_name)
                and float(row["margin"]) >= 0
            ]
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(
            f"{file}: no table of a search's tries ({error!r}); name the folder of a search"
        ) from None
    if not rows:
        raise InputError(
            f"{file}: no try of {plan.name} hits {ego_name}; name a search against it"
        )
    families = {family.name: family for family in plan.families}
    if unknown := {family for _, _, family in rows} - set(families):
        raise InputError(
            f"{file}: family {min(unknown)} is none of search.families; set these as in its run"
        )
    every = range(len(setup.scenes))
    searches = {
        seed: plan.begin(setup, seed, every)
        for seed in {seed // TRIES for _, seed, _ in rows}
    }
    if other := next(
        (type(each).__name__ for each in searches.values() if type(each) is not Search),
        None,
    ):
        raise InputError(
            f"{file}: a try of {other} depends on those before it; make the whole search again"
        )
    tries: dict[int, list[Try]] = {}
    for scene_id, number, name in rows:
        seed = number // TRIES
        scene = setup.scenes.index(scene_id)
        drawn = families[name].draw(
            scene,
            number % TRIES,
            searches[seed].seed_of(scene),
            plan.settings.stratified,
        )
        tries.setdefault(seed, []).append(drawn)
    return [
        part
        for seed, own in tries.items()
        for part in batches(setup, plan, seed=seed, scenes=every, tries=own)
    ]


def write_tries(path: Path, told: Sequence[Mapping]) -> None:
    """Write the tries of a run, a line each."""
    names = [*TOLD, *SPENT]
    write_atomically(
        path, csv_text([names, *([row[name] for name in names] for row in told)])
    )
