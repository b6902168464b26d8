"""Agreement of the feasibility rules with a language model: raw share, Cohen's kappa, n.

python tools/reasoner_agreement.py synthesizer.reasoner.kind=lm synthesizer.reasoner.model=NAME
    [synthesizer.reasoner.base_url=URL] [data=scenarionet data.path=LOGS] [num_scenes=N]
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from e2rl.run.errors import InputError, stop
from e2rl.run.settings import settings_of
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes
from e2rl.sim.world import World
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.reasoner import CRITERIA, LanguageReasoner, ReasonerSettings

BATCH = 32  # scenes judged together


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
        """Cohen's kappa: agreement beyond what both judges' rates of yes give by chance; NaN where chance is all."""
        if not self.n:
            return math.nan
        one, two = (self.both + self.first) / self.n, (self.both + self.second) / self.n
        chance = one * two + (1 - one) * (1 - two)
        return (self.raw - chance) / (1 - chance) if chance < 1 else math.nan


def measure_agreement(
    scenes: SceneSet, reasoner: LanguageReasoner, settings: FeasibilitySettings
) -> tuple[dict[str, Agreement], int]:
    """({feasible and each criterion: rules against the model}, scenes compared) at the scenes' start frames.

    Compares vehicles that are present, not parked and not the ego; scenes that the rules had to decide are left out.
    """
    ours, theirs, compared = [], [], 0
    for rows in tqdm(torch.arange(len(scenes)).split(BATCH), "scenes", unit="batch"):
        scene = scenes.batch(rows)
        world = World.at_start(scene)
        rules = feasible_vehicles(scene, world, settings)
        criteria = torch.stack([rules.associated, rules.conflicting, rules.relevant], -1)
        for row, verdicts in enumerate(reasoner.judge(scene, world, rules)):
            compared += verdicts is not None
            if verdicts:
                ours.append(criteria[row, list(verdicts)])
                theirs.append(torch.tensor(list(verdicts.values())))
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


def report(config: DictConfig) -> None:
    """Ask about the start frames of the configured scenes and print the table."""
    settings = settings_of(ReasonerSettings, config.synthesizer.reasoner, "synthesizer.reasoner")
    if settings.kind != "lm":
        raise InputError("the rules agree with themselves; give synthesizer.reasoner.kind=lm and its model")
    rules = settings_of(FeasibilitySettings, config.synthesizer.feasibility, "synthesizer.feasibility")
    reasoner = LanguageReasoner(settings)
    scenes = load_scenes(config.data, config.num_scenes)
    print(agreement_table(*measure_agreement(scenes, reasoner, rules), len(scenes)))
    print(", ".join(f"{name} {value:.0f}" for name, value in reasoner.statistics.items()))


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    try:
        report(config)
    except InputError as error:
        stop(error)


if __name__ == "__main__":
    main()
