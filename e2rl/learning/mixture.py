"""D' of two traffic methods: each attacks its share of a round's scenes.

An ego that meets only adversaries that owe it nothing learns to flee, and meets those that give way in the same way.
"""

from typing import Any

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.learning.attack import Synthesize

DRAW = 7_919  # apart from the other generators of a round's seed


def mixture(first: Synthesize, second: Synthesize, share: float) -> Synthesize:
    """A Synthesize whose scenes are each given to `second` with probability `share`, else to `first`.

    Who attacks a scene is drawn from the seed and the scene, so it is the same in whichever batch the scene lies.
    Templates are given to both; rows come in the order of the scenes.
    """

    def synthesize(ego: Ego, scenes: Tensor, eta: Tensor, seed: int, *template: Tensor) -> dict[str, Any]:
        other = drawn(scenes, seed, share)
        parts, places, ended = [], [], dict[int, dict]()
        for make, chosen in ((first, ~other), (second, other)):
            rows = chosen.nonzero()[:, 0]
            if not len(rows):
                continue
            made = dict(make(ego, scenes[rows], eta[rows], seed, *(each[rows] for each in template)))
            lost = made.pop("ended", {})
            ended |= {int(rows[place]): why for place, why in lost.items()}
            places += [int(row) for place, row in enumerate(rows) if place not in lost]
            parts.append(made)
        order = torch.tensor(places, dtype=torch.int64).argsort()
        return {name: torch.cat([part[name] for part in parts])[order] for name in parts[0]} | {"ended": ended}

    return synthesize


def drawn(scenes: Tensor, seed: int, share: float) -> Tensor:
    """Bool [S]: scenes [S] that a draw of probability `share` chooses, each by the seed and its own number."""
    largest = int(scenes.max()) + 1 if len(scenes) else 0
    draws = torch.rand(largest, generator=torch.Generator().manual_seed(seed * DRAW + 1))
    return draws[scenes] < share
