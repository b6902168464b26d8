"""Searches for failures with a budget, round by round, and what each of their tries was
(docs/guide/evaluate.md).

Every method is tried again and again, with other noise; the method `search` spends its
tries on a portfolio of families.
"""

from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import NamedTuple

import torch

from e2rl.driving.batches import (
    HERE,
    Batch,
    Result,
    Work,
    scored_batch,
    split_tasks,
    with_errored,
)
from e2rl.driving.scored import Scored
from e2rl.driving.setup import Method, Setup, Task
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.margin import FARTHEST
from e2rl.prior.prior import Prior
from e2rl.run.errors import InputError
from e2rl.run.processes import workers
from e2rl.run.terminal import Bar
from e2rl.search.search import Outcome, Search, SearchSettings
from e2rl.search.tries import TRIES, Family, Try

UNITS = ("tries", "nfe", "seconds")  # of a budget, a scene that is still tried
ROUNDING = 1e-9  # of a budget


@dataclass(frozen=True)
class SearchMethod:
    """A row of the table whose rollouts are tries.

    Args:
        name: of the row.
        families: that tries are drawn from.
        traffic: of each family.
        settings: how tries are spent.
        search: makes the `Search` that spends them.
    """

    name: str
    families: list[Family]
    traffic: dict[str, Method]
    settings: SearchSettings
    search: Callable[..., Search] = Search

    def begin(self, setup: Setup, seed: int, scenes: Sequence[int]) -> Search:
        """Returns the search in some scenes, before its first try."""
        return self.search(
            families=self.families,
            numbers=[setup.scenes.number[scene] for scene in scenes],
            seed=seed,
            settings=self.settings,
        )


class Portion(NamedTuple):
    """Tries of a round that are driven at once: rollouts of one family's traffic."""

    family: str
    tasks: list[Task]


@dataclass
class Spent:
    """What searches scored, and the lines of tries.csv, in their order."""

    scored: Scored = field(default_factory=Scored)
    tries: list[dict] = field(default_factory=list)


@dataclass(frozen=True)
class Spending:
    """One search of a method against an ego.

    Args:
        setup: with the ego.
        method: whose families are tried.
        seed: of the search.
        scenes: positions of the scenes that are tried.
        budget: that may be spent a scene on average.
        unit: of the budget, one of UNITS.
    """

    setup: Setup
    method: SearchMethod
    seed: int
    scenes: Sequence[int]
    budget: float
    unit: str

    def rounds(self) -> Generator[list[Portion], Scored, Spent]:
        """Yields the portions of each round, is sent what they scored, and returns what
        was found within the budget.

        The scenes of a round have an order of its own, in which they take turns, so that
        a budget that ends within a round is spent on scenes at random. A try that errors
        counts as one that comes nowhere near.
        """
        search = self.method.begin(self.setup, self.seed, self.scenes)
        spent = Spent()
        account = Account(
            budget=self.budget,
            unit=self.unit,
            cost={family.name: (family.nfe, 0.0) for family in self.method.families},
        )
        generator = torch.Generator().manual_seed(self.seed)
        title = f"{self.method.name}: {self.unit} a scene"
        with Bar(total=self.budget, desc=title) as bar:
            while active := len(search.active()):
                order = torch.randperm(len(self.scenes), generator=generator).tolist()
                attempts = in_turns(search.ask(), order)
                outcomes: list[Outcome] = []
                while len(outcomes) < len(attempts):
                    tries = account.affordable(attempts[len(outcomes) :], active)
                    if not tries:
                        return spent
                    scored = yield self.portions(tries)
                    charged = self.charge(tries, scored, account, spent, active)
                    outcomes += charged
                    if len(charged) < len(tries) or self.untimed(spent):
                        return spent
                    bar.update(min(account.spent[self.unit], self.budget) - bar.n)
                search.tell(attempts, outcomes)
                if not attempts:
                    break
        return spent

    def portions(self, tries: Sequence[Try]) -> list[Portion]:
        """Returns tries by what is driven at once: of one traffic method each, those of
        a scene together."""
        by_traffic: dict[int, list[tuple[str, Task]]] = {}
        for attempt in sorted(tries, key=lambda attempt: attempt[:2]):
            traffic = self.method.traffic[attempt.family]
            task = Task(
                self.scenes[attempt.scene],
                row_seed(self.seed, attempt),
                noise=attempt.seed,
                decisions=attempt.decisions,
            )
            by_traffic.setdefault(id(traffic), []).append((attempt.family, task))
        return [
            Portion(pairs[0][0], part)
            for pairs in by_traffic.values()
            for part in split_tasks([task for _, task in pairs], self.setup.batch)
        ]

    def batch(self, portion: Portion) -> Batch:
        """Returns a portion as it is driven."""
        method = replace(self.method.traffic[portion.family], name=self.method.name)
        return Batch(self.setup, method, portion.tasks)

    def cost(self, portion: Portion) -> float:
        """Returns about what a portion takes beside others: its NFE."""
        (nfe,) = (
            family.nfe
            for family in self.method.families
            if family.name == portion.family
        )
        return len(portion.tasks) * max(nfe, 1)

    def charge(
        self,
        tries: Sequence[Try],
        scored: Scored,
        account: "Account",
        spent: Spent,
        active: int,
    ) -> list[Outcome]:
        """Returns the outcomes of the tries within the budget, the first of them, which
        join what is `spent`.

        Args:
            tries: that were driven.
            scored: what they scored.
            account: that is charged.
            spent: of the search so far.
            active: number of the scenes that are still tried.
        """
        position = {
            (row["scene_id"], row["seed"]): index
            for index, row in enumerate(scored.rows)
        }
        outcomes: list[Outcome] = []
        chosen: list[int] = []
        for attempt in tries:
            scene_id = self.setup.scenes.scene_id[self.scenes[attempt.scene]]
            index = position[scene_id, row_seed(self.seed, attempt)]
            row = scored.rows[index]
            if not account.charge(attempt.family, row, active):
                break
            chosen.append(index)
            outcome = outcome_of(row, account.cost[attempt.family][0])
            outcomes.append(outcome)
            if not lost(row):
                line = try_line(row, attempt.family, outcome)
                spent.tries.append(line | account.spent)
        rows, samples = scored.where(sorted(chosen))
        finished = {(row["scene_id"], row["seed"]) for row in rows}
        errored = [
            entry
            for entry in scored.errored
            if (entry["scene_id"], entry["seed"]) in finished
        ]
        spent.scored.add(Scored(rows, samples, errored))
        return outcomes

    def untimed(self, spent: Spent) -> bool:
        """Returns whether seconds are counted and all tries errored, so that nothing
        tells how long more of them would take."""
        rows = spent.scored.rows
        return self.unit == "seconds" and all(row["errored"] == 1 for row in rows)


@dataclass
class Account:
    """What a search has spent a scene, and what its tries cost.

    Args:
        budget: that may be spent a scene.
        unit: of the budget.
        cost: NFE and seconds of the last try of each family, or what they are said to
            be.
        spent: so far, by UNITS.
    """

    budget: float
    unit: str
    cost: dict[str, tuple[float, float]]
    spent: dict[str, float] = field(default_factory=lambda: dict.fromkeys(UNITS, 0.0))

    def after(self, family: str, scenes: int) -> dict[str, float]:
        """Returns what will be spent after one more try of a family, of so many scenes
        that are tried."""
        nfe, seconds = self.cost[family]
        cost = {"tries": 1.0, "nfe": nfe, "seconds": seconds}
        return {unit: self.spent[unit] + cost[unit] / scenes for unit in UNITS}

    def affordable(self, tries: Sequence[Try], scenes: int) -> Sequence[Try]:
        """Returns the first of some tries that fit into the rest of the budget by what
        they will cost; one at first."""
        spent = self.spent[self.unit]
        costs = [
            self.after(attempt.family, scenes)[self.unit] - spent for attempt in tries
        ]
        rest = (self.budget - spent) + ROUNDING * self.budget
        fitting = sum(total <= rest for total in accumulate(costs))
        return tries[: fitting or int(self.spent["tries"] == 0)]

    def charge(self, family: str, row: Mapping, scenes: int) -> bool:
        """Returns whether a try was within the budget, or the first; then it is
        charged. One that errored costs what the last did."""
        if row["errored"] != 1:
            self.cost[family] = row["nfe"], row["seconds"]
        after = self.after(family, scenes)
        if self.spent["tries"] and after[self.unit] > self.budget * (1 + ROUNDING):
            return False
        self.spent = after
        return True


def search_all(
    setups: Sequence[Setup],
    methods: Sequence[SearchMethod],
    *,
    budget: float,
    unit: str,
    seeds: Sequence[int],
    work: Work = HERE,
) -> Spent:
    """Returns what every method finds against every ego by each seed.

    Args:
        setups: differ in their ego.
        methods: that search.
        budget: that may be spent a scene on average.
        unit: of the budget, one of UNITS.
        seeds: of the searches.
        work: how, and in which scenes.

    Raises:
        InputError: where the tries of a method evaluate no network, and the budget is
            in evaluations.
    """
    for method in methods:
        free = {
            traffic.name
            for traffic in method.traffic.values()
            if not isinstance(getattr(traffic.traffic, "prior", None), Prior)
        }
        if unit == "nfe" and free:
            raise InputError(
                f"{method.name}: tries of {', '.join(sorted(free))} evaluate no "
                "network; give the budget in tries, budget_unit=tries"
            )
    searches = [
        Spending(
            setup,
            method,
            seed=seed,
            scenes=work.scenes(setup),
            budget=budget,
            unit=unit,
        )
        for setup in setups
        for method in methods
        for seed in seeds
    ]
    result = Spent()
    for spent in spend_together(searches, work):
        result.scored.add(spent.scored)
        result.tries += spent.tries
    return result


class Drive(NamedTuple):
    """A portion of the round of a search, as a process is sent it.

    Args:
        name: of its part.
        search: number of the search.
        portion: that is driven.
        begins: its ego begins the run with it.
    """

    name: str
    search: int
    portion: Portion
    begins: bool


def spend_together(searches: Sequence[Spending], work: Work = HERE) -> list[Spent]:
    """Returns what each search finds. Their rounds are driven beside each other, each
    as soon as the search has the results of the one before."""
    results = [Spent() for _ in searches]
    running = [search.rounds() for search in searches]
    driven = [0] * len(searches)  # tries of each search
    rounds: list[list[Scored | None]] = [[] for _ in searches]  # None: to come
    places: dict[int, tuple[int, int]] = {}  # of each job, its search and place
    egos: set[str] = set()  # that have begun

    def drive(job: Drive) -> Result:
        batch = searches[job.search].batch(job.portion)
        return scored_batch(job.name, batch, work, begins=job.begins)

    with workers(drive, work.processes) as crew:

        def send(number: int, portions: Sequence[Portion]) -> None:
            search = searches[number]
            rounds[number] = [None] * len(portions)
            for place, portion in enumerate(portions):
                ego = search.setup.ego_name
                name = f"search-{number:03}/tries-{driven[number] + place:06}"
                job = Drive(name, number, portion, begins=ego not in egos)
                egos.add(ego)
                places[crew.submit(job, search.cost(portion))] = number, place
            driven[number] += sum(len(portion.tasks) for portion in portions)

        for number, search in enumerate(running):
            send(number, next(search))
        while places:
            ticket, result = crew.result()
            number, place = places.pop(ticket)
            rounds[number][place] = with_errored(result, work)
            scored = [part for part in rounds[number] if part is not None]
            if len(scored) < len(rounds[number]):
                continue
            total = Scored()
            for part in scored:
                total.add(part)
            try:
                send(number, running[number].send(total))
            except StopIteration as end:
                results[number] = end.value
    return results


def in_turns(attempts: Sequence[Try], order: Sequence[int]) -> list[Try]:
    """Returns the first try of each scene, then the second of each, and so on; the
    scenes in an order [N]."""
    turns: Counter[int] = Counter()
    ranks = []
    for attempt in attempts:
        ranks.append((turns[attempt.scene], order[attempt.scene]))
        turns[attempt.scene] += 1
    ranked = sorted(range(len(attempts)), key=ranks.__getitem__)
    return [attempts[position] for position in ranked]


def outcome_of(row: Mapping, nfe: float) -> Outcome:
    """Returns what became of the try of a row; one that errored came nowhere near."""
    if row["errored"] == 1:
        return Outcome(-FARTHEST, "", nfe=nfe, raised=raised(row))
    return Outcome(row["margin"], ", ".join(cell_of(row) or ()), nfe=nfe)


def try_line(row: Mapping, family: str, outcome: Outcome) -> dict:
    """Returns the line of tries.csv of a try, but for what was spent."""
    copied = ("scene_id", "location", "seed", "method", "ego_policy")
    return {name: row[name] for name in copied} | {
        "family": family,
        "margin": outcome.margin,
        "cell": outcome.cell,
        "clean": 0.0 if outcome.raised else row["cfr_clean"],
        "raised": int(outcome.raised),
    }


def row_seed(seed: int, attempt: Try) -> int:
    """Returns the `seed` of a try's rollout in the tables; InputError where the scene
    has more than TRIES."""
    if attempt.number >= TRIES:
        raise InputError(
            f"budget: more than {TRIES} tries of a scene have no seeds of their own; "
            "spend less"
        )
    return seed * TRIES + attempt.number
