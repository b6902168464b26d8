"""The search for failures of a planner with a budget: ask for tries, tell what became
of them (docs/search.md).

First cover, then refine: tries are drawn from the families of a portfolio, stratified,
where they are likely to find something new.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

import torch

from e2rl.run.config import Extension
from e2rl.run.settings import configured, setting
from e2rl.search.portfolio import Portfolio
from e2rl.search.tries import Family, Try

ROUND = 24  # tries that a round of few scenes has at least: its batches cost much the same with one try as with several
RAISES = 3  # tries of a scene, in all of which the planner raised, after which no more are spent on it
NEAR = 0.15  # of a failure, that a contact counts which the competent driver nearly prevents


@configured("search/portfolio")
@dataclass(frozen=True)
class SearchSettings:
    """How tries are spent; conf/search/portfolio.yaml explains each."""

    cover: int = setting(low=1)
    growth: float = setting(low=0, high=1)
    stratified: bool = setting()
    bandit: bool = setting()
    again: float = setting(low=0, high=1)
    climb: bool = setting()


RAISED = "raised"  # a kind of failure beside the cells of the atlas


class Outcome(NamedTuple):
    """What became of a try: margin (`metrics.margin`); cell of the atlas, "" unless the
    failure is preventable; nfe: what it cost; raised: the planner raised, which is a
    failure of its own kind."""

    margin: float
    cell: str
    nfe: float
    raised: bool = False

    @property
    def kind(self) -> str:
        """The way of failing; "" for none."""
        return RAISED if self.raised else self.cell


@dataclass
class Search(Extension):
    """The tries of N scenes so far, and what is tried next.

    Tries are drawn from `families`. The `numbers` [N] tell scenes apart in seeds,
    whatever scenes are beside them.
    """

    families: Sequence[Family]
    numbers: Sequence[int]
    seed: int
    settings: SearchSettings

    def __post_init__(self) -> None:
        self.tries: list[list[Try]] = [[] for _ in self.numbers]  # of each scene
        self.outcomes: list[list[Outcome]] = [[] for _ in self.numbers]
        self.cells: set[str] = set()
        self._portfolio = Portfolio(
            self.families, len(self.numbers), learns=self.settings.bandit
        )
        self._generator = torch.Generator().manual_seed(self.seed)

    def ask(self) -> list[Try]:
        """The next tries, to be told in this order: one of every scene until it has
        `cover` of them, then of those families in those scenes that are worth the most:
        as many as there are scenes, or `growth` of the tries so far, but no more than a
        quarter of what could be chosen; ROUND at least. None of scenes that are not
        `active`."""
        worth = self._portfolio.worth(self._generator)
        active = self.active()
        if not active:
            return []
        found = self.settings.bandit & torch.tensor(
            [self._found(scene) for scene in active]
        )
        worth = torch.where(
            found[:, None], self.settings.again * worth[active], worth[active]
        )
        uncovered = self.settings.cover - min(
            len(self.tries[scene]) for scene in active
        )
        if uncovered > 0:
            each = worth.topk(
                min(-(-ROUND // len(worth)), uncovered, len(self.families)), dim=1
            ).indices
            chosen = [
                (scene, family)
                for scene, families in enumerate(each.tolist())
                for family in families
            ]
        else:
            grown = min(
                round(self.settings.growth * sum(map(len, self.tries))),
                worth.numel() // 4,
            )
            size = min(max(ROUND, len(worth), grown), worth.numel())
            best = worth.flatten().topk(size).indices.sort().values
            chosen = [divmod(pair, worth.shape[1]) for pair in best.tolist()]
        number = [
            count(len(tries)) for tries in self.tries
        ]  # of the next try of each scene
        rest = [self._rest(scene) for scene in range(len(self.numbers))]
        drawn = []
        for scene, family in (
            (active[position], family) for position, family in chosen
        ):
            if rest[scene] > 0:
                drawn.append(self._draw(scene, family, number=next(number[scene])))
                rest[scene] -= 1
        return drawn

    def active(self) -> list[int]:
        """Returns the scenes that tries are spent on: not those in which the planner
        always raised, RAISES times."""
        return [scene for scene in range(len(self.numbers)) if self._rest(scene) > 0]

    def _rest(self, scene: int) -> float:
        """How many more tries may be spent on a scene."""
        outcomes = self.outcomes[scene]
        return (
            RAISES - len(outcomes)
            if outcomes and all(each.raised for each in outcomes)
            else math.inf
        )

    def tell(self, tries: Sequence[Try], outcomes: Sequence[Outcome]) -> None:
        """What became of tries that were asked for."""
        names = [family.name for family in self._portfolio.families]
        for one, outcome in zip(tries, outcomes, strict=True):
            known = self._found(one.scene)
            new = bool(outcome.kind) and (not known or outcome.kind not in self.cells)
            climbs = self.settings.climb and not known
            reward = 1.0 if new else climbs * NEAR * min(max(outcome.margin, 0.0), 1.0)
            margin = outcome.margin if self.settings.climb else 0.0
            self._portfolio.tell(
                one.scene, names.index(one.family), reward, margin, outcome.nfe
            )
            if (
                new and not known
            ):  # from now on other failures of this scene are searched for
                self._portfolio.forget(one.scene)
            self.cells |= {outcome.kind} if outcome.kind else set()
            self.tries[one.scene].append(one)
            self.outcomes[one.scene].append(outcome)

    def _found(self, scene: int) -> bool:
        return any(outcome.kind for outcome in self.outcomes[scene])

    def _draw(self, scene: int, family: int, number: int) -> Try:
        """The next try of a family in a scene, the scene's `number`-th."""
        return self.families[family].draw(
            scene, number, self.seed_of(scene), self.settings.stratified
        )

    def seed_of(self, scene: int) -> int:
        """The seed of the draws of a scene."""
        return self.seed * 1_000_003 + int(self.numbers[scene])
