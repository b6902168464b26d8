"""Constant intensity and share of adversarial episodes."""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.settings import check_range


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
