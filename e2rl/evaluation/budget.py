"""Searches for failures with a budget, round by round, and what each of their tries was (docs/search.md).

Every method is tried again and again, with other noise; the method `search` spends its tries on a portfolio of
families. What they find is told at several budgets by `report.budget`.
"""

import csv
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from e2rl.evaluation.methods import as_list, build_traffic, config_and_prior, is_search, method_config, rows_of
from e2rl.evaluation.protocol import HERE, Method, Part, Scored, Setup, Task, Work, extend, in_batches, score_all
from e2rl.evaluation.summary import GROUP
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.margin import FARTHEST
from e2rl.prior.prior import Prior
from e2rl.run.config import built, with_changes
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically
from e2rl.run.settings import settings_of
from e2rl.search.search import Outcome, Search, SearchSettings
from e2rl.search.tries import TRIES, Family, Try, family_of

TRIES_FILE = "tries.csv"
TOLD = ("scene_id", "location", "seed", "method", "ego_policy", "family", "margin", "cell", "clean")
EVENTS = ("cfr_preventable", "cfr_counted", "cfr")  # of a try
SPENT = ("tries", "nfe", "seconds")  # a scene, of the search so far


@dataclass(frozen=True)
class Plan:
    """A row of the budget's table: a name, families with their traffic, and how tries are spent, by a `search`."""

    name: str
    families: list[Family]
    traffic: dict[str, Method]
    settings: SearchSettings
    search: Callable[..., Search] = Search

    def begin(self, setup: Setup, seed: int, only: Sequence[int]) -> Search:
        """The search in scenes `only`, before its first try."""
        numbers = [setup.scenes.number[scene] for scene in only]
        return self.search(families=self.families, numbers=numbers, seed=seed, settings=self.settings)


def build_plans(config: DictConfig, prior: Prior) -> list[Plan]:
    """The rows of `config.methods` and `config.variants`. Raises InputError for a family, a method or a decision that
    is not there."""
    eta = [float(value) for value in as_list(config.eta)]
    if len(eta) != 1:
        raise InputError(
            f"eta={eta}: a search has one intensity, of which its families take shares; name one, or set tries=1"
        )
    method, plans = methods_at(eta[0]), []
    for name in rows_of(config):
        changed, own = config_and_prior(config, name, prior)
        if is_search(config, name):
            plans.append(portfolio_plan(name, changed, partial(method, own)))
        else:
            synthesizer = changed.synthesizer if name in config.variants else method_config(config, name)
            again = replace(SearchSettings(), cover=TRIES, bandit=False)
            plans.append(Plan(name, [Family(name, name, {})], {name: method(own, name, synthesizer)}, again))
    return plans


def methods_at(eta: float) -> Callable[[Prior, str, DictConfig], Method]:
    """A function that builds the methods of a name and a configuration on a prior, equal ones once, at an intensity."""
    known: dict[str, Method] = {}

    def method(prior: Prior, name: str, synthesizer: DictConfig) -> Method:
        key = f"{id(prior)} {name} {OmegaConf.to_yaml(synthesizer)}"
        if key not in known:
            built = build_traffic(synthesizer, prior)
            known[key] = Method(name, built, eta if built.adversarial else 0.0)
        return known[key]

    return method


def portfolio_plan(name: str, config: DictConfig, method: Callable[[str, DictConfig], Method]) -> Plan:
    """The plan of the group `search`."""
    given: Any = OmegaConf.to_container(config.search, resolve=True)
    named = {key: value for key, value in (given.pop("families") or {}).items() if value is not None}
    target = OmegaConf.create({"_target_": given.pop("_target_")})
    if not named:
        raise InputError("search.families: name at least one, such as +search.families.rule={}")
    families = [family_of(str(key), value, "search.families") for key, value in named.items()]
    traffic, methods = {}, {name: method_config(config, name) for name in {each.method for each in families}}
    for each in families:
        where, own = f"search.families.{each.name}.changes", methods[each.method]
        traffic[each.name] = method(each.method, with_changes(own, each.changes, where, "synthesizer"))
        if each.ranges and not traffic[each.name].traffic.follows_decisions:
            decision = next(iter(each.ranges))
            raise InputError(
                f"search.families.{each.name}.{decision}: {each.method} does not decide this; leave it out"
            )
    return Plan(
        name, families, traffic, settings_of(SearchSettings, given, "search"), partial(built, target, "search", Search)
    )


def search_all(
    setups: Sequence[Setup], plans: Sequence[Plan], budget: float, unit: str, seeds: Sequence[int], work: Work = HERE
) -> tuple[Scored, list[dict]]:
    """What every plan finds against every ego by each seed with `budget` of a `unit` (SPENT) a scene; and the tries.
    Raises InputError where the tries of a method evaluate no network, and the budget is in evaluations."""
    found: Scored = ([], [], [])
    told: list[dict] = []
    for plan in plans:
        free = {one.name for one in plan.traffic.values() if not isinstance(getattr(one.traffic, "prior", None), Prior)}
        if unit == "nfe" and free:
            raise InputError(
                f"{plan.name}: tries of {', '.join(sorted(free))} evaluate no network; give the budget in tries, "
                "budget_unit=tries"
            )
    asked = [
        (setup, plan, seed, work.scenes(setup), budget, unit) for setup in setups for plan in plans for seed in seeds
    ]
    for scored, tries in spend(asked, work):
        extend(found, scored)
        told += tries
    return found, told


def spend(searches: Sequence[tuple], work: Work = HERE) -> list[tuple[Scored, list[dict]]]:
    """What each of some searches finds, and its tries; each: the arguments of `spending`. Their rounds are driven
    together, so that none waits for another."""
    all_spent: list[tuple[Scored, list[dict]]] = [(([], [], []), []) for _ in searches]
    begun = {number: spending(*given) for number, given in enumerate(searches)}
    rounds = {number: next(each) for number, each in begun.items()}
    while rounds:
        jobs = [(f"search-{number:03}/tries-{job:06}", part) for number, jobs in rounds.items() for job, part in jobs]
        scored, after = score_all(jobs, work, lambda job: len(job[1][2])), {}
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


def spending(
    setup: Setup, plan: Plan, seed: int, scenes: Sequence[int], budget: float, unit: str
) -> Generator[list[tuple[int, Part]], Scored, tuple[Scored, list[dict]]]:
    """One search: yields the numbered parts of each round, is sent what they scored, and returns what it found, and its
    tries in their order: round by round, the scenes of a round in an order of its own, so that a budget that ends
    within a round is spent on scenes at random. A try that errors counts as one that comes nowhere near, and costs what
    the last one of its family did, or is said to."""
    search, told = plan.begin(setup, seed, scenes), list[dict]()
    found: Scored = ([], [], [])
    cost = {family.name: (family.nfe, 0.0) for family in plan.families}  # of a try: NFE, seconds
    generator = torch.Generator().manual_seed(seed)
    spent = dict.fromkeys(SPENT, 0.0)
    with tqdm(total=budget, desc=f"{plan.name}: {unit} a scene", disable=None) as bar:
        while spent[unit] < budget * (1 - 1e-9):
            order = torch.randperm(len(scenes), generator=generator).tolist()
            tries = sorted(search.ask(), key=lambda one: order[one.scene])
            scored = yield list(enumerate(batches(setup, plan, seed, scenes, tries), sum(map(len, search.tries))))
            extend(found, scored)
            known = {(row["scene_id"], row["seed"]): row for row in scored[0]}
            rows = [known.get((setup.scenes.scene_id[scenes[one.scene]], row_seed(seed, one))) for one in tries]
            outcomes = []
            for one, row in zip(tries, rows, strict=True):
                margin, cell = -FARTHEST, ""  # of one that errored
                if row:
                    cost[one.family] = row["nfe"], row["seconds"]
                    margin, cell = row["margin"], ", ".join(cell_of(row) or ())
                each = 1.0, *cost[one.family]
                spent = {name: spent[name] + value / len(scenes) for name, value in zip(SPENT, each, strict=True)}
                outcomes.append(Outcome(margin, cell, each[1]))
                if row:
                    line = row | {"family": one.family, "cell": cell, "clean": row["cfr_clean"]} | spent
                    told.append({name: line[name] for name in (*TOLD, *SPENT)})
            search.tell(tries, outcomes)
            if unit == "seconds" and not told:
                break  # all errored, and nothing tells how long they would take
            bar.update(min(spent[unit], budget) - bar.n)
    return found, told


def batches(setup: Setup, plan: Plan, seed: int, scenes: Sequence[int], tries: Sequence[Try]) -> list[Part]:
    """Parts of tries: of one traffic method each, those of a scene together."""
    by_method: dict[int, list] = {}
    for one in sorted(tries, key=lambda one: (one.scene, one.number)):
        tasks = by_method.setdefault(id(plan.traffic[one.family]), [])  # of one traffic method
        tasks.append(Task(scenes[one.scene], row_seed(seed, one), one))
    parts = []
    for tasks in by_method.values():
        method = replace(plan.traffic[tasks[0].one.family], name=plan.name)
        parts += [(setup, method, batch) for batch in in_batches(tasks, setup.batch)]
    return parts


def row_seed(seed: int, one: Try) -> int:
    """The `seed` of a try's rollout in the tables; InputError where the scene has more than TRIES."""
    if one.number >= TRIES:
        raise InputError(f"budget: more than {TRIES} tries of a scene have no seeds of their own; spend less")
    return seed * TRIES + one.number


def failures_of(file: Path, ego_name: str, plan: Plan, setup: Setup) -> list[Part]:
    """The tries of a `write_tries` file that hit an ego, as parts to be driven again; plan: the portfolio that they are
    of. Raises InputError for a file that is none, and for tries of other scenes, egos or families."""
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            rows = [
                (row["scene_id"], int(row["seed"]), row["family"])
                for row in csv.DictReader(lines)
                if (row["method"], row["ego_policy"]) == (plan.name, ego_name) and float(row["margin"]) >= 0
            ]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{file}: no table of a search's tries ({error!r}); name the folder of a search") from None
    if not rows:
        raise InputError(f"{file}: no try of {plan.name} hits {ego_name}; name a search against it")
    families = {family.name: family for family in plan.families}
    if unknown := {family for _, _, family in rows} - set(families):
        raise InputError(f"{file}: family {min(unknown)} is none of search.families; set these as in its run")
    every = range(len(setup.scenes))
    searches = {seed: plan.begin(setup, seed, every) for seed in {seed // TRIES for _, seed, _ in rows}}
    if other := next((type(each).__name__ for each in searches.values() if type(each) is not Search), None):
        raise InputError(f"{file}: a try of {other} depends on those before it; make the whole search again")
    tries: dict[int, list[Try]] = {}
    for scene_id, number, name in rows:
        seed, scene = number // TRIES, setup.scenes.index(scene_id)
        drawn = families[name].draw(scene, number % TRIES, searches[seed].seed_of(scene), plan.settings.stratified)
        tries.setdefault(seed, []).append(drawn)
    return [part for seed, own in tries.items() for part in batches(setup, plan, seed, every, own)]


def scene_rows(rows: Sequence[Mapping], events: Sequence[str] = EVENTS) -> list[dict]:
    """A row for each search of each scene, from the rows of its tries: `events`, 1 where any try has one; seed: of the
    search."""
    found: dict[tuple, dict] = {}
    for row in rows:
        identity = {name: row[name] for name in (*GROUP, "scene_id", "location")} | {"seed": row["seed"] // TRIES}
        one = found.setdefault(tuple(identity.values()), identity | dict.fromkeys(events, 0.0))
        one |= {name: max(one[name], float(row[name])) for name in events}
    return list(found.values())


def write_tries(path: Path, told: Sequence[Mapping]) -> None:
    """Write the tries of a run, a line each."""
    names = [*TOLD, *SPENT]
    write_atomically(path, csv_text([names, *([row[name] for name in names] for row in told)]))
