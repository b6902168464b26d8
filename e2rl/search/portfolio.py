"""Which family is tried next in which scene: Thompson sampling over chances that tries have told."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from e2rl.search.tries import Family

SCENE_TRIES = 1.0  # tries in one scene that weigh as much as what all scenes have told
PRIOR_TRIES = 20.0  # that a family's chance stands for at the start
CONTACT, LEAST = 0.25, 0.15  # of the chance, where the nearest try of a scene has margin 0, and where nobody comes near


@dataclass
class Portfolio:
    """Chances of F families in N scenes: that a try finds what the search is for.

    The chance in a scene follows Beta(c m, c (1 - m)) around the family's chance m in all scenes, with c = SCENE_TRIES;
    m has the family's own chance as its prior, worth PRIOR_TRIES. Where nothing is found it is multiplied by CONTACT
    + (1 - CONTACT) times the margin of the scene's nearest try, at least LEAST: tries are few where nobody comes near.

    Args:
        families: the families.
        scenes: their number.
        learns: false: every family has the same chance everywhere.
    """

    families: Sequence[Family]
    scenes: int
    learns: bool = True
    found: Tensor = field(init=False)
    tried: Tensor = field(init=False)
    nearest: Tensor = field(init=False)
    everywhere: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.found = torch.zeros(self.scenes, len(self.families), dtype=torch.float64)
        self.tried = torch.zeros_like(self.found)
        self.nearest = torch.full((self.scenes,), -torch.inf, dtype=torch.float64)
        prior = torch.tensor([family.chance for family in self.families], dtype=torch.float64)
        self.everywhere = PRIOR_TRIES * torch.stack([prior, torch.ones_like(prior)])  # found, tried
        self.spent = torch.tensor([PRIOR_TRIES * family.nfe for family in self.families], dtype=torch.float64)

    def tell(self, scene: int, family: int, found: float, margin: float, nfe: float) -> None:
        """Learn from a try that found so much of what is searched for, 0 to 1."""
        self.found[scene, family] += found
        self.tried[scene, family] += 1
        self.everywhere[:, family] += torch.tensor([found, 1.0], dtype=torch.float64)
        self.spent[family] += nfe
        self.nearest[scene] = max(float(self.nearest[scene]), margin)

    def forget(self, scene: int) -> None:
        """What the tries of a scene have told does not hold any more for this scene: another thing is searched for."""
        self.found[scene] = self.tried[scene] = 0.0

    def worth(self, generator: torch.Generator) -> Tensor:
        """A draw of the chances [N, F] per NFE, relative to the dearest family."""
        mean = self.everywhere[0] / self.everywhere[1]
        if not self.learns:
            return torch.rand(self.found.shape, generator=generator, dtype=torch.float64)
        hit = SCENE_TRIES * mean + self.found
        missed = SCENE_TRIES * (1 - mean) + self.tried - self.found
        drawn = beta(hit, missed, generator)
        near = (CONTACT + (1 - CONTACT) * self.nearest).clamp(LEAST, 1.0)
        near = torch.where(self.nearest.isinf(), 1.0, near)[:, None]
        cost = self.spent / self.everywhere[1]
        return drawn * near * cost.amax() / cost


def beta(a: Tensor, b: Tensor, generator: torch.Generator) -> Tensor:
    """A draw of Beta(a, b), elementwise."""
    first = torch._standard_gamma(a, generator=generator)
    second = torch._standard_gamma(b, generator=generator)
    return first / (first + second).clamp(min=1e-300)
