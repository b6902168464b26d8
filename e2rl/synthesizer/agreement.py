"""How far the language-model reasoner and the rules agree on which vehicles are feasible."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from e2rl.scene.scene import SceneSet
from e2rl.sim.world import World
from e2rl.synthesizer.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.synthesizer.prompt import CRITERIA
from e2rl.synthesizer.reasoner import LanguageReasoner

BATCH = 32  # scenes looked at together


@dataclass(frozen=True)
class Agreement:
    """Two judges on n vehicles: both say yes, both no, only the first yes, only the second."""

    both: int
    neither: int
    first: int
    second: int

    @staticmethod
    def of(first: Tensor, second: Tensor) -> "Agreement":
        """Of judgements [n] bool each."""
        counts = (first & second, ~first & ~second, first & ~second, ~first & second)
        return Agreement(*(int(count.sum()) for count in counts))

    @property
    def n(self) -> int:
        return self.both + self.neither + self.first + self.second

    @property
    def raw(self) -> float:
        """Share of the vehicles on which both say the same; NaN without any."""
        return (self.both + self.neither) / self.n if self.n else math.nan

    @property
    def kappa(self) -> float:
        """Cohen's kappa: agreement beyond what the judges' own rates of yes give by chance; NaN where that is all."""
        if not self.n:
            return math.nan
        one, two = (self.both + self.first) / self.n, (self.both + self.second) / self.n
        chance = one * two + (1 - one) * (1 - two)
        return (self.raw - chance) / (1 - chance) if chance < 1 else math.nan


def measure_agreement(
    scenes: SceneSet, reasoner: LanguageReasoner, settings: FeasibilitySettings
) -> tuple[dict[str, Agreement], int]:
    """({feasible and each criterion: rules against the model}, scenes compared) at the scenes' start frames.

    Vehicles that are present, not parked and not the ego; scenes for which the rules had to decide count for nothing.
    """
    ours, theirs, compared = [], [], 0
    for rows in tqdm(torch.arange(len(scenes)).split(BATCH), "scenes", unit="batch"):
        scene = scenes.batch(rows)
        world = World(
            scene, torch.zeros_like(rows), scene["start"], scene["valid"], scene["start_accel"], scene["route_log"]
        )
        rules = feasible_vehicles(scene, world, settings)
        criteria = torch.stack([rules.associated, rules.conflicting, rules.relevant], -1)
        for row, found in enumerate(reasoner.judge(scene, world, rules)):
            compared += found is not None
            if found:
                ours.append(criteria[row, list(found)])
                theirs.append(torch.tensor(list(found.values())))
    one, two = (torch.cat(part) if part else torch.zeros(0, len(CRITERIA), dtype=torch.bool) for part in (ours, theirs))
    names = {"feasible": Agreement.of(one.all(-1), two.all(-1))}
    return names | {name: Agreement.of(one[:, k], two[:, k]) for k, name in enumerate(CRITERIA)}, compared


def agreement_table(found: dict[str, Agreement], compared: int, scenes: int) -> str:
    """Raw agreement, Cohen's kappa and counts, as text."""
    head = f"{'':<20}{'agree':>8}{'kappa':>8}{'n':>7}{'both':>7}{'neither':>9}{'rules only':>12}{'model only':>12}"
    lines = [
        f"{name:<20}{100 * a.raw:>7.1f}%{a.kappa:>8.3f}{a.n:>7}{a.both:>7}{a.neither:>9}{a.first:>12}{a.second:>12}"
        for name, a in found.items()
    ]
    return "\n".join([head, *lines, f"{compared} of {scenes} scenes; in the others the model gave no usable answer"])
