"""Intensity and share of adversarial episodes rise linearly, as in CAT (Zhang et al. 2023)."""

from torch import Tensor

from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.settings import check_range


class LinearCurriculum(CurriculumScheduler):
    """From the first round's values to the final values, reached after the share `ramp` of the rounds."""

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        eta: float = 0.5,
        eta_final: float = 3.0,
        share: float = 0.0,
        share_final: float = 0.9,
        ramp: float = 0.5,
        spread: float = 0.0,
        **scenes,
    ) -> None:
        """Fields: conf/curriculum/linear.yaml."""
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.share", share, 0, 1)
        check_range("curriculum.share_final", share_final, 0, 1)
        check_range("curriculum.spread", spread, 0)
        self._etas, self._shares, self._ramp, self._spread = (eta, eta_final), (share, share_final), ramp, spread

    def _between(self, first: float, last: float) -> float:
        return first + min(1.0, self.round / max(1.0, self._ramp * self.rounds)) * (last - first)

    @property
    def eta(self) -> float:
        """Intensity, rising."""
        return self._between(*self._etas)

    def etas(self, scenes: Tensor) -> Tensor:
        """Drawn around the round's intensity."""
        return self.around(len(scenes), self._spread)

    @property
    def share(self) -> float:
        """Share of adversarial episodes, rising."""
        return self._between(*self._shares)
