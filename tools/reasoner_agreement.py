"""Agreement of the feasibility rules with a language model: raw agreement, Cohen's kappa, n.

python tools/reasoner_agreement.py synthesizer.reasoner.kind=lm synthesizer.reasoner.model=NAME
    [synthesizer.reasoner.base_url=URL] [data=scenarionet data.path=LOGS] [num_scenes=N]
"""

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from e2rl.run.config import load_config
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.settings import settings_of
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes
from e2rl.sim.world import World
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.reasoner import CRITERIA, LanguageReasoner, ReasonerSettings

BATCH = 32  # scenes judged together


def agreement(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Returns the fraction of n on which two judges [n] bool agree, and Cohen's kappa: the agreement beyond what their
    rates of yes give by chance. NaN without any, and where chance is all."""
    if not len(first):
        return math.nan, math.nan
    one, two = first.double().mean().item(), second.double().mean().item()
    raw, chance = (first == second).double().mean().item(), one * two + (1 - one) * (1 - two)
    return raw, (raw - chance) / (1 - chance) if chance < 1 else math.nan


def judged(scenes: SceneSet, reasoner: LanguageReasoner, settings: FeasibilitySettings) -> tuple[Tensor, Tensor, int]:
    """Returns the criteria [n, 3] by the rules and by the model, and the scenes compared, at the scenes' start frames.

    Vehicles are present, not parked and not the ego. Scenes that the rules had to decide are left out.
    """
    ours, theirs, compared = [torch.zeros(0, len(CRITERIA), dtype=torch.bool)], [], 0
    for rows in torch.arange(len(scenes)).split(BATCH):
        scene = scenes.batch(rows)
        world = World.at_start(scene)
        rules = feasible_vehicles(scene, world, settings)
        criteria = torch.stack([rules.associated, rules.conflicting, rules.relevant], -1)
        for row, verdicts in enumerate(reasoner.judge(scene, world, rules)):
            compared += verdicts is not None
            if verdicts:
                ours.append(criteria[row, list(verdicts)])
                theirs.append(torch.tensor(list(verdicts.values())))
    return torch.cat(ours), torch.cat(theirs) if theirs else ours[0], compared


def main() -> None:
    config = load_config("evaluate", sys.argv[1:])
    settings = settings_of(ReasonerSettings, config.synthesizer.reasoner, "synthesizer.reasoner")
    if settings.kind != "lm":
        raise InputError("the rules agree with themselves; give synthesizer.reasoner.kind=lm and its model")
    reasoner = LanguageReasoner(settings)
    scenes = load_scenes(config.data, config.num_scenes)
    rules = settings_of(FeasibilitySettings, config.synthesizer.feasibility, "synthesizer.feasibility")
    one, two, compared = judged(scenes, reasoner, rules)
    pairs = {"feasible": (one.all(-1), two.all(-1))} | {name: (one[:, k], two[:, k]) for k, name in enumerate(CRITERIA)}
    print(f"{'':<20}{'agree':>8}{'kappa':>8}{'n':>7}")
    for name, pair in pairs.items():
        raw, kappa = agreement(*pair)
        print(f"{name:<20}{100 * raw:>7.1f}%{kappa:>8.3f}{len(one):>7}")
    print(f"{compared} of {len(scenes)} scenes; in the others the model gave no usable answer")
    print(", ".join(f"{name} {value:.0f}" for name, value in reasoner.statistics.items()))


if __name__ == "__main__":
    with ending():
        main()
