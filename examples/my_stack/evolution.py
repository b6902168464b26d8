"""Somebody else's optimiser in the place of the portfolio: CMA-ES (package cma) climbs
the margin in every scene."""

from dataclasses import dataclass

import cma
import numpy as np
import torch

from e2rl.search.search import Search
from e2rl.search.tries import DRAWN

POPULATION = 4  # tries of a scene in a generation


@dataclass
class Evolution(Search):
    """A strategy a scene over the family and its decisions, all in [0, 1]; one
    generation a round."""

    def __post_init__(self):
        super().__post_init__()
        options = {"bounds": [0, 1], "popsize": POPULATION, "verbose": -9}
        middle = np.full(1 + len(DRAWN), 0.5)
        seeds = [1 + self.seed_of(scene) for scene in range(len(self.numbers))]
        self._strategies = [
            cma.CMAEvolutionStrategy(middle, 0.3, options | {"seed": seed})
            for seed in seeds
        ]

    def ask(self):
        """A generation of every scene."""
        self._points = [strategy.ask() for strategy in self._strategies]
        return [
            self._try(scene, k, u)
            for scene, points in enumerate(self._points)
            for k, u in enumerate(points)
        ]

    def _try(self, scene, k, point):
        family = self.families[
            min(int(point[0] * len(self.families)), len(self.families) - 1)
        ]
        return family.attempt(
            scene,
            len(self.tries[scene]) + k,
            seed=self.seed_of(scene),
            draw=torch.from_numpy(point[1:]),
        )

    def tell(self, tries, outcomes):
        """CMA-ES minimises; a try that errored comes nowhere near."""
        super().tell(tries, outcomes)
        for scene, strategy in enumerate(self._strategies):
            loss = [
                -outcome.margin
                for one, outcome in zip(tries, outcomes, strict=True)
                if one.scene == scene
            ]
            strategy.tell(self._points[scene], np.nan_to_num(loss, posinf=1e3))
