"""The search for failures of a planner with a budget: ask for tries, tell what became of them (docs/search.md).

First cover, then refine. Tries are drawn from the families of a portfolio, stratified, where they are likely to find
something new; and from a try that came near a preventable failure others branch, at the replan at which the hazard
rose, with other noise and one other decision.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.margin import PREVENTED
from e2rl.run.config import Extension
from e2rl.run.settings import configured, setting
from e2rl.search.portfolio import Portfolio
from e2rl.search.tries import TRIES, Family, Try
from e2rl.traffic.e2.decisions import BY_RULE, Decisions
from e2rl.traffic.traffic import REPLAN_STEPS

BRANCH = "branch"  # the family of tries that branch
FAR = -8.0  # margin below which nothing branches from a try
LEADS = (0, 3, 6)  # replans before the rise of the hazard at which branches begin, in turn
ROUND = 24  # tries that a round of few scenes has at least: its batches cost much the same with one try as with several


@configured("search/portfolio")
@dataclass(frozen=True)
class SearchSettings:
    """How tries are spent; conf/search/portfolio.yaml explains each."""

    cover: int = setting(low=1)
    width: float = setting(low=0.01, high=1)
    stratified: bool = setting()
    bandit: bool = setting()
    brood: int = setting(low=0)
    branch_chance: float = setting(low=0, high=1)
    again: float = setting(low=0, high=1)
    climb: bool = setting()


class Outcome(NamedTuple):
    """What became of a try: margin and hazard_step (`metrics.margin`); cell of the atlas, "" unless the failure is
    preventable; nfe: what it cost."""

    margin: float
    hazard_step: float
    cell: str
    nfe: float


@dataclass
class Search(Extension):
    """The tries of N scenes so far, and what is tried next.

    Args:
        families: that tries are drawn from.
        numbers: [N] that tell the scenes apart in seeds, whatever scenes are beside them.
        seed: of the search.
        settings: how tries are spent.
        branches: {family: bool}, whether its method takes a script and a seed for each replan.
    """

    families: Sequence[Family]
    numbers: Sequence[int]
    seed: int
    settings: SearchSettings
    branches: Mapping[str, bool]
    tries: list[list[Try]] = field(init=False)  # of each scene
    outcomes: list[list[Outcome]] = field(init=False)
    cells: set[str] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        self.tries = [[] for _ in self.numbers]
        self.outcomes = [[] for _ in self.numbers]
        self._portfolio = Portfolio(
            [*self.families, Family(BRANCH, "", {}, chance=self.settings.branch_chance)],
            len(self.numbers),
            self.settings.bandit,
        )
        self._generator = torch.Generator().manual_seed(self.seed)
        self._drawn = torch.zeros(len(self.numbers), len(self.families), dtype=torch.int64)

    @property
    def nfe(self) -> float:
        """Of all tries, a scene."""
        return sum(outcome.nfe for scene in self.outcomes for outcome in scene) / len(self.numbers)

    def ask(self) -> list[Try]:
        """The next tries, to be told in this order: one of every scene until it has `cover` of them, then of those
        families in those scenes that are worth the most, `width` times as many as there are scenes; ROUND at least."""
        worth = self._portfolio.worth(self._generator)
        found = torch.tensor([any(outcome.cell for outcome in scene) for scene in self.outcomes])
        worth = torch.where(found[:, None], self.settings.again * worth, worth)
        worth[:, -1] = worth[:, -1].masked_fill(~self._may_branch(), -torch.inf)
        uncovered = self.settings.cover - min(len(tries) for tries in self.tries)
        if uncovered > 0:
            each = worth.topk(min(-(-ROUND // len(worth)), uncovered, len(self.families)), dim=1).indices
            chosen = [(scene, family) for scene, families in enumerate(each.tolist()) for family in families]
        else:
            count = min(max(ROUND, round(self.settings.width * len(worth))), int(worth.isfinite().sum()))
            best = worth.flatten().topk(count).indices.sort().values
            chosen = [divmod(pair, worth.shape[1]) for pair in best.tolist()]
        asked: list[Try] = []
        for scene, family in chosen:
            first = len(self.tries[scene]) + sum(one.scene == scene for one in asked)
            asked += self._draw(scene, family, first)
        return asked

    def tell(self, tries: Sequence[Try], outcomes: Sequence[Outcome]) -> None:
        """What became of tries that were asked for."""
        names = [family.name for family in self._portfolio.families]
        for one, outcome in zip(tries, outcomes, strict=True):
            kind = BRANCH if one.parent >= 0 else one.family
            first = bool(outcome.cell) and not self._found(one.scene)
            new = first or (bool(outcome.cell) and outcome.cell not in self.cells)
            margin = outcome.margin if self.settings.climb else PREVENTED
            self._portfolio.tell(one.scene, names.index(kind), float(new), margin, outcome.nfe)
            if first:  # from now on other failures of this scene are searched for
                self._portfolio.forget(one.scene)
            self.cells |= {outcome.cell} if outcome.cell else set()
            self.tries[one.scene].append(one)
            self.outcomes[one.scene].append(outcome)

    def _found(self, scene: int) -> bool:
        return any(outcome.cell for outcome in self.outcomes[scene])

    def _draw(self, scene: int, family: int, first: int) -> list[Try]:
        """The tries of a family in a scene, numbered from `first` on."""
        if family < len(self.families):
            drawn = int(self._drawn[scene, family])
            self._drawn[scene, family] += 1
            seed = self._seed(scene)
            stratified = self.settings.stratified
            return [self.families[family].draw(scene, first, seed, drawn, stratified)]
        pairs = zip(self.tries[scene], self.outcomes[scene], strict=True)
        near = [pair for pair in pairs if self._near(*pair)]
        climbs = max(near, key=lambda pair: pair[1].margin)
        parent, outcome = climbs if self.settings.climb else near[self._draws(len(near))]
        count = self.settings.brood
        rise = int(outcome.hazard_step) // REPLAN_STEPS
        replan = max(rise - LEADS[first % len(LEADS)], 0)
        fresh = [self._seed(scene) * TRIES + first + k for k in range(count)]
        return [parent.branch(first + k, replan, fresh[k], **self._mutation(parent)) for k in range(count)]

    def _mutation(self, parent: Try) -> dict[str, float]:
        """One other decision of a branch."""
        now = Decisions(*parent.script[-1])
        name = ("strength", "patience", "owes", "moment", "scatter", "")[self._draws(6)]
        u = float(torch.rand((), generator=self._generator))
        values = {
            "strength": float(now.strength) * (0.6 + 0.9 * u),
            "patience": float(now.patience) * 4 * u,
            "owes": 1 - float(now.owes),
            "moment": BY_RULE if now.moment >= 0 else 1 + 4 * u,
            "scatter": 2 * u,
        }
        return {name: values[name]} if name else {}

    def _draws(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self._generator))

    def _near(self, one: Try, outcome: Outcome) -> bool:
        return FAR < outcome.margin < PREVENTED and self.branches[one.family]

    def _may_branch(self) -> Tensor:
        pairs = (zip(tries, told, strict=True) for tries, told in zip(self.tries, self.outcomes, strict=True))
        return torch.tensor([self.settings.brood > 0 and any(self._near(*pair) for pair in each) for each in pairs])

    def _seed(self, scene: int) -> int:
        return self.seed * 1_000_003 + int(self.numbers[scene])
