"""Which family is tried next in which scene: Thompson sampling over chances learned
from tries."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.search.tries import Family

# first tries of scenes that a family's chance stands for at the start
CHANCE_TRIES = 10.0
SCENE_TRIES = 2.0  # after which the next in the scene has half the chance
FAMILY_TRIES = 4.0  # after which the next of the family there has half the chance
# see `nearness`
CONTACT = 0.75
CLOSER = 2.0
FARTHER = 0.15
LEAST = 0.1


@dataclass
class Portfolio:
    """Chances of F families in N scenes: that a try finds what the search is for.

    A family has a chance m of the first try in a scene. Its law is that of a rate:
    Gamma with shape CHANCE_TRIES times the family's own chance + what was found, and
    rate CHANCE_TRIES + the x of its tries so far. In a scene with n tries, k of them of
    the family, the chance is x m, with

        x = nearness(margin of the nearest) / ((1 + n / SCENE_TRIES) (1 + k /
        FAMILY_TRIES)).

    Unless it `learns`, every family has the same chance everywhere.
    """

    families: Sequence[Family]
    scenes: int
    learns: bool = True

    def __post_init__(self) -> None:
        chance = [family.chance for family in self.families]
        nfe = [CHANCE_TRIES * family.nfe for family in self.families]
        prior = torch.tensor(chance, dtype=torch.float64)
        self.tried = torch.zeros(self.scenes, len(self.families), dtype=torch.float64)
        self.nearest = torch.full((self.scenes,), torch.nan, dtype=torch.float64)
        self.found = CHANCE_TRIES * prior
        self.exposed = torch.full_like(prior, CHANCE_TRIES)  # and the x of the tries
        self.spent = torch.tensor(nfe, dtype=torch.float64)
        self.driven = torch.full_like(prior, CHANCE_TRIES)  # tries that spent that

    def tell(
        self,
        scene: int,
        family: int,
        *,
        reward: float,
        margin: float,
        nfe: float,
    ) -> None:
        """Learn from a try.

        Args:
            scene: its position.
            family: its position.
            reward: what its find is worth, 0 to 1.
            margin: of the try.
            nfe: that it cost.
        """
        self.found[family] += reward
        self.exposed[family] += self.share(slice(scene, scene + 1))[0, family]
        self.tried[scene, family] += 1
        self.spent[family] += nfe
        self.driven[family] += 1
        nearest = torch.tensor(margin, dtype=torch.float64)
        self.nearest[scene] = torch.fmax(self.nearest[scene], nearest)

    def forget(self, scene: int) -> None:
        """Forget what the tries of a scene have told of it: something else is searched
        for there."""
        self.tried[scene] = 0.0
        self.nearest[scene] = torch.nan

    def share(self, scenes: slice = slice(None)) -> Tensor:
        """Returns x [N, F] of some scenes: what is left of the chances of a first try."""
        tried = self.tried[scenes]
        in_scene = 1 + tried.sum(1, keepdim=True) / SCENE_TRIES
        of_family = 1 + tried / FAMILY_TRIES
        return nearness(self.nearest[scenes])[:, None] / (in_scene * of_family)

    def worth(self, generator: torch.Generator) -> Tensor:
        """Returns a draw of the chances [N, F] per NFE, relative to the most expensive
        family; those of a scene as if tried one after another, the best first."""
        if not self.learns:
            shape = self.tried.shape
            return torch.rand(shape, generator=generator, dtype=torch.float64)
        chance = torch._standard_gamma(self.found, generator=generator) / self.exposed
        cost = self.spent / self.driven
        worth = self.share() * chance * cost.amax() / cost
        count = self.tried.sum(1, keepdim=True)
        rank = worth.argsort(dim=1, descending=True).argsort(dim=1)
        return worth * (1 + count / SCENE_TRIES) / (1 + (count + rank) / SCENE_TRIES)


def nearness(margin: Tensor) -> Tensor:
    """Returns how likely a find is in scenes whose nearest try has this margin, beside
    one without a try (NaN), which has 1."""
    slope = torch.where(margin > 0, CLOSER, FARTHER)
    return (CONTACT + slope * margin.clamp(max=1)).clamp(min=LEAST).nan_to_num(1.0)
