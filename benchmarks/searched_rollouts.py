"""What a search costs beside its rollouts: its rounds, which are small batches, and its
questions and answers."""

import time
from collections.abc import Iterator
from dataclasses import replace

from measure import Bench, Row
from torch import arange

from e2rl.driving.setup import Setup
from e2rl.evaluation.build import build_prior, build_searches
from e2rl.search.search import Search
from e2rl.search.spending import SearchMethod, Spending, spend_together
from e2rl.search.tries import Try

SCENES = 32
TRIES = 4


def searched_rollouts(bench: Bench) -> Iterator[Row]:
    """CPU seconds a rollout of a search, of the same rollouts in full batches, and of
    questions and answers."""
    (scenes,) = bench.batches(SCENES)
    index = arange(scenes)
    only = range(scenes)
    setup = Setup(bench.scenes, bench.ego, "lane_graph", bench.sim, 32, "cpu")
    method = build_searches(bench.config, build_prior(bench.config)[0], 2.0)[0]
    tries, talk = searched(setup, method, only)
    count = len(tries)

    def plain() -> None:
        search = spending(setup, method, only)
        for _, traffic, tasks in map(search.batch, search.portions(tries)):
            setup.score(traffic, tasks)

    spent = (
        bench.both(lambda: searched(setup, method, only))[1],
        bench.both(plain)[1],
        talk,
    )
    for name, value in zip(
        ("searched", "in full batches", "ask and tell"), spent, strict=True
    ):
        yield bench.row(
            "searched_rollouts", name, index, value / count, "CPU s/rollout"
        )


def searched(
    setup: Setup, method: SearchMethod, only: range
) -> tuple[list[Try], float]:
    """The tries of a search, and the seconds that it took to ask and tell."""
    tries: list[Try] = []
    talked = 0.0

    class Timed(Search):
        def ask(self) -> list[Try]:
            nonlocal talked
            begun = time.process_time()
            asked = super().ask()
            talked += time.process_time() - begun
            tries.extend(asked)
            return asked

        def tell(self, *told) -> None:
            nonlocal talked
            begun = time.process_time()
            super().tell(*told)
            talked += time.process_time() - begun

    spend_together([spending(setup, replace(method, search=Timed), only)])
    return tries, talked


def spending(setup: Setup, method: SearchMethod, only: range) -> Spending:
    """A search with TRIES tries a scene."""
    return Spending(setup, method, seed=0, scenes=only, budget=TRIES, unit="tries")
