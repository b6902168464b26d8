"""Constant intensity and share of adversarial episodes."""

from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.settings import check_range


class ConstantCurriculum(CurriculumScheduler):
    """The control experiment: nothing changes from round to round."""

    def __init__(self, num_scenes: int, rounds: int, seed: int = 0, eta: float = 2.0, share: float = 0.5, **scenes):
        """Fields: conf/curriculum/constant.yaml."""
        super().__init__(num_scenes, rounds, seed, **scenes)
        check_range("curriculum.share", share, 0, 1)
        self._eta, self._share = eta, share

    @property
    def eta(self) -> float:
        """The intensity."""
        return self._eta

    @property
    def share(self) -> float:
        """The share of adversarial episodes."""
        return self._share
