"""The intensity follows a target band of collision rates: it rises below the band and falls above it."""

from torch import Tensor

from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.settings import check_range


class AdaptiveCurriculum(CurriculumScheduler):
    """Raises eta by eta_step per round below the target band of collision rates; lowers it above the band."""

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        eta: float = 1.0,
        eta_min: float = 0.25,
        eta_max: float = 5.0,
        eta_step: float = 0.25,
        spread: float = 1.0,
        target_low: float = 0.25,
        target_high: float = 0.45,
        share: float = 0.6,
        **scenes,
    ) -> None:
        """Fields: conf/curriculum/adaptive.yaml."""
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.target_low", target_low, 0, target_high)
        check_range("curriculum.target_high", target_high, target_low, 1)
        check_range("curriculum.share", share, 0, 1)
        check_range("curriculum.spread", spread, 0)
        self._eta, self._share, self._band = eta, share, (target_low, target_high)
        self._bounds, self._step, self._spread = (eta_min, eta_max), eta_step, spread

    @property
    def eta(self) -> float:
        """The current intensity: the middle of the scenes' ones."""
        return self._eta

    def etas(self, scenes: Tensor) -> Tensor:
        """Drawn around the current intensity, within its bounds."""
        return self.around(len(scenes), self._spread, *self._bounds)

    @property
    def share(self) -> float:
        """The share of adversarial episodes."""
        return self._share

    def advance(self, collision_rate: float | None = None) -> None:
        """Advance to the next round; without a collision rate the intensity stays."""
        super().advance(collision_rate)
        if collision_rate is not None:
            low, high = self._band
            moved = self._eta + self._step * ((collision_rate < low) - (collision_rate > high))
            self._eta = min(max(moved, self._bounds[0]), self._bounds[1])

    def extra_state(self) -> dict:
        """The current intensity, by name."""
        return {"eta": self._eta}

    def load_extra_state(self, state: dict) -> None:
        """Restore an `extra_state`."""
        self._eta = state["eta"]
