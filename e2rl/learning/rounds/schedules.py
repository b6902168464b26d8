"""Curricula that follow a plan: constant, linear as in CAT (Zhang et al. 2023), and
adaptive to a target band."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.run.config import check_range, configured


@configured("curriculum/constant")
class ConstantCurriculum(CurriculumScheduler):
    """Intensity and fraction never change: the control experiment. Settings:
    conf/curriculum/constant.yaml."""

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        *,
        eta: float | Sequence[float],
        fraction: float,
        **scenes: Any,
    ) -> None:
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.fraction", fraction, low=0, high=1)
        self._cycle = torch.tensor(
            [eta] if isinstance(eta, int | float) else list(eta), dtype=torch.float32
        )
        check_range("curriculum.eta: intensities", len(self._cycle), low=1)
        check_range("curriculum.eta", float(self._cycle.min()), low=0)
        self.eta = self._cycle.mean().item()
        self.fraction = fraction

    def etas(self, scenes: Tensor) -> Tensor:
        """The intensities in turn; a scene in the same place has the next one in the
        next round."""
        return self._cycle[(torch.arange(len(scenes)) + self.round) % len(self._cycle)]


@configured("curriculum/linear")
class LinearCurriculum(CurriculumScheduler):
    """Intensity and fraction rise from the first round's values to the final ones,
    which are reached after `ramp` of the rounds. Settings: conf/curriculum/linear.yaml.
    """

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        *,
        eta: float,
        eta_final: float,
        spread: float,
        fraction: float,
        fraction_final: float,
        ramp: float,
        **scenes: Any,
    ) -> None:
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.fraction", fraction, low=0, high=1)
        check_range("curriculum.fraction_final", fraction_final, low=0, high=1)
        check_range("curriculum.spread", spread, low=0)
        self._etas = (eta, eta_final)
        self._fractions = (fraction, fraction_final)
        self._ramp = ramp
        self._spread = spread

    def _between(self, first: float, last: float) -> float:
        part = min(1.0, self.round / max(1.0, self._ramp * self.rounds))
        return first + part * (last - first)

    @property
    def eta(self) -> float:  # type: ignore[override]
        """Intensity, rising."""
        return self._between(*self._etas)

    def etas(self, scenes: Tensor) -> Tensor:
        """Drawn around the round's intensity."""
        return self.around(len(scenes), self._spread)

    @property
    def fraction(self) -> float:  # type: ignore[override]
        """Fraction of adversarial episodes, rising."""
        return self._between(*self._fractions)


@configured("curriculum/adaptive")
class AdaptiveCurriculum(CurriculumScheduler):
    """The intensity rises by eta_step a round below the target band of collision rates,
    and falls by it above. Settings: conf/curriculum/adaptive.yaml."""

    lasting = ("eta",)

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        *,
        eta: float,
        eta_min: float,
        eta_max: float,
        eta_step: float,
        spread: float,
        target_low: float,
        target_high: float,
        fraction: float,
        **scenes: Any,
    ) -> None:
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.target_low", target_low, low=0, high=target_high)
        check_range("curriculum.target_high", target_high, low=target_low, high=1)
        check_range("curriculum.fraction", fraction, low=0, high=1)
        check_range("curriculum.spread", spread, low=0)
        self.eta = eta
        self.fraction = fraction
        self._band = (target_low, target_high)
        self._bounds = (eta_min, eta_max)
        self._step = eta_step
        self._spread = spread

    def etas(self, scenes: Tensor) -> Tensor:
        """Drawn around the current intensity, within its bounds."""
        lowest, highest = self._bounds
        return self.around(len(scenes), self._spread, low=lowest, high=highest)

    def advance(self, collision_rate: float | None = None) -> None:
        """Advance to the next round; without a collision rate the intensity stays."""
        super().advance(collision_rate)
        if collision_rate is not None:
            low, high = self._band
            direction = (collision_rate < low) - (collision_rate > high)
            lowest, highest = self._bounds
            moved = self.eta + self._step * direction
            self.eta = min(max(moved, lowest), highest)
