"""The intensity follows a target band of collision rates: it rises below the band and falls above it.

Constant intensity and share of adversarial episodes.

Intensity and share of adversarial episodes rise linearly, as in CAT (Zhang et al. 2023).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.learning.scheduler import CurriculumScheduler
from e2rl.run.settings import check_range


class ConstantCurriculum(CurriculumScheduler):
    """The control experiment: nothing changes from round to round."""

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        eta: float | Sequence[float] = 2.0,
        share: float = 0.5,
        **scenes,
    ) -> None:
        """eta: one, or several that take turns over the scenes; fields: conf/curriculum/constant.yaml."""
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.share", share, 0, 1)
        self._cycle = torch.tensor([eta] if isinstance(eta, int | float) else list(eta), dtype=torch.float32)
        check_range("curriculum.eta: intensities", len(self._cycle), 1)
        check_range("curriculum.eta", float(self._cycle.min()), 0)
        self._share = share

    @property
    def eta(self) -> float:
        """The mean intensity."""
        return self._cycle.mean().item()

    def etas(self, scenes: Tensor) -> Tensor:
        """The intensities in turn; a scene in the same place has the next one in the next round."""
        return self._cycle[(torch.arange(len(scenes)) + self.round) % len(self._cycle)]

    @property
    def share(self) -> float:
        """The share of adversarial episodes."""
        return self._share


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
