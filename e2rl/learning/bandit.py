"""A bandit over intensity and causal template: it prefers what the policy sometimes
fails, but not always.

An arm is an intensity with a causal template. What there is to learn from an attack
whose failure rate is p is scored as the regret p s of `CurriculumScheduler`: 0 for what
is mastered and for what is hopeless. Each arm has its own p and s from the policy's
episodes. Counts are forgotten exponentially, so an arm that is no longer drawn drifts
back to the prior and is tried again.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from e2rl.learning.scheduler import CurriculumScheduler, Outcomes
from e2rl.run.settings import check_choice, check_range, configured
from e2rl.traffic.traffic import TEMPLATES

MOST = 0.25  # of p (1 - p)
SHARPNESS = 10.0  # of the softmax of the arms' values in units of MOST
EXPLORATION = 0.1  # fraction of the draws that goes to all arms alike


@configured("curriculum/bandit")
class BanditCurriculum(CurriculumScheduler):
    """Draws an arm for each scene of a round, by a softmax of the arms' values and some
    exploration.

    State of A arms: counts [6, A] of attacks that failed, survived, entered D', were
    left out, were looked at by the teacher, and of what of these it would survive. An
    attack of this round counts once, however many episodes are driven in it: they are
    alike. Settings: conf/curriculum/bandit.yaml.
    """

    lasting = ("_counts",)

    def __init__(
        self,
        *run: int,
        etas: Sequence[float],
        templates: Sequence[str],
        forgetting: float,
        fraction: float,
        **scenes: Any,
    ) -> None:
        super().__init__(*run, **scenes)
        check_range("curriculum.etas: intensities", len(etas), low=1)
        check_range("curriculum.etas", min(etas), low=1e-6)
        check_range("curriculum.templates: names", len(templates), low=1)
        for name in templates:
            check_choice("curriculum.templates", name, choices=TEMPLATES)
        check_range("curriculum.forgetting", forgetting, low=0, high=1)
        check_range("curriculum.fraction", fraction, low=0, high=1)
        self.templates = tuple(dict.fromkeys(templates))
        levels = torch.tensor(sorted(set(etas)), dtype=torch.float32)
        codes = torch.tensor([TEMPLATES.index(name) for name in self.templates])
        self._eta = levels.repeat(len(codes))
        self._template = codes.repeat_interleave(len(levels))
        self._counts = torch.zeros(6, len(self._eta), dtype=torch.float64)
        self._forgetting = forgetting
        self.fraction = fraction

    @property
    def eta(self) -> float:  # type: ignore[override]
        """The expected intensity of a draw."""
        return (self.probability() * self._eta).sum().item()

    def value(self) -> Tensor:
        """What an attack of each arm [A] teaches, in expectation: the fraction of its
        attacks that enter D' times p s, where p is the failure rate, whose prior is
        uniform, and s what the teacher would survive, beside one attack of which it
        would survive 1 - p."""
        failed, survived, entered, left_out, looked_at, survivable = self._counts
        failed = failed + 1
        survived = survived + 1
        total = failed + survived
        share = (survivable + survived / (total + 1)) / (
            looked_at + 1
        )  # E[p (1 - p)] / E[p] where nobody tells
        return (entered + 1) / (entered + left_out + 1) * failed / total * share

    def probability(self) -> Tensor:
        """Probability [A] with which an arm is drawn."""
        greedy = (SHARPNESS * self.value() / MOST).softmax(0)
        return (1 - EXPLORATION) * greedy + EXPLORATION / len(greedy)

    def choices(self, scenes: Tensor) -> tuple[Tensor, Tensor]:
        """The intensity and the template of an arm for each scene."""
        arm = torch.multinomial(
            self.probability(), len(scenes), replacement=True, generator=self._generator
        )
        return self._eta[arm], self._template[arm]

    def etas(self, scenes: Tensor) -> Tensor:
        """Intensities [S] of a new draw."""
        return self.choices(scenes)[0]

    def observe(self, outcomes: Outcomes) -> None:
        """Forget a fraction of all counts, then count the round's attacks."""
        same = (outcomes.eta[:, None] == self._eta) & (
            outcomes.template[:, None] == self._template
        )
        driven = outcomes.episodes > 0
        rate = (outcomes.failures / outcomes.episodes).nan_to_num()
        left_out = outcomes.left_out
        told = ~outcomes.survivable.isnan() & self._teacher_tells
        looked_at = told, outcomes.survivable.nan_to_num() * told
        seen = torch.stack(
            [rate * driven, (1 - rate) * driven, ~left_out, left_out, *looked_at]
        ).double()
        self._counts = (1 - self._forgetting) * self._counts + seen @ same.double()

    def level(self, eta: Tensor) -> Tensor:
        """The arms' own intensities."""
        return eta

    def values(self) -> dict[tuple[float, str], float]:
        """The value of every arm."""
        names = [TEMPLATES[code] for code in self._template.tolist()]
        return dict(
            zip(
                zip(self._eta.tolist(), names, strict=True),
                self.value().tolist(),
                strict=True,
            )
        )
