"""The search for failures of a planner with a budget: ask for tries, tell what became
of them (docs/guide/evaluate.md).

First cover, then refine: tries are drawn from the families of a portfolio, stratified,
where they are likely to find something new.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.config import Extension, configured, setting
from e2rl.search.portfolio import Portfolio
from e2rl.search.tries import Family, Try

# tries that a round has at least: a batch costs much the same with one as with several
ROUND = 24
# tries of a round that a family has on average, about: each family is a batch
SHARED = 8
REPEATED = 1e-6  # of the worth of a try that a family has twice in a scene at once
# tries of a scene, in all of which the planner raised, after which no more are spent
RAISES = 3
# of a failure, that a contact counts which the competent driver nearly prevents
NEAR = 0.15
RAISED = "raised"  # a kind of failure beside the cells of the atlas


@configured("search/portfolio")
@dataclass(frozen=True)
class SearchSettings:
    """How tries are spent; conf/search/portfolio.yaml explains each."""

    cover: int = setting(low=1)
    growth: float = setting(low=0, high=1)
    bandit: bool = setting()
    again: float = setting(low=0, high=1)


class Outcome(NamedTuple):
    """What became of a try.

    Args:
        margin: `metrics.margin`.
        cell: of the atlas, "" unless the failure is preventable.
        nfe: what the try cost.
        raised: the planner raised, which is a failure of its own kind.
    """

    margin: float
    cell: str
    nfe: float
    raised: bool = False

    @property
    def kind(self) -> str:
        """The kind of failure; "" for none."""
        return RAISED if self.raised else self.cell


@dataclass
class Search(Extension):
    """The tries of N scenes so far, and what is tried next.

    Args:
        families: that tries are drawn from.
        numbers: [N] of the scenes, which tell them apart in seeds, whatever scenes are
            beside them.
        seed: of the search.
        settings: how tries are spent.
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
            self.families,
            len(self.numbers),
            learns=self.settings.bandit,
        )
        self._generator = torch.Generator().manual_seed(self.seed)

    def ask(self) -> list[Try]:
        """Returns the next tries, to be told in this order: one of every scene until it
        has `cover` of them, then of those families in those scenes that are worth the
        most: as many as there are scenes, or `growth` of the tries so far, but no more
        than a quarter of what could be chosen; ROUND at least, of so few families that
        some SHARED are of each. Where scenes and families are few, a family is tried several
        times in a scene. None of scenes that are not `active`."""
        worth = self._portfolio.worth(self._generator)
        active = self.active()
        if not active:
            return []
        worth = worth[active]  # [N', F]
        failed = torch.tensor([self._has_failure(scene) for scene in active])
        if self.settings.bandit:
            again = self.settings.again * worth
            worth = torch.where(failed[:, None], again, worth)
        worth = _repeated(worth, max(ROUND // worth.numel(), 1))
        tried = [len(tries) for tries in self.tries]
        uncovered = self.settings.cover - min(tried[scene] for scene in active)
        if uncovered > 0:
            share = -(-ROUND // len(worth))
            best = worth.topk(min(share, uncovered, worth.shape[1]), dim=1)
            pairs = [
                (position, family)
                for position, families in enumerate(best.indices.tolist())
                for family in families
            ]
        else:
            grown = round(self.settings.growth * sum(tried))
            size = max(ROUND, len(worth), min(grown, worth.numel() // 4))
            size = min(size, worth.numel())
            chosen = _of_few_families(worth, size).flatten().topk(size).indices
            pairs = [
                divmod(pair, worth.shape[1]) for pair in chosen.sort().values.tolist()
            ]
        drawn = []
        left = [self._tries_left(scene) for scene in range(len(self.numbers))]
        for position, family in pairs:
            scene = active[position]
            if left[scene] > 0:
                attempt = self.families[family % len(self.families)].draw(
                    scene,
                    tried[scene],
                    seed=self.seed_of(scene),
                )
                drawn.append(attempt)
                tried[scene] += 1
                left[scene] -= 1
        return drawn

    def active(self) -> list[int]:
        """Returns the scenes that tries are spent on: not those in which the planner
        always raised, RAISES times."""
        scenes = range(len(self.numbers))
        return [scene for scene in scenes if self._tries_left(scene) > 0]

    def _tries_left(self, scene: int) -> float:
        """How many more tries may be spent on a scene."""
        outcomes = self.outcomes[scene]
        if outcomes and all(outcome.raised for outcome in outcomes):
            return RAISES - len(outcomes)
        return math.inf

    def tell(self, tries: Sequence[Try], outcomes: Sequence[Outcome]) -> None:
        """Learn what became of tries that were asked for."""
        families = [family.name for family in self._portfolio.families]
        for attempt, outcome in zip(tries, outcomes, strict=True):
            scene = attempt.scene
            kind = outcome.kind
            failed = self._has_failure(scene)
            new = bool(kind) and (not failed or kind not in self.cells)
            reward = 1.0 if new else 0.0
            if not new and not failed:
                reward = NEAR * min(max(outcome.margin, 0.0), 1.0)
            self._portfolio.tell(
                scene,
                families.index(attempt.family),
                reward=reward,
                margin=outcome.margin,
                nfe=outcome.nfe,
            )
            if new and not failed:  # other failures of this scene are searched for
                self._portfolio.forget(scene)
            if kind:
                self.cells.add(kind)
            self.tries[scene].append(attempt)
            self.outcomes[scene].append(outcome)

    def _has_failure(self, scene: int) -> bool:
        return any(outcome.kind for outcome in self.outcomes[scene])

    def seed_of(self, scene: int) -> int:
        """Returns the seed of the draws of a scene."""
        return self.seed * 1_000_003 + int(self.numbers[scene])


def _repeated(worth: Tensor, count: int) -> Tensor:
    """Returns the worth [N, count F] of trying each family `count` times at once: that
    of what repeats is next to nothing, so that it comes last."""
    rank = torch.arange(count, dtype=worth.dtype)[:, None]
    return (worth[:, None] * REPEATED**rank).flatten(1)


def _of_few_families(worth: Tensor, size: int) -> Tensor:
    """Returns the worth [N, F] of tries, 0 but for so few families that `size` tries
    are some SHARED of each: those that the `size` best tries are worth the most of."""
    scenes, families = worth.shape
    best = worth.flatten().topk(size)
    total = worth.new_zeros(families).index_add(0, best.indices % families, best.values)
    count = max(size // SHARED, -(-size // scenes))
    chosen = total.topk(min(count, families)).indices
    few = torch.zeros_like(worth)
    few[:, chosen] = worth[:, chosen]
    return few
