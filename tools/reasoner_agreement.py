"""Agreement of the feasibility rules with a language model: raw share, Cohen's kappa, n.

python tools/reasoner_agreement.py synthesizer.reasoner.kind=lm synthesizer.reasoner.model=NAME
    [synthesizer.reasoner.base_url=URL] [data=scenarionet data.path=LOGS] [num_scenes=N]
"""

import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from e2rl.errors import InputError, stop  # noqa: E402
from e2rl.scene.source import load_scenes  # noqa: E402
from e2rl.settings import settings_of  # noqa: E402
from e2rl.synthesizer.agreement import agreement_table, measure_agreement  # noqa: E402
from e2rl.synthesizer.feasibility import FeasibilitySettings  # noqa: E402
from e2rl.synthesizer.reasoner import LanguageReasoner, ReasonerSettings  # noqa: E402


def report(config: DictConfig) -> None:
    """Ask about the start frames of the configured scenes and print the table."""
    settings = settings_of(ReasonerSettings, config.synthesizer.reasoner, "synthesizer.reasoner")
    if settings.kind != "lm":
        raise InputError("the rules agree with themselves; give synthesizer.reasoner.kind=lm and its model")
    rules = settings_of(FeasibilitySettings, config.synthesizer.feasibility, "synthesizer.feasibility")
    counts: dict[str, float] = {}
    reasoner = LanguageReasoner(settings, counts)
    scenes = load_scenes(config.data, config.num_scenes)
    print(agreement_table(*measure_agreement(scenes, reasoner, rules), len(scenes)))
    print(", ".join(f"{name} {value:.0f}" for name, value in counts.items()))


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    try:
        report(config)
    except InputError as error:
        stop(error)


if __name__ == "__main__":
    main()
